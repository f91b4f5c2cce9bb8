#include "tensors.h"

#include <torch/csrc/stable/ops.h>
#include <torch/headeronly/core/MemoryFormat.h>
#include <torch/headeronly/core/ScalarType.h>
#include <torch/headeronly/util/Exception.h>

#include "cpu/memory.h"

namespace surfconv {

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
      STD_TORCH_CHECK(false, "surfconv: ", name, " must be float32, float64, bfloat16 or float16");
  }
  return DType::f32;
}

View view_of(const Tensor& tensor, const char* name, bool written) {
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
  STD_TORCH_CHECK(dtype == DType::f32 || dtype == dtype_of(input, "input"), "surfconv: ", name,
                  " must be float32 or have the input's dtype");
  STD_TORCH_CHECK(tensor.is_cpu(), "surfconv: ", name, " must be on the CPU");
}

Axis checked_axis(int64_t size, int64_t out, int64_t kernel, int64_t stride, int64_t padding,
                  int64_t dilation) {
  constexpr int64_t kMost = int64_t{1} << 40;
  STD_TORCH_CHECK(size > 0 && kernel > 0, "surfconv: empty image or kernel");
  STD_TORCH_CHECK(stride > 0 && dilation > 0 && padding >= 0,
                  "surfconv: stride and dilation must be positive, padding not negative");
  STD_TORCH_CHECK(dilation < kMost / kernel && padding < kMost && stride < kMost / (out + 1),
                  "surfconv: stride, padding or dilation out of range");
  return {size, out, kernel, stride, padding, dilation};
}

namespace {

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

}  // namespace

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
  return {static_cast<int>(torch::stable::get_num_threads()), cpu::second_level_cache(), run};
}

}  // namespace surfconv
