#include "nearest_depth.h"

#include <torch/csrc/stable/ops.h>
#include <torch/headeronly/core/ScalarType.h>
#include <torch/headeronly/util/Exception.h>

#include <algorithm>

#include "cpu/nearest_depth.h"

namespace surfconv {
namespace {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;

template <class T>
void run(const Tensor& depth, const cpu::Resizing& sizes, int64_t images, Tensor& out) {
  constexpr int64_t kGrain = 16384;  // pixels of depth
  const int64_t of_row = std::max<int64_t>(1, depth.numel() / (images * sizes.height));
  const T* from = static_cast<const T*>(depth.const_data_ptr());
  int64_t* to = static_cast<int64_t*>(out.mutable_data_ptr());
  torch::stable::parallel_for(
      0, images * sizes.height, (kGrain + of_row - 1) / of_row,
      [&](int64_t begin, int64_t end) { cpu::nearest_depth(from, sizes, begin, end, to); });
}

}  // namespace

Tensor nearest_depth(const Tensor& depth, int64_t height, int64_t width) {
  const ScalarType dtype = depth.scalar_type();
  STD_TORCH_CHECK(dtype == ScalarType::Float || dtype == ScalarType::Double,
                  "nearest_depth: depth must be float32 or float64");
  STD_TORCH_CHECK(depth.is_cpu(), "nearest_depth: depth must be on the CPU");
  STD_TORCH_CHECK(depth.dim() == 3 && depth.size(1) > 0 && depth.size(2) > 0,
                  "nearest_depth: depth must be (N, H, W), of at least one pixel each");
  const cpu::Resizing sizes{depth.size(1), depth.size(2), height, width};
  constexpr int64_t kMost = int64_t{1} << 30;
  STD_TORCH_CHECK(height > 0 && width > 0 && height < kMost && width < kMost &&
                      sizes.rows < kMost && sizes.columns < kMost,
                  "nearest_depth: height or width out of range");
  Tensor out = torch::stable::empty({depth.size(0), height, width}, ScalarType::Long);
  if (out.numel() == 0) return out;
  const Tensor dense = torch::stable::contiguous(depth);
  dtype == ScalarType::Double ? run<double>(dense, sizes, depth.size(0), out)
                              : run<float>(dense, sizes, depth.size(0), out);
  return out;
}

}  // namespace surfconv
