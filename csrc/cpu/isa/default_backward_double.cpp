#define SURFCONV_UNIT "../kernel/unit_backward.inl"
#define SURFCONV_DOUBLE
#include "default.inl"
