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
    const int64_t pixels = conv_.y.out * conv_.x.out;
    const int64_t tiles = tiles_of(pixels), all = conv_.batch * tiles * plan_.groups;
    const int workers = workers_for(executor_, all * pieces(),
                                    conv_.batch * pixels * plan_.channels * conv_.out_channels);
    const Shares shares(conv_.batch * plan_.groups, pixels, 1, pieces(), piece(), workers,
                        1.0 / 16);
    const int64_t in = kTile * plan_.channels, out = kTile * width_;
    Workspace memory(workers * (Workspace::need<T>(in) + Workspace::need<T>(out)));
    std::vector<Scratch> scratch;
    for (int i = 0; i < workers; ++i) scratch.push_back({memory.take<T>(in), memory.take<T>(out)});
    run_tasks(executor_, all * shares.count(), workers, [&](int worker, int64_t task) {
      const int64_t of_all = task / shares.count(), tile = of_all / plan_.groups;
      const int64_t begin = tile % tiles * kTile;
      const Part part{tile / tiles, of_all % plan_.groups, begin,
                      std::min<int64_t>(kTile, pixels - begin),
                      outputs_of(shares.pieces(task % shares.count()))};
      planar_ ? planes(scratch[static_cast<size_t>(worker)], part)
              : rows(scratch[static_cast<size_t>(worker)], part);
    });
  }

 private:
  struct Scratch {
    T *in, *out;
  };
  struct Part {
    int64_t n, group;
    int64_t begin, count;  // flat output pixels
    Range outputs;         // of the group
  };

  // Outputs of a group that are packed, and may be multiplied, by themselves.
  static constexpr int64_t kPlanes = 4 * kRowBlock;
  int64_t piece() const { return planar_ ? kPlanes : 2 * kLanes<T>; }
  int64_t pieces() const { return (plan_.outputs + piece() - 1) / piece(); }
  Range outputs_of(Range pieces) const {
    return {pieces.begin * piece(), std::min(pieces.end * piece(), plan_.outputs)};
  }
  T* weights(int64_t group, int64_t output) const {
    return weights_.get() + (group * width_ + output) * plan_.channels;
  }

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
    const int64_t depth = plan_.channels, tasks = plan_.groups * pieces();
    weights_ = Buffer<T>(plan_.groups * depth * width_);
    const View filters = input_pixels(tensors_.weight);
    run_tasks(executor_, tasks, workers_for(executor_, tasks, plan_.groups * depth * width_),
              [&](int, int64_t task) {
                const int64_t group = task / pieces(), i = task % pieces();
                const Range outputs = outputs_of({i, i + 1});
                const int64_t first = group * plan_.outputs + outputs.begin;
                T* packed = weights(group, outputs.begin);
                if (planar_) {
                  pack_rows(filters, first, outputs.count(), depth, packed);
                } else {
                  const int64_t columns = panel_width<T>(outputs.count());
                  load_pixels<T>(filters, 0, first, outputs.count(), depth, 0, depth, packed,
                                 columns, columns);
                }
              });
  }

  void rows(Scratch& scratch, const Part& part) const {
    const bool exact = part.count % kRowPad == 0;
    const int64_t channel = part.group * plan_.channels, first = part.group * plan_.outputs;
    const T* in = exact ? input_.rows_in_place(part.n, channel, part.begin) : nullptr;
    int64_t ld = input_.pixel_step();
    if (in == nullptr) {
      ld = plan_.channels;
      input_.load_rows(part.n, channel, plan_.channels, part.begin, part.count, scratch.in, ld);
      in = scratch.in;
    }
    T* out = exact && plan_.outputs == width_ ? output_.rows_in_place(part.n, first, part.begin)
                                              : nullptr;
    const bool direct = out != nullptr;
    if (!direct) out = scratch.out;
    const int64_t ld_out = direct ? output_.pixel_step() : width_;
    gemm_packed<T>({{0, round_up(part.count, kRowPad)}, {0, plan_.channels}, part.outputs},
                   plan_.outputs, plan_.channels, in, ld, weights(part.group, 0), out, ld_out,
                   initial_.data() + part.group * width_);
    if (direct) return;
    output_.store_rows(part.n, first + part.outputs.begin, part.outputs.count(), part.begin,
                       part.count, out + part.outputs.begin, ld_out);
  }

  void planes(Scratch& scratch, const Part& part) const {
    const bool exact = part.count == kPlaneTile;
    const int64_t outputs = part.outputs.count(), padded = round_up(outputs, 4);
    const int64_t channel = part.group * plan_.channels;
    const int64_t first = part.group * plan_.outputs + part.outputs.begin;
    const T* in = exact && reads_in_place(plan_.channels, padded)
                      ? input_.planes_in_place(part.n, channel, part.begin)
                      : nullptr;
    int64_t ld = input_.plane_step();
    if (in == nullptr) {
      ld = kPlaneTile;
      input_.load_planes(part.n, channel, plan_.channels, part.begin, part.count, scratch.in, ld);
      in = scratch.in;
    }
    T* out =
        exact && outputs == padded ? output_.planes_in_place(part.n, first, part.begin) : nullptr;
    const bool direct = out != nullptr;
    if (!direct) out = scratch.out;
    const int64_t ld_out = direct ? output_.plane_step() : kPlaneTile;
    const T* initial = initial_.data() + part.group * width_ + part.outputs.begin;
    for (int64_t o = 0; o < padded; ++o) {
      std::fill_n(out + o * ld_out, pad_width<T>(part.count), initial[o]);
    }
    multiply_planes<T>(padded, part.count, plan_.channels, weights(part.group, part.outputs.begin),
                       in, ld, out, ld_out, nullptr);
    if (!direct) {
      output_.store_planes(part.n, first, outputs, part.begin, part.count, out, ld_out);
    }
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
