// The kernels of cpu/kernel/ compiled for one instruction set. Every header stands before the
// pragma, so that no shared inline function is compiled for it.
#include "kernel/headers.h"

#if defined(SURFCONV_X86)

#pragma GCC push_options
#pragma GCC target("avx512f,avx512bw,avx512dq,avx512vl,avx2,fma,f16c")

#define SURFCONV_ISA avx512_isa
#define SURFCONV_VECTOR_BYTES 64
#define SURFCONV_GEMM_ROWS 6
#define SURFCONV_GEMM_NARROW_ROWS 6
#include "kernel/all.inl"

#pragma GCC pop_options

namespace surfconv::cpu {

extern const Kernels kernels_avx512;
const Kernels kernels_avx512 = {"avx512", avx512_isa::forward, avx512_isa::backward,
                                &avx512_isa::pool_kernels};

}  // namespace surfconv::cpu

#endif
