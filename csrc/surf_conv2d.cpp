#include "surf_conv2d.h"

#include <torch/csrc/stable/ops.h>
#include <torch/headeronly/core/MemoryFormat.h>
#include <torch/headeronly/core/ScalarType.h>
#include <torch/headeronly/util/Exception.h>

#include "cpu/surf_conv2d.h"

namespace surfconv {
namespace {

using cpu::DType;
using cpu::View;
using torch::headeronly::MemoryFormat;
using torch::headeronly::ScalarType;

DType dtype_of(const Tensor& tensor, const char* name) {
  switch (tensor.scalar_type()) {
    case ScalarType::Float:
      return DType::f32;
    case ScalarType::Double:
      return DType::f64;
    case ScalarType::BFloat16:
      return DType::bf16;
    case ScalarType::Half:
      return DType::f16;
    default:
      STD_TORCH_CHECK(false, "surf_conv2d: ", name,
                      " must be float32, float64, bfloat16 or float16");
  }
  return DType::f32;
}

View view_of(const Tensor& tensor, const char* name, bool written = false) {
  View view;
  // The kernels only read what is not written; the const pointer leaves a lazy copy lazy.
  view.data = written ? tensor.mutable_data_ptr() : const_cast<void*>(tensor.const_data_ptr());
  view.dtype = dtype_of(tensor, name);
  const auto strides = tensor.strides();
  switch (tensor.dim()) {
    case 4:
      view.n = strides[0], view.c = strides[1], view.y = strides[2], view.x = strides[3];
      break;
    case 3:  // a guide
      view.n = strides[0], view.y = strides[1], view.x = strides[2];
      break;
    default:  // a bias
      view.c = strides[0];
  }
  return view;
}

void check_scale_like(const Tensor& tensor, const Tensor& input, const char* name) {
  const DType dtype = dtype_of(tensor, name);
  STD_TORCH_CHECK(dtype == DType::f32 || dtype == dtype_of(input, "input"), "surf_conv2d: ", name,
                  " must be float32 or have the input's dtype");
  STD_TORCH_CHECK(tensor.is_cpu(), "surf_conv2d: ", name, " must be on the CPU");
}

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
  const auto axis = [&](int64_t d) {
    constexpr int64_t kMost = int64_t{1} << 40;
    const int64_t size = input.size(2 + d), kernel = weight.size(2 + d);
    STD_TORCH_CHECK(size > 0 && kernel > 0, "surf_conv2d: empty image or kernel");
    STD_TORCH_CHECK(stride[d] > 0 && dilation[d] > 0 && padding[d] >= 0,
                    "surf_conv2d: stride and dilation must be positive, padding not negative");
    STD_TORCH_CHECK(dilation[d] < kMost / kernel && padding[d] < kMost &&
                        stride[d] < kMost / (scale.size(2 + d) + 1),
                    "surf_conv2d: stride, padding or dilation out of range");
    return Axis{size, scale.size(2 + d), kernel, stride[d], padding[d], dilation[d]};
  };
  return {axis(0),        axis(1), input.size(0), input.size(1),
          weight.size(0), groups,  scale.size(1), guide_tolerance};
}

bool channels_last(const Tensor& tensor) {
  if (tensor.dim() != 4 || tensor.is_contiguous()) return false;
  const int64_t order[] = {1, 3, 2, 0};
  int64_t expected = 1;
  for (int64_t d : order) {
    if (tensor.size(d) != 1 && tensor.stride(d) != expected) return false;
    expected *= tensor.size(d);
  }
  return true;
}

Tensor empty_as(const Tensor& like, const std::vector<int64_t>& sizes, const Tensor& layout) {
  const auto format = channels_last(layout) ? MemoryFormat::ChannelsLast : MemoryFormat::Contiguous;
  return torch::stable::empty(sizes, like.scalar_type(), std::nullopt, std::nullopt, std::nullopt,
                              format);
}

Tensor absent(const Tensor& like) { return torch::stable::empty({0}, like.scalar_type()); }

std::vector<int64_t> sizes_of(const Tensor& tensor) {
  const auto sizes = tensor.sizes();
  return {sizes.begin(), sizes.end()};
}

cpu::Executor executor() {
  const auto run = [](int workers, void (*body)(void*, int), void* context) {
    torch::stable::parallel_for(0, workers, 1, [&](int64_t begin, int64_t end) {
      for (int64_t worker = begin; worker < end; ++worker) body(context, static_cast<int>(worker));
    });
  };
  return {static_cast<int>(torch::stable::get_num_threads()), run};
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
