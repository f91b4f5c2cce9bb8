#include "nearest_depth.h"

#include <cstddef>
#include <limits>
#include <vector>

#include "valid_depth.h"

namespace surfconv::cpu {
namespace {

struct Footprint {
  int64_t first, size;
};
Footprint footprint(int64_t pixel, int64_t in, int64_t out) {
  const int64_t first = pixel * in / out;
  return {first, ((pixel + 1) * in + out - 1) / out - first};
}

// Rows and columns ascend, so that of two as near the earlier one stays; none lies beyond the
// nearest one found.
template <class T>
int64_t search(const T* corner, int64_t columns, int64_t tall, int64_t wide) {
  int64_t nearest = 0, least = std::numeric_limits<int64_t>::max();
  for (int64_t y = 0; y < tall && y * y < least; ++y) {
    for (int64_t x = 0; x < wide; ++x) {
      const int64_t distance = y * y + x * x;
      if (distance >= least) break;
      if (is_valid_depth(corner[y * columns + x])) {
        least = distance;
        nearest = y * columns + x;
        break;
      }
    }
  }
  return nearest;
}

template <class T>
void search_rows(const T* depth, const Resizing& sizes, int64_t begin, int64_t end, int64_t* out) {
  std::vector<Footprint> aside(static_cast<size_t>(sizes.width));
  for (int64_t j = 0; j < sizes.width; ++j) {
    aside[static_cast<size_t>(j)] = footprint(j, sizes.columns, sizes.width);
  }
  for (int64_t row = begin; row < end; ++row) {
    const int64_t image = row / sizes.height;
    const Footprint down = footprint(row % sizes.height, sizes.rows, sizes.height);
    const int64_t start = (image * sizes.rows + down.first) * sizes.columns;
    int64_t* to = out + row * sizes.width;
    for (int64_t j = 0; j < sizes.width; ++j) {
      const Footprint& across = aside[static_cast<size_t>(j)];
      const int64_t first = start + across.first;
      to[j] = is_valid_depth(depth[first])
                  ? first
                  : first + search(depth + first, sizes.columns, down.size, across.size);
    }
  }
}

}  // namespace

void nearest_depth(const float* depth, const Resizing& sizes, int64_t begin, int64_t end,
                   int64_t* out) {
  search_rows(depth, sizes, begin, end, out);
}
void nearest_depth(const double* depth, const Resizing& sizes, int64_t begin, int64_t end,
                   int64_t* out) {
  search_rows(depth, sizes, begin, end, out);
}

}  // namespace surfconv::cpu
