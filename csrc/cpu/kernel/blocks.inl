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

// Taps gathered at a time, so that the gathered matrix of a tile stays in the second-level cache:
// whole rows of the kernel, unless a row is longer than anybody's kernel.
SURFCONV_INLINE int64_t taps_at_once(const Conv& conv, int64_t channels) {
  constexpr int64_t kDepth = 640;
  if (!has_whole_rows(conv)) return std::max<int64_t>(1, kDepth / channels);
  const int64_t most = std::min(kMostTaps, kDepth / std::max<int64_t>(channels, 1));
  const int64_t rows = std::max<int64_t>(1, most / conv.x.kernel);
  return std::min(rows, conv.y.kernel) * conv.x.kernel;
}

// Weights are packed by the loads of pixels: the kernel's taps are the pixels of a small image.

// Rows (tap, channel) of a block against its group's outputs, in panels: the forward's B.
template <class T>
void pack_forward(const View& weight, int64_t kernel_x, const Plan& plan, const ChannelBlock& block,
                  int64_t first_tap, int64_t taps, T* packed) {
  const int64_t depth = taps * block.padded;
  for_panels<T>(plan.outputs, [&](int64_t column, int64_t columns) {
    T* panel = packed + column * depth;
    const int64_t used = std::min(columns, plan.outputs - column);
    for (int64_t c = 0; c < block.padded; ++c) {
      if (c < block.count) {
        View filter = weight;
        advance(filter, (block.first + c) * weight.c);
        filter.c = weight.n;
        load_pixels<T>(filter, 0, block.group * plan.outputs + column, used, kernel_x, first_tap,
                       taps, panel + c * columns, block.padded * columns, columns);
      } else {
        for (int64_t t = 0; t < taps; ++t) {
          std::fill_n(panel + (t * block.padded + c) * columns, columns, T(0));
        }
      }
    }
  });
}

// Rows of outputs against (tap, channel), in panels: the B of the gradient of the gathered matrix.
template <class T>
void pack_backward(const View& weight, int64_t kernel_x, const Plan& plan,
                   const ChannelBlock& block, int64_t first_tap, int64_t taps, T* packed) {
  const int64_t width = taps * block.padded;
  std::vector<T> row(static_cast<size_t>(pad_width<T>(width)), T(0));
  for (int64_t o = 0; o < plan.outputs; ++o) {
    load_pixels<T>(weight, block.group * plan.outputs + o, block.first, block.count, kernel_x,
                   first_tap, taps, row.data(), block.padded, block.padded);
    for_panels<T>(width, [&](int64_t column, int64_t columns) {
      std::copy_n(row.data() + column, columns, packed + column * plan.outputs + o * columns);
    });
  }
}

// Depthwise weights as [tap][multiplier][row].
template <class T>
void pack_depthwise(const View& weight, int64_t kernel_x, const Plan& plan, T* packed) {
  for (int64_t j = 0; j < plan.multiplier; ++j) {
    View filter = weight;
    advance(filter, j * weight.n);
    filter.c = weight.n * plan.multiplier;
    load_pixels<T>(filter, 0, 0, plan.channels, kernel_x, 0, plan.taps, packed + j * plan.row,
                   plan.multiplier * plan.row, plan.row);
  }
}
