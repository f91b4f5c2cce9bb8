// Torch-free interface of the search for the nearest valid depth.
#pragma once

#include <cstdint>

namespace surfconv::cpu {

struct Resizing {
  int64_t rows, columns;  // of each depth map
  int64_t height, width;  // of the view
};

// For rows begin .. end-1 of the views, counted over all images: where in `depth` the depth of each
// pixel is. Pixel (i, j) stands for rows floor(i*rows/height) .. ceil((i+1)*rows/height) - 1,
// columns likewise: the first of them, or where that is invalid the valid one nearest to it, ties
// going to the lower row, then the lower column. Without a valid one it is the first.
void nearest_depth(const float* depth, const Resizing& sizes, int64_t begin, int64_t end,
                   int64_t* out);
void nearest_depth(const double* depth, const Resizing& sizes, int64_t begin, int64_t end,
                   int64_t* out);

}  // namespace surfconv::cpu
