// The convolution's backward, included once per instruction set, see cpu/isa. It takes the longest
// to compile: double has a file of its own.
namespace surfconv::cpu::SURFCONV_ISA {

#include "vec.inl"
#include "workspace.inl"
#include "planes.inl"
#include "pixels.inl"
#include "guide.inl"
#include "axis.inl"
#include "prefetch.inl"
#include "corners.inl"
#include "tile.inl"
#include "tiles.inl"
#include "gemm.inl"
#include "lanewise.inl"
#include "blocks.inl"
#include "weights.inl"
#include "passes.inl"
#include "walk.inl"
#include "seen.inl"
#include "gather.inl"
#include "scatter.inl"
#include "scatter_walk.inl"
#include "pointwise_pixels.inl"
#include "partials.inl"
#include "bands.inl"
#include "gradient_rows.inl"
#include "output_gradient.inl"
#include "pointwise_backward.inl"
#include "backward_tiles.inl"
#include "backward.inl"

#if defined(SURFCONV_DOUBLE)
template void run_backward<double>(const Conv&, const BackwardTensors&, const Executor&);
#else
extern template void run_backward<double>(const Conv&, const BackwardTensors&, const Executor&);

void backward(const Conv& conv, const BackwardTensors& tensors, const Executor& executor) {
  if (tensors.input.dtype == DType::f64) {
    run_backward<double>(conv, tensors, executor);
  } else {
    run_backward<float>(conv, tensors, executor);
  }
}
#endif

}  // namespace surfconv::cpu::SURFCONV_ISA
