// Binds the kernels of csrc/cpu/ to Python, for tests alone: NumPy arrays of any strides go in, and
// results are written into arrays that the test made (and poisoned).
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <array>
#include <optional>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#include "cpu/surf_conv2d.h"

namespace py = pybind11;
using namespace surfconv;
using Array = std::optional<py::array>;
using Pair = std::array<int64_t, 2>;

namespace {

cpu::DType dtype_of(const py::array& array) {
  switch (array.dtype().char_()) {
    case 'f':
      return cpu::DType::f32;
    case 'd':
      return cpu::DType::f64;
    case 'e':
      return cpu::DType::f16;
    case 'h':  // NumPy has no bfloat16: its bits come as int16
      return cpu::DType::bf16;
    default:
      throw std::invalid_argument("no kernel takes this dtype");
  }
}

cpu::View view_of(const Array& array, bool written) {
  cpu::View view;
  if (!array) return view;
  view.data =
      written ? const_cast<py::array&>(*array).mutable_data() : const_cast<void*>(array->data());
  view.dtype = dtype_of(*array);
  const auto stride = [&](int d) { return array->strides(d) / array->itemsize(); };
  switch (array->ndim()) {
    case 4:
      view.n = stride(0), view.c = stride(1), view.y = stride(2), view.x = stride(3);
      break;
    case 3:
      view.n = stride(0), view.y = stride(1), view.x = stride(2);
      break;
    case 1:
      view.c = stride(0);
      break;
    default:
      throw std::invalid_argument("an array has 4, 3 or 1 dimensions here");
  }
  return view;
}

const cpu::Kernels& find(const std::string& name) {
  for (int i = 0; i < cpu::kernel_count(); ++i) {
    if (cpu::kernels(i).name == name) return cpu::kernels(i);
  }
  throw std::invalid_argument("this processor does not run " + name);
}

struct Arguments {
  Pair stride, padding, dilation;
  int64_t groups;
  double guide_tolerance;

  cpu::Conv conv(const py::array& input, const py::array& weight, const py::array& scale) const {
    const auto axis = [&](int d) {
      return Axis{input.shape(2 + d), scale.shape(2 + d), weight.shape(2 + d),
                  stride[d],          padding[d],         dilation[d]};
    };
    return {axis(0),         axis(1), input.shape(0), input.shape(1),
            weight.shape(0), groups,  scale.shape(1), guide_tolerance};
  }
};

using Body = void (*)(void*, int);

void run_in_threads(int workers, Body body, void* context) {
  std::vector<std::thread> threads;
  for (int i = 0; i < workers; ++i) threads.emplace_back(body, context, i);
  for (std::thread& thread : threads) thread.join();
}

// The order least like the one that threads would take.
void run_backwards(int workers, Body body, void* context) {
  while (workers-- > 0) body(context, workers);
}

cpu::Executor executor(int threads, bool in_turn, int64_t cache) {
  return {threads, cache, in_turn ? run_backwards : run_in_threads};
}

void forward(const std::string& name, const py::array& input, const py::array& weight,
             const Array& bias, const py::array& scale, const Array& guide, const py::array& output,
             const Arguments& arguments, int threads, bool in_turn, int64_t cache) {
  const cpu::ForwardTensors tensors{view_of(input, false), view_of(weight, false),
                                    view_of(bias, false),  view_of(scale, false),
                                    view_of(guide, false), view_of(output, true)};
  const cpu::Conv conv = arguments.conv(input, weight, scale);
  const cpu::Kernels& kernels = find(name);
  py::gil_scoped_release release;
  kernels.forward(conv, tensors, executor(threads, in_turn, cache));
}

void backward(const std::string& name, const py::array& grad_output, const py::array& input,
              const py::array& weight, const py::array& scale, const Array& guide,
              const Array& grad_input, const Array& grad_weight, const Array& grad_bias,
              const Array& grad_scale, const Arguments& arguments, int threads, bool in_turn,
              int64_t cache) {
  const cpu::BackwardTensors tensors{
      view_of(grad_output, false), view_of(input, false),    view_of(weight, false),
      view_of(scale, false),       view_of(guide, false),    view_of(grad_input, true),
      view_of(grad_weight, true),  view_of(grad_bias, true), view_of(grad_scale, true)};
  const cpu::Conv conv = arguments.conv(input, weight, scale);
  const cpu::Kernels& kernels = find(name);
  py::gil_scoped_release release;
  kernels.backward(conv, tensors, executor(threads, in_turn, cache));
}

std::vector<std::string> names() {
  std::vector<std::string> found;
  for (int i = 0; i < cpu::kernel_count(); ++i) found.emplace_back(cpu::kernels(i).name);
  return found;
}

}  // namespace

PYBIND11_MODULE(surfconv_kernels, m) {
  py::class_<Arguments>(m, "Arguments")
      .def(py::init([](Pair stride, Pair padding, Pair dilation, int64_t groups, double tolerance) {
        return Arguments{stride, padding, dilation, groups, tolerance};
      }));
  m.def("names", &names);
  m.def("active", [] { return std::string(cpu::active_kernels().name); });
  m.def("forward", &forward);
  m.def("backward", &backward);
}
