// Torch-free interface of the scale that a depth gives, and of its derivative.
#pragma once

#include <cstdint>

namespace surfconv::cpu {

// What turns a depth z into scale = reference / z, computed as (1 / z) * reference.
template <class T>
struct ScaleRule {
  T reference;
  T invalid;    // scale where z is not positive and finite
  T low, high;  // limits of the scale elsewhere
  T steepest;   // derivatives of a larger magnitude do not flow
};

void depth_to_scale(const float* depth, int64_t count, const ScaleRule<float>& rule, float* scale);
void depth_to_scale(const double* depth, int64_t count, const ScaleRule<double>& rule,
                    double* scale);

// out = grad * derivative; zero where the depth is invalid, the scale is strictly outside its
// limits, or the derivative is too steep or not finite.
void depth_to_scale_backward(const float* grad, const float* depth, int64_t count,
                             const ScaleRule<float>& rule, float* out);
void depth_to_scale_backward(const double* grad, const double* depth, int64_t count,
                             const ScaleRule<double>& rule, double* out);

}  // namespace surfconv::cpu
