// Entry of the search for the valid depth nearest to each pixel of a smaller view, on CPU tensors.
#pragma once

#include <torch/csrc/stable/tensor.h>

namespace surfconv {

torch::stable::Tensor nearest_depth(const torch::stable::Tensor& depth, int64_t height,
                                    int64_t width);

}  // namespace surfconv
