// Compiles SURFCONV_UNIT for one instruction set. Every header stands before the pragma, so that no
// shared inline function is compiled for it.
#include "../kernel/headers.h"

#if defined(SURFCONV_X86)

#pragma GCC push_options
#pragma GCC target("avx512f,avx512bw,avx512dq,avx512vl,avx2,fma,f16c")

#define SURFCONV_ISA avx512_isa
#define SURFCONV_VECTOR_BYTES 64
#define SURFCONV_GEMM_ROWS 12
#define SURFCONV_GEMM_FETCHES true
#include SURFCONV_UNIT

#pragma GCC pop_options

#endif
