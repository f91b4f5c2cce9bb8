#define SURFCONV_UNIT "../kernel/unit_pools.inl"
#include "avx512.inl"
