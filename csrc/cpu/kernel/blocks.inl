// How the contraction over (tap, channel) is cut, and the weights packed to match.
//
// Dense: each group is a matrix product. Depthwise (one input channel a group): all channels form
// one group whose contraction is element by element, once for each of `multiplier` outputs.
struct Plan {
  bool depthwise;
  int64_t groups;      // matrix products of a tile
  int64_t channels;    // input channels of each
  int64_t outputs;     // output channels of each; depthwise: channels
  int64_t multiplier;  // depthwise: outputs of one channel; else 1
  int64_t taps;
  int64_t row;  // channels of a pixel in working memory, each group padded to quads

  explicit Plan(const Conv& conv) {
    depthwise = conv.groups > 1 && conv.groups == conv.in_channels;
    groups = depthwise ? 1 : conv.groups;
    channels = conv.in_channels / groups;
    multiplier = depthwise ? conv.out_channels / conv.in_channels : 1;
    outputs = depthwise ? channels : conv.out_channels / groups;
    taps = conv.y.kernel * conv.x.kernel;
    row = groups * to_quads(channels);
  }
};

// A run of channels of one group.
struct ChannelBlock {
  int64_t group, first, count, padded;
};

inline std::vector<ChannelBlock> channel_blocks(const Plan& plan, int64_t most) {
  std::vector<ChannelBlock> blocks;
  for (int64_t g = 0; g < plan.groups; ++g) {
    for (int64_t first = 0; first < plan.channels; first += most) {
      const int64_t count = std::min(most, plan.channels - first);
      blocks.push_back({g, first, count, to_quads(count)});
    }
  }
  return blocks;
}

// Taps gathered at a time: the gathered matrix of a tile should stay in the second-level cache.
SURFCONV_INLINE int64_t taps_at_once(int64_t taps, int64_t channels) {
  constexpr int64_t kDepth = 640, kMostTaps = 64;
  return std::max<int64_t>(1, std::min({taps, kMostTaps, kDepth / std::max<int64_t>(channels, 1)}));
}

// One tap of one input channel against all outputs, in the compute type whatever is stored.
template <class T>
class WeightReader {
 public:
  WeightReader(const View& view, int64_t kernel_x) : view_(view), kernel_x_(kernel_x) {}

  // to[i] = weight[first_output + i, channel, tap]
  void outputs(int64_t first_output, int64_t count, int64_t channel, int64_t tap, T* to) const {
    const int64_t origin = first_output * view_.n + channel * view_.c + tap / kernel_x_ * view_.y +
                           tap % kernel_x_ * view_.x;
    visit_storage<T>(view_, [&](auto* data) {
      for (int64_t i = 0; i < count; ++i) to[i] = widen(data[origin + i * view_.n]);
    });
  }
  // to[i] = weight[output, first_channel + i, tap]
  void channels(int64_t output, int64_t first_channel, int64_t count, int64_t tap, T* to) const {
    const int64_t origin = output * view_.n + first_channel * view_.c + tap / kernel_x_ * view_.y +
                           tap % kernel_x_ * view_.x;
    visit_storage<T>(view_, [&](auto* data) {
      for (int64_t i = 0; i < count; ++i) to[i] = widen(data[origin + i * view_.c]);
    });
  }

 private:
  View view_;
  int64_t kernel_x_;
};

// Rows (tap, channel) of a block against its group's outputs, in panels: the forward's B.
template <class T>
void pack_forward(const WeightReader<T>& weight, const Plan& plan, const ChannelBlock& block,
                  int64_t first_tap, int64_t taps, T* packed) {
  const int64_t depth = taps * block.padded;
  for_panels<T>(plan.outputs, [&](int64_t column, int64_t columns, bool) {
    T* panel = packed + column * depth;
    const int64_t used = std::min(columns, plan.outputs - column);
    std::fill(panel, panel + depth * columns, T(0));
    for (int64_t t = 0; t < taps; ++t) {
      for (int64_t c = 0; c < block.count; ++c) {
        weight.outputs(block.group * plan.outputs + column, used, block.first + c, first_tap + t,
                       panel + (t * block.padded + c) * columns);
      }
    }
  });
}

// Rows of outputs against (tap, channel), in panels: the B of the gradient of the gathered matrix.
template <class T>
void pack_backward(const WeightReader<T>& weight, const Plan& plan, const ChannelBlock& block,
                   int64_t first_tap, int64_t taps, T* packed) {
  const int64_t width = taps * block.padded, depth = plan.outputs;
  for_panels<T>(width, [&](int64_t column, int64_t columns, bool) {
    T* panel = packed + column * depth;
    std::fill(panel, panel + depth * columns, T(0));
    for (int64_t o = 0; o < depth; ++o) {
      // Panels cut across taps only at quads, so a run of one tap's channels starts at a quad.
      for (int64_t at = column; at < std::min(column + columns, width);) {
        const int64_t t = at / block.padded, c = at % block.padded;
        const int64_t span = std::min(block.padded - c, column + columns - at);
        const int64_t used = std::min(span, std::max<int64_t>(block.count - c, 0));
        weight.channels(block.group * plan.outputs + o, block.first + c, used, first_tap + t,
                        panel + o * columns + (at - column));
        at += span;
      }
    }
  });
}

// Depthwise weights as [tap][multiplier][row].
template <class T>
void pack_depthwise(const WeightReader<T>& weight, const Plan& plan, T* packed) {
  std::fill(packed, packed + plan.taps * plan.multiplier * plan.row, T(0));
  for (int64_t t = 0; t < plan.taps; ++t) {
    for (int64_t j = 0; j < plan.multiplier; ++j) {
      for (int64_t c = 0; c < plan.channels; ++c) {
        weight.outputs(c * plan.multiplier + j, 1, 0, t,
                       packed + (t * plan.multiplier + j) * plan.row + c);
      }
    }
  }
}

// Images handled at a time: enough work for every core, without a copy of the whole batch. By
// shape alone, for the order of sums must not depend on threads.
SURFCONV_INLINE int64_t images_at_once(const Conv& conv, const Plan& plan) {
  constexpr int64_t kElements = int64_t{1} << 21;
  const int64_t image = std::max<int64_t>(1, conv.y.in * conv.x.in * plan.row);
  return std::max<int64_t>(1, std::min(conv.batch, kElements / image));
}

// The input as channel-innermost rows: in place where it lies so already, else packed.
template <class T>
struct InputRows {
  bool packed;
  std::unique_ptr<T[]> memory;

  InputRows(const Conv& conv, const Plan& plan, const View& input, int64_t images) {
    const bool same = input.dtype == (sizeof(T) == 8 ? DType::f64 : DType::f32);
    const bool quads = plan.row == conv.in_channels;
    packed = !(same && quads && input.c == 1);
    if (packed) memory.reset(new T[static_cast<size_t>(images * conv.y.in * conv.x.in * plan.row)]);
  }

  int64_t step_x(const Plan& plan, const View& input) const { return packed ? plan.row : input.x; }
  int64_t step_y(const Conv& conv, const Plan& plan, const View& input) const {
    return packed ? plan.row * conv.x.in : input.y;
  }
  const T* image(const Conv& conv, const Plan& plan, const View& input, int64_t first,
                 int64_t n) const {
    return packed ? memory.get() + (n - first) * conv.y.in * conv.x.in * plan.row
                  : static_cast<const T*>(input.data) + n * input.n;
  }

  void pack(const Conv& conv, const Plan& plan, const View& input, int64_t first, int64_t images,
            const Executor& executor) {
    if (!packed) return;
    const int64_t strip = std::max<int64_t>(1, 4096 / plan.row + 1) * 8;
    const int64_t pixels = conv.y.in * conv.x.in, strips = (pixels + strip - 1) / strip;
    const int64_t tasks = images * strips;
    run_tasks(executor, tasks, workers_for(executor, tasks, images * pixels * plan.row),
              [&](int, int64_t task) {
                const int64_t n = task / strips, begin = task % strips * strip;
                const int64_t count = std::min(strip, pixels - begin);
                const int64_t padded = to_quads(plan.channels);
                for (int64_t g = 0; g < plan.groups; ++g) {
                  load_pixels<T>(input, first + n, g * plan.channels, plan.channels, conv.x.in,
                                 begin, count,
                                 memory.get() + (n * pixels + begin) * plan.row + g * padded,
                                 plan.row, padded);
                }
              });
  }
};
