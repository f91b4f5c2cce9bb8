// Schemas and registration. Tensors are positional: torch's generated rules refuse keyword-only
// ones. Full error messages live in the Python validator that every backend shares.
#include <torch/csrc/stable/library.h>

#include "depth_to_scale.h"
#include "level_values.h"
#include "nearest_depth.h"
#include "surf_conv2d.h"
#include "surf_pool2d.h"

STABLE_TORCH_LIBRARY(surfconv, m) {
  m.def(
      "surf_conv2d(Tensor input, Tensor weight, Tensor? bias, Tensor scale, Tensor? guide, "
      "float guide_tolerance, int[] stride, int[] padding, int[] dilation, int groups) -> Tensor");
  m.def(
      "surf_conv2d_backward(Tensor grad_output, Tensor input, Tensor weight, Tensor scale, "
      "Tensor? guide, float guide_tolerance, int[] stride, int[] padding, int[] dilation, "
      "int groups, bool need_input, bool need_weight, bool need_bias, bool need_scale) "
      "-> (Tensor, Tensor, Tensor, Tensor)");
  m.def("level_values(Tensor depth, Tensor edges, Tensor values) -> Tensor");
  m.def("nearest_depth(Tensor depth, int height, int width) -> Tensor");
  m.def(
      "depth_to_scale(Tensor depth, float reference_depth, float invalid, float low, float high, "
      "float steepest) -> Tensor");
  m.def(
      "depth_to_scale_backward(Tensor grad, Tensor depth, float reference_depth, float low, "
      "float high, float steepest) -> Tensor");
  m.def(
      "surf_max_pool2d(Tensor input, Tensor scale, Tensor? guide, float guide_tolerance, "
      "int[] kernel_size, int[] stride, int[] padding, int[] dilation) -> (Tensor, Tensor)");
  m.def(
      "surf_max_pool2d_backward(Tensor grad_output, Tensor input, Tensor scale, Tensor? guide, "
      "Tensor winner, float guide_tolerance, int[] kernel_size, int[] stride, int[] padding, "
      "int[] dilation, bool need_input, bool need_scale) -> (Tensor, Tensor)");
  m.def(
      "surf_avg_pool2d(Tensor input, Tensor scale, Tensor? guide, float guide_tolerance, "
      "int[] kernel_size, int[] stride, int[] padding, bool count_include_pad, "
      "int divisor_override) -> Tensor");
  m.def(
      "surf_avg_pool2d_backward(Tensor grad_output, Tensor input, Tensor scale, Tensor? guide, "
      "float guide_tolerance, int[] kernel_size, int[] stride, int[] padding, "
      "bool count_include_pad, int divisor_override, bool need_input, bool need_scale) "
      "-> (Tensor, Tensor)");
  m.def("cpu_capability() -> str");
}

STABLE_TORCH_LIBRARY_IMPL(surfconv, CPU, m) {
  m.impl("surf_conv2d", TORCH_BOX(&surfconv::surf_conv2d));
  m.impl("surf_conv2d_backward", TORCH_BOX(&surfconv::surf_conv2d_backward));
  m.impl("level_values", TORCH_BOX(&surfconv::level_values));
  m.impl("nearest_depth", TORCH_BOX(&surfconv::nearest_depth));
  m.impl("depth_to_scale", TORCH_BOX(&surfconv::depth_to_scale));
  m.impl("depth_to_scale_backward", TORCH_BOX(&surfconv::depth_to_scale_backward));
  m.impl("surf_max_pool2d", TORCH_BOX(&surfconv::surf_max_pool2d));
  m.impl("surf_max_pool2d_backward", TORCH_BOX(&surfconv::surf_max_pool2d_backward));
  m.impl("surf_avg_pool2d", TORCH_BOX(&surfconv::surf_avg_pool2d));
  m.impl("surf_avg_pool2d_backward", TORCH_BOX(&surfconv::surf_avg_pool2d_backward));
}

STABLE_TORCH_LIBRARY_IMPL(surfconv, CompositeExplicitAutograd, m) {
  m.impl("cpu_capability", TORCH_BOX(&surfconv::cpu_capability));
}
