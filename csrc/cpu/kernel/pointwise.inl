// Forward of kernels of one tap, tile by tile: pixels in place where they can be.
template <class T>
class PointwiseForward {
 public:
  PointwiseForward(const Conv& conv, const ForwardTensors& tensors, const Executor& executor)
      : conv_(conv),
        tensors_(tensors),
        executor_(executor),
        plan_(conv),
        planar_(tensors.input.c != 1),
        width_(planar_ ? round_up(plan_.outputs, 4) : pad_width<T>(plan_.outputs)),
        input_(conv, tensors.input),
        output_(onto_itself(conv), tensors.output) {
    pack();
  }

  void run() {
    const int64_t pixels = conv_.y.out * conv_.x.out, tiles = (pixels + kTile - 1) / kTile;
    const int64_t tasks = conv_.batch * tiles;
    const int workers =
        workers_for(executor_, tasks, conv_.batch * pixels * plan_.channels * conv_.out_channels);
    const int64_t in = kTile * plan_.channels, out = kTile * width_;
    Workspace memory(workers * (Workspace::need<T>(in) + Workspace::need<T>(out)));
    std::vector<Scratch> scratch;
    for (int i = 0; i < workers; ++i) scratch.push_back({memory.take<T>(in), memory.take<T>(out)});
    run_tasks(executor_, tasks, workers, [&](int worker, int64_t task) {
      const int64_t n = task / tiles, begin = task % tiles * kTile;
      const int64_t count = std::min<int64_t>(kTile, pixels - begin);
      for (int64_t g = 0; g < plan_.groups; ++g) {
        planar_ ? planes(scratch[static_cast<size_t>(worker)], n, g, begin, count)
                : rows(scratch[static_cast<size_t>(worker)], n, g, begin, count);
      }
    });
  }

 private:
  struct Scratch {
    T *in, *out;
  };

  T* weights(int64_t group) const { return weights_.get() + group * plan_.channels * width_; }

  void pack() {
    initial_.assign(static_cast<size_t>(plan_.groups * width_), T(0));
    if (tensors_.bias.data != nullptr) {
      visit_storage<T>(tensors_.bias, [&](auto* bias) {
        for (int64_t o = 0; o < conv_.out_channels; ++o) {
          initial_[static_cast<size_t>(o / plan_.outputs * width_ + o % plan_.outputs)] =
              widen(bias[o * tensors_.bias.c]);
        }
      });
    }
    weights_ = Buffer<T>(plan_.groups * plan_.channels * width_);
    const View& weight = tensors_.weight;
    for (int64_t g = 0; g < plan_.groups; ++g) {
      if (!planar_) {
        const ChannelBlock all{g, 0, plan_.channels, plan_.channels};
        pack_forward(weight, 1, plan_, all, 0, 1, weights(g));
        continue;
      }
      visit_storage<T>(weight, [&](auto* data) {
        const auto* filters = data + g * plan_.outputs * weight.n;
        const auto left = [&](int64_t o, int64_t c) {
          return widen(filters[o * weight.n + c * weight.c]);
        };
        pack_rows(width_, plan_.outputs, plan_.channels, left, weights(g));
      });
    }
  }

  void rows(Scratch& scratch, int64_t n, int64_t group, int64_t begin, int64_t count) const {
    const bool exact = count % kRowPad == 0;
    const int64_t channel = group * plan_.channels, first = group * plan_.outputs;
    const T* in = exact ? input_.rows_in_place(n, channel, begin) : nullptr;
    int64_t ld = input_.pixel_step();
    if (in == nullptr) {
      ld = plan_.channels;
      input_.load_rows(n, channel, plan_.channels, begin, count, scratch.in, ld);
      in = scratch.in;
    }
    T* out = exact && plan_.outputs == width_ ? output_.rows_in_place(n, first, begin) : nullptr;
    const bool direct = out != nullptr;
    if (!direct) out = scratch.out;
    const int64_t ld_out = direct ? output_.pixel_step() : width_;
    gemm_packed<T>(round_up(count, kRowPad), plan_.outputs, plan_.channels, in, ld, weights(group),
                   out, ld_out, initial_.data() + group * width_);
    if (!direct) output_.store_rows(n, first, plan_.outputs, begin, count, out, ld_out);
  }

  void planes(Scratch& scratch, int64_t n, int64_t group, int64_t begin, int64_t count) const {
    const bool exact = count == kPlaneTile;
    const int64_t channel = group * plan_.channels, first = group * plan_.outputs;
    const T* in = exact && reads_in_place(plan_.channels, width_)
                      ? input_.planes_in_place(n, channel, begin)
                      : nullptr;
    int64_t ld = input_.plane_step();
    if (in == nullptr) {
      ld = kPlaneTile;
      input_.load_planes(n, channel, plan_.channels, begin, count, scratch.in, ld);
      in = scratch.in;
    }
    T* out = exact && plan_.outputs == width_ ? output_.planes_in_place(n, first, begin) : nullptr;
    const bool direct = out != nullptr;
    if (!direct) out = scratch.out;
    const int64_t ld_out = direct ? output_.plane_step() : kPlaneTile;
    for (int64_t o = 0; o < width_; ++o) {
      std::fill_n(out + o * ld_out, kPlaneTile, initial_[static_cast<size_t>(group * width_ + o)]);
    }
    multiply_planes<T>(width_, plan_.channels, weights(group), in, ld, out, ld_out, nullptr);
    if (!direct) output_.store_planes(n, first, plan_.outputs, begin, count, out, ld_out);
  }

  const Conv& conv_;
  const ForwardTensors& tensors_;
  const Executor& executor_;
  const Plan plan_;
  const bool planar_;
  const int64_t width_;  // outputs of a group, padded
  const CentrePixels<T> input_, output_;
  std::vector<T> initial_;
  Buffer<T> weights_;
};
