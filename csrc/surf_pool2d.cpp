#include "surf_pool2d.h"

#include <torch/csrc/stable/ops.h>
#include <torch/headeronly/core/ScalarType.h>
#include <torch/headeronly/util/Exception.h>

#include "cpu/surf_pool2d.h"
#include "tensors.h"

namespace surfconv {
namespace {

using cpu::Pool;
using torch::headeronly::ScalarType;

ScalarType winner_dtype(const Pool& pool) {
  return pool.taps() <= cpu::kMostShortTaps ? ScalarType::Byte : ScalarType::Int;
}

// What memory safety needs; the messages a user should see come from the Python validator.
Pool checked(const Tensor& input, const Tensor& scale, const std::optional<Tensor>& guide,
             double guide_tolerance, const std::vector<int64_t>& kernel,
             const std::vector<int64_t>& stride, const std::vector<int64_t>& padding,
             const std::vector<int64_t>& dilation, int64_t divisor_override = 0,
             bool count_include_pad = true) {
  STD_TORCH_CHECK(input.dim() == 4 && scale.dim() == 4,
                  "surf_pool2d: input and scale must have 4 dimensions");
  STD_TORCH_CHECK(
      kernel.size() == 2 && stride.size() == 2 && padding.size() == 2 && dilation.size() == 2,
      "surf_pool2d: kernel_size, stride, padding and dilation must be (y, x) pairs");
  STD_TORCH_CHECK(input.is_cpu(), "surf_pool2d: tensors must be on the CPU");
  STD_TORCH_CHECK(input.size(1) > 0, "surf_pool2d: input must have channels");
  check_scale_like(scale, input, "scale");
  STD_TORCH_CHECK(scale.size(0) == input.size(0) && (scale.size(1) == 1 || scale.size(1) == 2),
                  "surf_pool2d: scale must be (N, 1 or 2, Ho, Wo)");
  if (guide.has_value()) {
    check_scale_like(*guide, input, "guide");
    STD_TORCH_CHECK(guide->dim() == 3 && guide->size(0) == input.size(0) &&
                        guide->size(1) == input.size(2) && guide->size(2) == input.size(3),
                    "surf_pool2d: guide must be (N, H, W)");
  }
  const auto axis = [&](size_t d) {
    constexpr int64_t kMostTaps = int64_t{1} << 13;
    STD_TORCH_CHECK(kernel[d] <= kMostTaps, "surf_pool2d: kernel_size is at most 8192");
    return checked_axis(input.size(2 + d), scale.size(2 + d), kernel[d], stride[d], padding[d],
                        dilation[d]);
  };
  return {axis(0),       axis(1),         input.size(0),    input.size(1),
          scale.size(1), guide_tolerance, divisor_override, count_include_pad};
}

void check_grad_output(const Tensor& grad_output, const Tensor& input, const Pool& pool) {
  STD_TORCH_CHECK(grad_output.dim() == 4 && grad_output.size(0) == pool.batch &&
                      grad_output.size(1) == pool.channels && grad_output.size(2) == pool.y.out &&
                      grad_output.size(3) == pool.x.out && grad_output.is_cpu() &&
                      grad_output.scalar_type() == input.scalar_type(),
                  "surf_pool2d: grad_output must have the output's shape and dtype");
}

cpu::PoolForwardTensors forward_tensors(const Tensor& input, const Tensor& scale,
                                        const std::optional<Tensor>& guide, const Tensor& output) {
  cpu::PoolForwardTensors tensors;
  tensors.input = view_of(input, "input");
  tensors.scale = view_of(scale, "scale");
  if (guide.has_value()) tensors.guide = view_of(*guide, "guide");
  tensors.output = view_of(output, "output", true);
  return tensors;
}

std::tuple<Tensor, Tensor> run_backward(const Tensor& grad_output, const Tensor& input,
                                        const Tensor& scale, const std::optional<Tensor>& guide,
                                        const cpu::Winners& winners, const Pool& pool,
                                        void (*kernel)(const Pool&, const cpu::PoolBackwardTensors&,
                                                       const cpu::Executor&),
                                        bool need_input, bool need_scale) {
  Tensor grad_input = need_input ? empty_as(input, sizes_of(input), input) : absent(input);
  Tensor grad_scale = need_scale ? empty_as(scale, sizes_of(scale), scale) : absent(scale);
  cpu::PoolBackwardTensors tensors;
  tensors.grad_output = view_of(grad_output, "grad_output");
  tensors.input = view_of(input, "input");
  tensors.scale = view_of(scale, "scale");
  if (guide.has_value()) tensors.guide = view_of(*guide, "guide");
  tensors.winners = winners;
  if (need_input) tensors.grad_input = view_of(grad_input, "grad_input", true);
  if (need_scale) tensors.grad_scale = view_of(grad_scale, "grad_scale", true);
  kernel(pool, tensors, executor());
  return {grad_input, grad_scale};
}

}  // namespace

std::tuple<Tensor, Tensor> surf_max_pool2d(const Tensor& input, const Tensor& scale,
                                           const std::optional<Tensor>& guide,
                                           double guide_tolerance, std::vector<int64_t> kernel_size,
                                           std::vector<int64_t> stride,
                                           std::vector<int64_t> padding,
                                           std::vector<int64_t> dilation) {
  const Pool pool =
      checked(input, scale, guide, guide_tolerance, kernel_size, stride, padding, dilation);
  Tensor output = empty_as(input, {pool.batch, pool.channels, pool.y.out, pool.x.out}, input);
  Tensor winner =
      torch::stable::empty({pool.batch, pool.y.out, pool.x.out, pool.channels}, winner_dtype(pool));
  if (output.numel() == 0) return {output, winner};
  cpu::PoolForwardTensors tensors = forward_tensors(input, scale, guide, output);
  tensors.winners = {winner.mutable_data_ptr(), pool.taps() > cpu::kMostShortTaps};
  cpu::active_kernels().pools->max_forward(pool, tensors, executor());
  return {output, winner};
}

std::tuple<Tensor, Tensor> surf_max_pool2d_backward(
    const Tensor& grad_output, const Tensor& input, const Tensor& scale,
    const std::optional<Tensor>& guide, const Tensor& winner, double guide_tolerance,
    std::vector<int64_t> kernel_size, std::vector<int64_t> stride, std::vector<int64_t> padding,
    std::vector<int64_t> dilation, bool need_input, bool need_scale) {
  const Pool pool =
      checked(input, scale, guide, guide_tolerance, kernel_size, stride, padding, dilation);
  check_grad_output(grad_output, input, pool);
  STD_TORCH_CHECK(winner.dim() == 4 && winner.size(0) == pool.batch &&
                      winner.size(1) == pool.y.out && winner.size(2) == pool.x.out &&
                      winner.size(3) == pool.channels && winner.is_cpu() &&
                      winner.scalar_type() == winner_dtype(pool),
                  "surf_max_pool2d_backward: winner must be what the forward returned");
  const Tensor dense = torch::stable::contiguous(winner);
  // Only read; the const pointer leaves a lazy copy lazy.
  const cpu::Winners winners{const_cast<void*>(dense.const_data_ptr()),
                             pool.taps() > cpu::kMostShortTaps};
  return run_backward(grad_output, input, scale, guide, winners, pool,
                      cpu::active_kernels().pools->max_backward, need_input, need_scale);
}

Tensor surf_avg_pool2d(const Tensor& input, const Tensor& scale, const std::optional<Tensor>& guide,
                       double guide_tolerance, std::vector<int64_t> kernel_size,
                       std::vector<int64_t> stride, std::vector<int64_t> padding,
                       bool count_include_pad, int64_t divisor_override) {
  const Pool pool = checked(input, scale, guide, guide_tolerance, kernel_size, stride, padding,
                            {1, 1}, divisor_override, count_include_pad);
  Tensor output = empty_as(input, {pool.batch, pool.channels, pool.y.out, pool.x.out}, input);
  if (output.numel() == 0) return output;
  const cpu::PoolForwardTensors tensors = forward_tensors(input, scale, guide, output);
  cpu::active_kernels().pools->avg_forward(pool, tensors, executor());
  return output;
}

std::tuple<Tensor, Tensor> surf_avg_pool2d_backward(
    const Tensor& grad_output, const Tensor& input, const Tensor& scale,
    const std::optional<Tensor>& guide, double guide_tolerance, std::vector<int64_t> kernel_size,
    std::vector<int64_t> stride, std::vector<int64_t> padding, bool count_include_pad,
    int64_t divisor_override, bool need_input, bool need_scale) {
  const Pool pool = checked(input, scale, guide, guide_tolerance, kernel_size, stride, padding,
                            {1, 1}, divisor_override, count_include_pad);
  check_grad_output(grad_output, input, pool);
  return run_backward(grad_output, input, scale, guide, {}, pool,
                      cpu::active_kernels().pools->avg_backward, need_input, need_scale);
}

}  // namespace surfconv
