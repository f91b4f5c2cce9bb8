#include "level_values.h"

#include <torch/csrc/stable/ops.h>
#include <torch/headeronly/core/ScalarType.h>
#include <torch/headeronly/util/Exception.h>

#include <vector>

#include "cpu/level_values.h"

namespace surfconv {
namespace {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;

template <class T>
void run(const Tensor& depth, const Tensor& edges, const Tensor& values, Tensor& out) {
  constexpr int64_t kGrain = 16384;
  const T* from = static_cast<const T*>(depth.const_data_ptr());
  T* to = static_cast<T*>(out.mutable_data_ptr());
  torch::stable::parallel_for(0, depth.numel(), kGrain, [&](int64_t begin, int64_t end) {
    cpu::level_values(from + begin, end - begin, static_cast<const T*>(edges.const_data_ptr()),
                      static_cast<const T*>(values.const_data_ptr()), values.numel() - 1,
                      to + begin);
  });
}

}  // namespace

Tensor level_values(const Tensor& depth, const Tensor& edges, const Tensor& values) {
  const ScalarType dtype = depth.scalar_type();
  STD_TORCH_CHECK(dtype == ScalarType::Float || dtype == ScalarType::Double,
                  "level_values: depth must be float32 or float64");
  STD_TORCH_CHECK(edges.scalar_type() == dtype && values.scalar_type() == dtype,
                  "level_values: edges and values must have the depth's dtype");
  STD_TORCH_CHECK(depth.is_cpu() && edges.is_cpu() && values.is_cpu(),
                  "level_values: tensors must be on the CPU");
  STD_TORCH_CHECK(edges.dim() == 1 && values.dim() == 1 && values.numel() == edges.numel() + 2,
                  "level_values: N levels have N - 1 edges and N + 1 values");
  STD_TORCH_CHECK(edges.is_contiguous() && values.is_contiguous(),
                  "level_values: edges and values must be contiguous");
  const auto sizes = depth.sizes();
  Tensor out = torch::stable::empty(std::vector<int64_t>(sizes.begin(), sizes.end()), dtype);
  const Tensor dense = torch::stable::contiguous(depth);
  dtype == ScalarType::Double ? run<double>(dense, edges, values, out)
                              : run<float>(dense, edges, values, out);
  return out;
}

}  // namespace surfconv
