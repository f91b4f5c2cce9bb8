#include <cstdlib>
#include <cstring>
#include <vector>

#include "surf_conv2d.h"
#include "surf_pool2d.h"

namespace surfconv::cpu {

// What cpu/isa compiles for each instruction set.
#define SURFCONV_DECLARE(isa)                                          \
  namespace isa {                                                      \
  void forward(const Conv&, const ForwardTensors&, const Executor&);   \
  void backward(const Conv&, const BackwardTensors&, const Executor&); \
  extern const PoolKernels pool_kernels;                               \
  }
#define SURFCONV_KERNELS(name) \
  {#name, name##_isa::forward, name##_isa::backward, &name##_isa::pool_kernels}

SURFCONV_DECLARE(default_isa)
#if defined(SURFCONV_X86)
SURFCONV_DECLARE(avx2_isa)
SURFCONV_DECLARE(avx512_isa)
#endif

namespace {

const Kernels kernels_default = SURFCONV_KERNELS(default);
#if defined(SURFCONV_X86)
const Kernels kernels_avx2 = SURFCONV_KERNELS(avx2);
const Kernels kernels_avx512 = SURFCONV_KERNELS(avx512);
#endif

const std::vector<const Kernels*>& runnable() {
  static const std::vector<const Kernels*> list = [] {
    std::vector<const Kernels*> found{&kernels_default};
#if defined(SURFCONV_X86)
    __builtin_cpu_init();
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) {
      found.push_back(&kernels_avx2);
      if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
          __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl")) {
        found.push_back(&kernels_avx512);
      }
    }
#endif
    return found;
  }();
  return list;
}

}  // namespace

int kernel_count() { return static_cast<int>(runnable().size()); }

const Kernels& kernels(int index) { return *runnable().at(static_cast<size_t>(index)); }

const Kernels& active_kernels() {
  static const Kernels& chosen = []() -> const Kernels& {
    const char* wish = std::getenv("ATEN_CPU_CAPABILITY");
    if (wish != nullptr) {
      for (const Kernels* candidate : runnable()) {
        if (std::strcmp(candidate->name, wish) == 0) return *candidate;
      }
    }
    return *runnable().back();
  }();
  return chosen;
}

}  // namespace surfconv::cpu
