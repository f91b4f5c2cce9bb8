// Compiles SURFCONV_UNIT for one instruction set. Every header stands before the pragma, so that no
// shared inline function is compiled for it.
#include "../kernel/headers.h"

#if defined(SURFCONV_X86)

#pragma GCC push_options
#pragma GCC target("avx2,fma,f16c")

#define SURFCONV_ISA avx2_isa
#define SURFCONV_VECTOR_BYTES 32
#define SURFCONV_GEMM_ROWS 6
#define SURFCONV_GEMM_FETCHES false
#include SURFCONV_UNIT

#pragma GCC pop_options

#endif
