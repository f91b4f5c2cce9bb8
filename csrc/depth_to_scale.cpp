#include "depth_to_scale.h"

#include <torch/csrc/stable/ops.h>
#include <torch/headeronly/core/ScalarType.h>
#include <torch/headeronly/util/Exception.h>

#include <cmath>
#include <limits>
#include <vector>

#include "cpu/depth_to_scale.h"

namespace surfconv {
namespace {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;

struct Numbers {
  double reference, invalid, low, high, steepest;
};

constexpr int64_t kGrain = 16384;

template <class T>
cpu::ScaleRule<T> rule_of(const Numbers& numbers) {
  constexpr double most = std::numeric_limits<T>::max();
  STD_TORCH_CHECK(std::abs(numbers.invalid) <= most && std::abs(numbers.low) <= most,
                  "depth_to_scale: invalid and low must be finite in the depth's dtype");
  const auto narrow = [](double value) {
    // What does not fit is infinity, as it is to PyTorch's scalars; the cast alone is undefined.
    if (std::abs(value) <= most) return static_cast<T>(value);
    const T infinity = std::numeric_limits<T>::infinity();
    return value < 0 ? -infinity : infinity;
  };
  return {narrow(numbers.reference), narrow(numbers.invalid), narrow(numbers.low),
          narrow(numbers.high), narrow(numbers.steepest)};
}

void check_depth(const Tensor& depth) {
  const ScalarType dtype = depth.scalar_type();
  STD_TORCH_CHECK(dtype == ScalarType::Float || dtype == ScalarType::Double,
                  "depth_to_scale: depth must be float32 or float64");
  STD_TORCH_CHECK(depth.is_cpu(), "depth_to_scale: depth must be on the CPU");
}

// Contiguous whatever the depth's strides are.
Tensor empty_of(const Tensor& depth) {
  const auto sizes = depth.sizes();
  return torch::stable::empty(std::vector<int64_t>(sizes.begin(), sizes.end()),
                              depth.scalar_type());
}

template <class T>
const T* data_of(const Tensor& tensor) {
  return static_cast<const T*>(tensor.const_data_ptr());
}

template <class T>
void run(const Tensor& depth, const Numbers& numbers, Tensor& out) {
  const cpu::ScaleRule<T> rule = rule_of<T>(numbers);
  const T* z = data_of<T>(depth);
  T* to = static_cast<T*>(out.mutable_data_ptr());
  torch::stable::parallel_for(0, depth.numel(), kGrain, [&](int64_t begin, int64_t end) {
    cpu::depth_to_scale(z + begin, end - begin, rule, to + begin);
  });
}

template <class T>
void run_backward(const Tensor& grad, const Tensor& depth, const Numbers& numbers, Tensor& out) {
  const cpu::ScaleRule<T> rule = rule_of<T>(numbers);
  const T *g = data_of<T>(grad), *z = data_of<T>(depth);
  T* to = static_cast<T*>(out.mutable_data_ptr());
  torch::stable::parallel_for(0, depth.numel(), kGrain, [&](int64_t begin, int64_t end) {
    cpu::depth_to_scale_backward(g + begin, z + begin, end - begin, rule, to + begin);
  });
}

bool same_sizes(const Tensor& a, const Tensor& b) {
  if (a.dim() != b.dim()) return false;
  for (int64_t d = 0; d < a.dim(); ++d) {
    if (a.size(d) != b.size(d)) return false;
  }
  return true;
}

}  // namespace

Tensor depth_to_scale(const Tensor& depth, double reference, double invalid, double low,
                      double high, double steepest) {
  check_depth(depth);
  const Numbers numbers{reference, invalid, low, high, steepest};
  Tensor out = empty_of(depth);
  const Tensor dense = torch::stable::contiguous(depth);
  depth.scalar_type() == ScalarType::Double ? run<double>(dense, numbers, out)
                                            : run<float>(dense, numbers, out);
  return out;
}

Tensor depth_to_scale_backward(const Tensor& grad, const Tensor& depth, double reference,
                               double low, double high, double steepest) {
  check_depth(depth);
  STD_TORCH_CHECK(
      grad.is_cpu() && grad.scalar_type() == depth.scalar_type() && same_sizes(grad, depth),
      "depth_to_scale_backward: grad must have the depth's shape, dtype and device");
  const Numbers numbers{reference, 0.0, low, high, steepest};
  Tensor out = empty_of(depth);
  const Tensor dense_grad = torch::stable::contiguous(grad);
  const Tensor dense = torch::stable::contiguous(depth);
  depth.scalar_type() == ScalarType::Double ? run_backward<double>(dense_grad, dense, numbers, out)
                                            : run_backward<float>(dense_grad, dense, numbers, out);
  return out;
}

}  // namespace surfconv
