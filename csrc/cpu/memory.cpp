#include "memory.h"

#include <unistd.h>

#include <algorithm>
#include <mutex>
#include <new>
#include <vector>

namespace surfconv::cpu {
namespace {

constexpr std::align_val_t kAlignment{64};

#if defined(__SANITIZE_ADDRESS__)
constexpr size_t kLeastKept = kKeptBytes + 1;  // blocks used again would hide overruns
#else
constexpr size_t kLeastKept = size_t{64} << 10;  // malloc keeps smaller ones itself
#endif

struct Kept {
  std::mutex mutex;
  std::vector<Block> blocks;  // oldest first
  size_t bytes = 0;
};

// Never destroyed: threads may still compute while the process ends.
Kept& kept() {
  static Kept* const instance = new Kept;
  return *instance;
}

void free_block(Block block) noexcept { ::operator delete(block.data, kAlignment); }

}  // namespace

Block take_block(size_t bytes) {
  if (bytes >= kLeastKept) {
    Kept& pool = kept();
    // Never waits: whoever held the lock may not have survived a fork.
    const std::unique_lock<std::mutex> lock(pool.mutex, std::try_to_lock);
    if (lock.owns_lock()) {
      auto best = pool.blocks.end();
      for (auto it = pool.blocks.begin(); it != pool.blocks.end(); ++it) {
        const bool fits = it->bytes >= bytes && it->bytes / 2 <= bytes;
        if (fits && (best == pool.blocks.end() || it->bytes < best->bytes)) best = it;
      }
      if (best != pool.blocks.end()) {
        const Block block = *best;
        pool.blocks.erase(best);
        pool.bytes -= block.bytes;
        return block;
      }
    }
  }
  return {::operator new(bytes, kAlignment), bytes};
}

void return_block(Block block) noexcept {
  if (block.data == nullptr) return;
  if (block.bytes >= kLeastKept && block.bytes <= kKeptBytes) {
    Kept& pool = kept();
    const std::unique_lock<std::mutex> lock(pool.mutex, std::try_to_lock);
    if (lock.owns_lock()) {
      while (pool.bytes + block.bytes > kKeptBytes) {
        pool.bytes -= pool.blocks.front().bytes;
        free_block(pool.blocks.front());
        pool.blocks.erase(pool.blocks.begin());
      }
      try {
        pool.blocks.push_back(block);
        pool.bytes += block.bytes;
        return;
      } catch (const std::bad_alloc&) {
      }
    }
  }
  free_block(block);
}

int64_t second_level_cache() {
  static const int64_t bytes = [] {
    constexpr int64_t kSmall = int64_t{256} << 10;
#if defined(_SC_LEVEL2_CACHE_SIZE)
    return std::max<int64_t>(kSmall, sysconf(_SC_LEVEL2_CACHE_SIZE));
#else
    return kSmall;
#endif
  }();
  return bytes;
}

}  // namespace surfconv::cpu
