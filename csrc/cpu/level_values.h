// Torch-free interface of the look-up of depth levels.
#pragma once

#include <cstdint>

namespace surfconv::cpu {

// out[i] = values[level of depth[i]]: level k holds edges[k-1] < z <= edges[k]. values has levels +
// 1 entries, the last for depths that are not positive and finite. edges has levels - 1.
void level_values(const float* depth, int64_t count, const float* edges, const float* values,
                  int64_t levels, float* out);
void level_values(const double* depth, int64_t count, const double* edges, const double* values,
                  int64_t levels, double* out);

}  // namespace surfconv::cpu
