// What the forward multiplies by and starts from: the packed weights, and the bias as it lies among
// a pixel's outputs.
template <class T>
class ForwardWeights {
 public:
  // width: of a group's outputs, padded.
  ForwardWeights(const Conv& conv, const Plan& plan, int64_t width)
      : conv_(conv),
        plan_(plan),
        width_(width),
        initial_(static_cast<size_t>(plan.groups * width), T(0)) {}

  const T* initial() const { return initial_.data(); }
  const T* data() const { return packed_.get(); }
  // Where those of a block of taps and channels start.
  T* of(const ChannelBlock& block, int64_t first_tap, int64_t taps) const {
    const int64_t depth = to_quads(plan_.channels);
    return packed_.get() +
           (block.group * plan_.taps * depth + first_tap * depth + taps * block.first) * width_;
  }

  void set_initial(const View& bias) {
    if (bias.data == nullptr) return;
    visit_storage<T>(bias, [&](auto* data) {
      const auto set = [&](int64_t o, int64_t place) {
        initial_[static_cast<size_t>(place)] = widen(data[o * bias.c]);
      };
      if (plan_.lanewise) {
        for_lane_weights<false>(conv_, plan_, [&](int64_t o, int64_t, int64_t k, int64_t lane) {
          set(o, (plan_.mix == 1 ? k * plan_.row : 0) + lane);
        });
      } else {
        for (int64_t o = 0; o < conv_.out_channels; ++o) {
          set(o, o / plan_.outputs * width_ + o % plan_.outputs);
        }
      }
    });
  }

  void take(Buffer<T> packed) { packed_ = std::move(packed); }

  // For products, all blocks of `most_taps` taps.
  void pack(const View& weight, const std::vector<ChannelBlock>& blocks, int64_t most_taps,
            const Executor& executor) {
    const int64_t elements = plan_.taps * plan_.row * width_;
    packed_ = Buffer<T>(elements);
    const int64_t tap_blocks = (plan_.taps + most_taps - 1) / most_taps;
    const int64_t tasks = tap_blocks * static_cast<int64_t>(blocks.size());
    run_tasks(executor, tasks, workers_for(executor, tasks, elements), [&](int, int64_t task) {
      const ChannelBlock& block = blocks[static_cast<size_t>(task / tap_blocks)];
      const int64_t first_tap = task % tap_blocks * most_taps;
      const int64_t taps = std::min(most_taps, plan_.taps - first_tap);
      pack_forward(weight, conv_.x.kernel, plan_, block, first_tap, taps,
                   of(block, first_tap, taps));
    });
  }

 private:
  const Conv& conv_;
  const Plan& plan_;
  const int64_t width_;
  std::vector<T> initial_;
  Buffer<T> packed_;
};
