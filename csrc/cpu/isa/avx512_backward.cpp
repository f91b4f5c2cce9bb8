#define SURFCONV_UNIT "../kernel/unit_backward.inl"
#include "avx512.inl"
