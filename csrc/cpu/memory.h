// Work memory that outlives a call: fresh pages cost more than small layers compute. And the cache
// that it should fit.
#pragma once

#include <cstddef>
#include <cstdint>

namespace surfconv::cpu {

// Bytes kept for later calls, all blocks together.
constexpr size_t kKeptBytes = size_t{32} << 20;

struct Block {
  void* data = nullptr;  // aligned to 64 bytes, contents undefined
  size_t bytes = 0;      // at least what was asked for
};

// Throws std::bad_alloc. Both may be called from any thread, and after a fork.
Block take_block(size_t bytes);
void return_block(Block block) noexcept;

// Bytes; a small one's where the system does not tell.
int64_t second_level_cache();

}  // namespace surfconv::cpu
