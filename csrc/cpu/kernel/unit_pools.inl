// The pools, included once per instruction set, see cpu/isa.
namespace surfconv::cpu::SURFCONV_ISA {

#include "vec.inl"
#include "workspace.inl"
#include "planes.inl"
#include "pixels.inl"
#include "axis.inl"
#include "prefetch.inl"
#include "pool_axis.inl"
#include "pool_corners.inl"
#include "pool_samples.inl"
#include "pool_images.inl"
#include "pool_forward.inl"
#include "pool_gradients.inl"
#include "pool_backward.inl"

}  // namespace surfconv::cpu::SURFCONV_ISA
