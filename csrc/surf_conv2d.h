// Entries of the operator on CPU tensors: checks, allocation, dispatch to the kernels.
#pragma once

#include <torch/csrc/stable/tensor.h>

#include <cstdint>
#include <optional>
#include <string>
#include <tuple>
#include <vector>

namespace surfconv {

using torch::stable::Tensor;

Tensor surf_conv2d(const Tensor& input, const Tensor& weight, const std::optional<Tensor>& bias,
                   const Tensor& scale, const std::optional<Tensor>& guide, double guide_tolerance,
                   std::vector<int64_t> stride, std::vector<int64_t> padding,
                   std::vector<int64_t> dilation, int64_t groups);

std::tuple<Tensor, Tensor, Tensor, Tensor> surf_conv2d_backward(
    const Tensor& grad_output, const Tensor& input, const Tensor& weight, const Tensor& scale,
    const std::optional<Tensor>& guide, double guide_tolerance, std::vector<int64_t> stride,
    std::vector<int64_t> padding, std::vector<int64_t> dilation, int64_t groups, bool need_input,
    bool need_weight, bool need_bias, bool need_scale);

std::string cpu_capability();

}  // namespace surfconv
