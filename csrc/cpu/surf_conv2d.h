// Torch-free interface of the CPU kernels: raw pointers, strides and sizes.
#pragma once

#include <cstdint>

#include "../geometry.h"

#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#define SURFCONV_X86 1
#endif

namespace surfconv::cpu {

enum class DType { f32, f64, bf16, f16 };

// A tensor of four dimensions; strides in elements. data is null where the tensor is absent.
struct View {
  void* data = nullptr;
  DType dtype = DType::f32;
  int64_t n = 0, c = 0, y = 0, x = 0;
};

struct Conv {
  Axis y, x;
  int64_t batch, in_channels, out_channels, groups;
  int64_t scale_components;  // 1, or 2 for (y, x)
  double guide_tolerance;
};

struct ForwardTensors {
  View input;
  View weight;  // n: output channel, c: input channel of the group
  View bias;    // c
  View scale;   // c: component
  View guide;
  View output;
};

// Gradients with null data are not computed.
struct BackwardTensors {
  View grad_output, input, weight, scale, guide;
  View grad_input, grad_weight, grad_bias, grad_scale;
};

// Runs body(worker) for worker = 0 .. workers-1, at most `threads` at a time, and waits. The
// kernels share their work through a queue, so a runner may also call the workers one by one.
struct Executor {
  int threads;
  int64_t cache;  // bytes of it that each worker has to itself: decides what is computed together
  void (*run)(int workers, void (*body)(void* context, int worker), void* context);
};

struct PoolKernels;

struct Kernels {
  const char* name;
  void (*forward)(const Conv&, const ForwardTensors&, const Executor&);
  void (*backward)(const Conv&, const BackwardTensors&, const Executor&);
  const PoolKernels* pools;
};

// One entry per instruction set that was compiled and that this processor runs, weakest first:
// the list itself stands in dispatch.cpp.
int kernel_count();
const Kernels& kernels(int index);

// The strongest entry that ATEN_CPU_CAPABILITY allows; read once.
const Kernels& active_kernels();

}  // namespace surfconv::cpu
