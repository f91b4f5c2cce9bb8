#include "level_values.h"

#include <algorithm>

#include "valid_depth.h"

namespace surfconv::cpu {
namespace {

// A search per pixel mispredicts its branches; a comparison with every edge vectorises.
template <class T>
void look_up(const T* __restrict depth, int64_t count, const T* edges, const T* values,
             int64_t levels, T* __restrict out) {
  constexpr int64_t kRun = 256;
  int32_t level[kRun];
  for (int64_t begin = 0; begin < count; begin += kRun) {
    const int64_t run = std::min(kRun, count - begin);
    const T* __restrict z = depth + begin;
    std::fill_n(level, run, 0);
    for (int64_t k = 0; k + 1 < levels; ++k) {
      const T edge = edges[k];
      for (int64_t i = 0; i < run; ++i) level[i] += z[i] > edge;
    }
    const int32_t invalid = static_cast<int32_t>(levels);
    for (int64_t i = 0; i < run; ++i) {
      level[i] = is_valid_depth(z[i]) ? level[i] : invalid;
    }
    for (int64_t i = 0; i < run; ++i) out[begin + i] = values[level[i]];
  }
}

}  // namespace

void level_values(const float* depth, int64_t count, const float* edges, const float* values,
                  int64_t levels, float* out) {
  look_up(depth, count, edges, values, levels, out);
}
void level_values(const double* depth, int64_t count, const double* edges, const double* values,
                  int64_t levels, double* out) {
  look_up(depth, count, edges, values, levels, out);
}

}  // namespace surfconv::cpu
