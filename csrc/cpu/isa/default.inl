// Compiles SURFCONV_UNIT for what every processor has.
#include "../kernel/headers.h"

#define SURFCONV_ISA default_isa
#define SURFCONV_VECTOR_BYTES 16
#define SURFCONV_GEMM_ROWS 6
#define SURFCONV_GEMM_FETCHES false
#include SURFCONV_UNIT
