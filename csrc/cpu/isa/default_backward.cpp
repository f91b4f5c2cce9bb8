#define SURFCONV_UNIT "../kernel/unit_backward.inl"
#include "default.inl"
