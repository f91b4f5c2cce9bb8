// Entries of the pools on CPU tensors: checks, allocation, dispatch to the kernels.
#pragma once

#include <torch/csrc/stable/tensor.h>

#include <cstdint>
#include <optional>
#include <tuple>
#include <vector>

namespace surfconv {

using torch::stable::Tensor;

// The maximum, and the winning taps' numbers as (N, Ho, Wo, C).
std::tuple<Tensor, Tensor> surf_max_pool2d(const Tensor& input, const Tensor& scale,
                                           const std::optional<Tensor>& guide,
                                           double guide_tolerance, std::vector<int64_t> kernel_size,
                                           std::vector<int64_t> stride,
                                           std::vector<int64_t> padding,
                                           std::vector<int64_t> dilation);

std::tuple<Tensor, Tensor> surf_max_pool2d_backward(
    const Tensor& grad_output, const Tensor& input, const Tensor& scale,
    const std::optional<Tensor>& guide, const Tensor& winner, double guide_tolerance,
    std::vector<int64_t> kernel_size, std::vector<int64_t> stride, std::vector<int64_t> padding,
    std::vector<int64_t> dilation, bool need_input, bool need_scale);

Tensor surf_avg_pool2d(const Tensor& input, const Tensor& scale, const std::optional<Tensor>& guide,
                       double guide_tolerance, std::vector<int64_t> kernel_size,
                       std::vector<int64_t> stride, std::vector<int64_t> padding,
                       bool count_include_pad, int64_t divisor_override);

std::tuple<Tensor, Tensor> surf_avg_pool2d_backward(
    const Tensor& grad_output, const Tensor& input, const Tensor& scale,
    const std::optional<Tensor>& guide, double guide_tolerance, std::vector<int64_t> kernel_size,
    std::vector<int64_t> stride, std::vector<int64_t> padding, bool count_include_pad,
    int64_t divisor_override, bool need_input, bool need_scale);

}  // namespace surfconv
