// The convolution's forward, included once per instruction set, see cpu/isa.
namespace surfconv::cpu::SURFCONV_ISA {

#include "vec.inl"
#include "workspace.inl"
#include "planes.inl"
#include "pixels.inl"
#include "guide.inl"
#include "axis.inl"
#include "corners.inl"
#include "tile.inl"
#include "tiles.inl"
#include "prefetch.inl"
#include "gemm.inl"
#include "lanewise.inl"
#include "blocks.inl"
#include "weights.inl"
#include "passes.inl"
#include "walk.inl"
#include "seen.inl"
#include "gather.inl"
#include "lane_forward.inl"
#include "few_forward.inl"
#include "shares.inl"
#include "pointwise_pixels.inl"
#include "pointwise_forward.inl"
#include "forward.inl"

}  // namespace surfconv::cpu::SURFCONV_ISA
