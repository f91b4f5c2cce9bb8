// What the operators' entries share: tensors as the kernels see them, results, checks.
#pragma once

#include <torch/csrc/stable/tensor.h>

#include <cstdint>
#include <vector>

#include "cpu/surf_conv2d.h"

namespace surfconv {

using torch::stable::Tensor;

cpu::DType dtype_of(const Tensor& tensor, const char* name);

// Of four dimensions, of three (a guide), or of one (a bias).
cpu::View view_of(const Tensor& tensor, const char* name, bool written = false);

// On the CPU, in float32 or the input's dtype.
void check_scale_like(const Tensor& tensor, const Tensor& input, const char* name);

// Throws where index arithmetic could overflow.
Axis checked_axis(int64_t size, int64_t out, int64_t kernel, int64_t stride, int64_t padding,
                  int64_t dilation);

// In the dtype of `like`, in the memory format of `layout`.
Tensor empty_as(const Tensor& like, const std::vector<int64_t>& sizes, const Tensor& layout);

// What stands for a result that was not asked for.
Tensor absent(const Tensor& like);

std::vector<int64_t> sizes_of(const Tensor& tensor);

// Runs the kernels' workers on torch's threads.
cpu::Executor executor();

}  // namespace surfconv
