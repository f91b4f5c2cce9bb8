#define SURFCONV_UNIT "../kernel/unit_backward.inl"
#include "avx2.inl"
