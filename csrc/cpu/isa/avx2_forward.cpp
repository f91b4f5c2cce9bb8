#define SURFCONV_UNIT "../kernel/unit_forward.inl"
#include "avx2.inl"
