// Entry of the look-up of depth levels on CPU tensors.
#pragma once

#include <torch/csrc/stable/tensor.h>

namespace surfconv {

torch::stable::Tensor level_values(const torch::stable::Tensor& depth,
                                   const torch::stable::Tensor& edges,
                                   const torch::stable::Tensor& values);

}  // namespace surfconv
