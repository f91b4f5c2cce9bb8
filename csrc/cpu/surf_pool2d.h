// Torch-free interface of the pools' CPU kernels.
#pragma once

#include "surf_conv2d.h"

namespace surfconv::cpu {

struct Pool {
  Axis y, x;
  int64_t batch, channels;
  int64_t scale_components;  // 1, or 2 for (y, x)
  double guide_tolerance;
  // Of averages: 0 stands for the window's pixels, or the sum of weights without padding.
  int64_t divisor_override;
  bool count_include_pad;

  int64_t taps() const { return y.kernel * x.kernel; }
};

// The numbers of winning taps, (batch, Ho, Wo, channels); as many as there are taps means none.
struct Winners {
  void* data = nullptr;
  bool wide = false;  // 32 bits, else 8
};
constexpr int64_t kMostShortTaps = 255;

struct PoolForwardTensors {
  View input, scale, guide, output;
  Winners winners;
};

// Gradients with null data are not computed; winners are only read.
struct PoolBackwardTensors {
  View grad_output, input, scale, guide;
  Winners winners;
  View grad_input, grad_scale;
};

struct PoolKernels {
  void (*max_forward)(const Pool&, const PoolForwardTensors&, const Executor&);
  void (*max_backward)(const Pool&, const PoolBackwardTensors&, const Executor&);
  void (*avg_forward)(const Pool&, const PoolForwardTensors&, const Executor&);
  void (*avg_backward)(const Pool&, const PoolBackwardTensors&, const Executor&);
};

}  // namespace surfconv::cpu
