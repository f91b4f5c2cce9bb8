// Entries of the scale that a depth gives, and of its derivative, on CPU tensors.
#pragma once

#include <torch/csrc/stable/tensor.h>

namespace surfconv {

torch::stable::Tensor depth_to_scale(const torch::stable::Tensor& depth, double reference,
                                     double invalid, double low, double high, double steepest);

torch::stable::Tensor depth_to_scale_backward(const torch::stable::Tensor& grad,
                                              const torch::stable::Tensor& depth, double reference,
                                              double low, double high, double steepest);

}  // namespace surfconv
