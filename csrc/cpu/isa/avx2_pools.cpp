#define SURFCONV_UNIT "../kernel/unit_pools.inl"
#include "avx2.inl"
