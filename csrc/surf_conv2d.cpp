#include "surf_conv2d.h"

#include <torch/csrc/stable/ops.h>
#include <torch/headeronly/util/Exception.h>

#include "cpu/surf_conv2d.h"
#include "tensors.h"

namespace surfconv {
namespace {

// What memory safety needs; the messages a user should see come from the Python validator.
cpu::Conv checked(const Tensor& input, const Tensor& weight, const Tensor& scale,
                  const std::optional<Tensor>& guide, double guide_tolerance,
                  const std::vector<int64_t>& stride, const std::vector<int64_t>& padding,
                  const std::vector<int64_t>& dilation, int64_t groups) {
  STD_TORCH_CHECK(input.dim() == 4 && weight.dim() == 4 && scale.dim() == 4,
                  "surf_conv2d: input, weight and scale must have 4 dimensions");
  STD_TORCH_CHECK(stride.size() == 2 && padding.size() == 2 && dilation.size() == 2,
                  "surf_conv2d: stride, padding and dilation must be (y, x) pairs");
  STD_TORCH_CHECK(input.is_cpu() && weight.is_cpu(), "surf_conv2d: tensors must be on the CPU");
  STD_TORCH_CHECK(input.scalar_type() == weight.scalar_type(),
                  "surf_conv2d: weight must have the input's dtype");
  check_scale_like(scale, input, "scale");
  STD_TORCH_CHECK(groups > 0 && weight.size(0) % groups == 0 && weight.size(1) > 0 &&
                      input.size(1) == weight.size(1) * groups && input.size(1) > 0,
                  "surf_conv2d: channels of input and weight do not match groups");
  STD_TORCH_CHECK(scale.size(0) == input.size(0) && (scale.size(1) == 1 || scale.size(1) == 2),
                  "surf_conv2d: scale must be (N, 1 or 2, Ho, Wo)");
  if (guide.has_value()) {
    check_scale_like(*guide, input, "guide");
    STD_TORCH_CHECK(guide->dim() == 3 && guide->size(0) == input.size(0) &&
                        guide->size(1) == input.size(2) && guide->size(2) == input.size(3),
                    "surf_conv2d: guide must be (N, H, W)");
  }
  const auto axis = [&](size_t d) {
    return checked_axis(input.size(2 + d), scale.size(2 + d), weight.size(2 + d), stride[d],
                        padding[d], dilation[d]);
  };
  return {axis(0),        axis(1), input.size(0), input.size(1),
          weight.size(0), groups,  scale.size(1), guide_tolerance};
}

}  // namespace

Tensor surf_conv2d(const Tensor& input, const Tensor& weight, const std::optional<Tensor>& bias,
                   const Tensor& scale, const std::optional<Tensor>& guide, double guide_tolerance,
                   std::vector<int64_t> stride, std::vector<int64_t> padding,
                   std::vector<int64_t> dilation, int64_t groups) {
  const cpu::Conv conv =
      checked(input, weight, scale, guide, guide_tolerance, stride, padding, dilation, groups);
  if (bias.has_value()) {
    STD_TORCH_CHECK(bias->dim() == 1 && bias->size(0) == weight.size(0) && bias->is_cpu() &&
                        bias->scalar_type() == input.scalar_type(),
                    "surf_conv2d: bias must be (O,) in the input's dtype");
  }
  Tensor output = empty_as(input, {conv.batch, conv.out_channels, conv.y.out, conv.x.out}, input);
  if (output.numel() == 0) return output;
  cpu::ForwardTensors tensors{
      view_of(input, "input"),        view_of(weight, "weight"), {}, view_of(scale, "scale"), {},
      view_of(output, "output", true)};
  if (bias.has_value()) tensors.bias = view_of(*bias, "bias");
  if (guide.has_value()) tensors.guide = view_of(*guide, "guide");
  cpu::active_kernels().forward(conv, tensors, executor());
  return output;
}

std::tuple<Tensor, Tensor, Tensor, Tensor> surf_conv2d_backward(
    const Tensor& grad_output, const Tensor& input, const Tensor& weight, const Tensor& scale,
    const std::optional<Tensor>& guide, double guide_tolerance, std::vector<int64_t> stride,
    std::vector<int64_t> padding, std::vector<int64_t> dilation, int64_t groups, bool need_input,
    bool need_weight, bool need_bias, bool need_scale) {
  const cpu::Conv conv =
      checked(input, weight, scale, guide, guide_tolerance, stride, padding, dilation, groups);
  STD_TORCH_CHECK(grad_output.dim() == 4 && grad_output.size(0) == conv.batch &&
                      grad_output.size(1) == conv.out_channels &&
                      grad_output.size(2) == conv.y.out && grad_output.size(3) == conv.x.out &&
                      grad_output.is_cpu() && grad_output.scalar_type() == input.scalar_type(),
                  "surf_conv2d_backward: grad_output must have the output's shape and dtype");
  Tensor grad_input = need_input ? empty_as(input, sizes_of(input), input) : absent(input);
  Tensor grad_weight = need_weight ? empty_as(weight, sizes_of(weight), weight) : absent(weight);
  Tensor grad_bias =
      need_bias ? torch::stable::empty({conv.out_channels}, weight.scalar_type()) : absent(weight);
  Tensor grad_scale = need_scale ? empty_as(scale, sizes_of(scale), scale) : absent(scale);

  cpu::BackwardTensors tensors{view_of(grad_output, "grad_output"),
                               view_of(input, "input"),
                               view_of(weight, "weight"),
                               view_of(scale, "scale"),
                               {},
                               {},
                               {},
                               {},
                               {}};
  if (guide.has_value()) tensors.guide = view_of(*guide, "guide");
  if (need_input) tensors.grad_input = view_of(grad_input, "grad_input", true);
  if (need_weight) tensors.grad_weight = view_of(grad_weight, "grad_weight", true);
  if (need_bias) tensors.grad_bias = view_of(grad_bias, "grad_bias", true);
  if (need_scale) tensors.grad_scale = view_of(grad_scale, "grad_scale", true);
  cpu::active_kernels().backward(conv, tensors, executor());
  return {grad_input, grad_weight, grad_bias, grad_scale};
}

std::string cpu_capability() { return cpu::active_kernels().name; }

}  // namespace surfconv
