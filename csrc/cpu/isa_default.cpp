// The kernels of cpu/kernel/ compiled for one instruction set. Every header stands before the
// pragma, so that no shared inline function is compiled for it.
#include "kernel/headers.h"

#define SURFCONV_ISA default_isa
#define SURFCONV_VECTOR_BYTES 16
#define SURFCONV_GEMM_ROWS 6
#define SURFCONV_GEMM_NARROW_ROWS 12
#include "kernel/all.inl"

namespace surfconv::cpu {

extern const Kernels kernels_default;
const Kernels kernels_default = {"default", default_isa::forward, default_isa::backward,
                                 &default_isa::pool_kernels};

}  // namespace surfconv::cpu
