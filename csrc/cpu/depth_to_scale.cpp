#include "depth_to_scale.h"

#include <limits>

#include "valid_depth.h"

namespace surfconv::cpu {
namespace {

// Masks are combined without branches, so that the loops vectorise; products and quotients are
// those of the PyTorch form, so that both give the same bits.
template <class T>
void forward(const T* __restrict depth, int64_t count, const ScaleRule<T> rule,
             T* __restrict scale) {
  for (int64_t i = 0; i < count; ++i) {
    const T z = depth[i];
    const T wanted = (T(1) / z) * rule.reference;
    const T raised = wanted < rule.low ? rule.low : wanted;
    const T bounded = raised > rule.high ? rule.high : raised;
    scale[i] = is_valid_depth(z) ? bounded : rule.invalid;
  }
}

template <class T>
void backward(const T* __restrict grad, const T* __restrict depth, int64_t count,
              const ScaleRule<T> rule, T* __restrict out) {
  constexpr T largest = std::numeric_limits<T>::max();
  for (int64_t i = 0; i < count; ++i) {
    const T z = depth[i];
    const T inverse = T(1) / z, wanted = inverse * rule.reference, square = inverse * inverse;
    const T product = -(grad[i] * rule.reference) * square;
    // One selection after the other: g++ turns a longer condition into branches.
    T kept = is_valid_depth(z) ? product : T(0);
    kept = (wanted >= rule.low) & (wanted <= rule.high) ? kept : T(0);
    out[i] = (wanted / z <= rule.steepest) & (square <= largest) ? kept : T(0);
  }
}

}  // namespace

void depth_to_scale(const float* depth, int64_t count, const ScaleRule<float>& rule, float* scale) {
  forward(depth, count, rule, scale);
}
void depth_to_scale(const double* depth, int64_t count, const ScaleRule<double>& rule,
                    double* scale) {
  forward(depth, count, rule, scale);
}

void depth_to_scale_backward(const float* grad, const float* depth, int64_t count,
                             const ScaleRule<float>& rule, float* out) {
  backward(grad, depth, count, rule, out);
}
void depth_to_scale_backward(const double* grad, const double* depth, int64_t count,
                             const ScaleRule<double>& rule, double* out) {
  backward(grad, depth, count, rule, out);
}

}  // namespace surfconv::cpu
