// Re-included once per instruction set, see isa_*.cpp.
namespace surfconv::cpu::SURFCONV_ISA {

#include "vec.inl"
#include "workspace.inl"
#include "pixels.inl"
#include "guide.inl"
#include "samples.inl"
#include "tile.inl"
#include "gemm.inl"
#include "lanewise.inl"
#include "blocks.inl"
#include "passes.inl"
#include "walk.inl"
#include "gather.inl"
#include "lane_forward.inl"
#include "scatter.inl"
#include "scatter_interior.inl"
#include "pointwise_pixels.inl"
#include "pointwise.inl"
#include "forward.inl"
#include "bands.inl"
#include "gradient_rows.inl"
#include "output_gradient.inl"
#include "pointwise_backward.inl"
#include "backward_tile.inl"
#include "backward.inl"
#include "pool_axis.inl"
#include "pool_corners.inl"
#include "pool_samples.inl"
#include "pool_images.inl"
#include "pool_forward.inl"
#include "pool_gradients.inl"
#include "pool_backward.inl"

}  // namespace surfconv::cpu::SURFCONV_ISA

#undef SURFCONV_ISA
#undef SURFCONV_VECTOR_BYTES
#undef SURFCONV_GEMM_ROWS
#undef SURFCONV_GEMM_NARROW_ROWS
