#define SURFCONV_UNIT "../kernel/unit_pools.inl"
#include "default.inl"
