#define SURFCONV_UNIT "../kernel/unit_forward.inl"
#include "default.inl"
