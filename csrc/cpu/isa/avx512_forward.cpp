#define SURFCONV_UNIT "../kernel/unit_forward.inl"
#include "avx512.inl"
