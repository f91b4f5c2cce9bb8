// How the channels of a tensor lie in working memory: each of its parts padded to quads.
struct Lanes {
  int64_t parts, each;

  // Parts that need no padding are one.
  Lanes(int64_t count, int64_t channels)
      : parts(channels % kQuad == 0 ? 1 : count),
        each(channels % kQuad == 0 ? count * channels : channels) {}
  int64_t padded() const { return to_quads(each); }
  int64_t row() const { return parts * padded(); }
};

// Lanes first .. first+lanes-1, from the start of a part, of the pixels begin .. begin+count-1.
template <class T>
void load_lanes(const View& view, const Lanes& layout, int64_t n, int64_t first, int64_t lanes,
                int64_t width, int64_t begin, int64_t count, T* to, int64_t ld) {
  if (layout.parts == 1) {
    const int64_t channels = std::min(lanes, layout.each - first);
    return load_pixels<T>(view, n, first, channels, width, begin, count, to, ld, lanes);
  }
  const int64_t padded = layout.padded();
  for (int64_t lane = first; lane < first + lanes; lane += padded) {
    load_pixels<T>(view, n, lane / padded * layout.each, layout.each, width, begin, count,
                   to + (lane - first), ld, padded);
  }
}

// All lanes.
template <class T>
void store_lanes(const View& view, const Lanes& layout, int64_t n, int64_t width, int64_t begin,
                 int64_t count, const T* from, int64_t ld) {
  for (int64_t part = 0; part < layout.parts; ++part) {
    store_pixels<T>(view, n, part * layout.each, layout.each, width, begin, count,
                    from + part * layout.padded(), ld);
  }
}

// How the contraction over (tap, channel) is cut, and the weights packed to match.
//
// Dense: each group is a matrix product. Lanewise: groups of one input channel, or of up to four
// channels and outputs, are contracted element by element, all at once; see lanewise.inl.
struct Plan {
  bool lanewise;
  int mix;             // lanewise: lanes that meet each other, 1 or kQuad
  int64_t multiplier;  // depthwise: outputs of one channel; else 1
  int64_t groups;      // dense: matrix products of a tile; lanewise: 1
  int64_t channels;    // input channels of each; lanewise: lanes
  int64_t outputs;     // output channels of each; lanewise: lanes
  int64_t taps;
  Lanes in, out;
  int64_t row;  // lanes of an input pixel

  explicit Plan(const Conv& conv)
      : in(conv.groups, conv.in_channels / conv.groups),
        out(conv.groups, conv.out_channels / conv.groups) {
    const int64_t inputs = conv.in_channels / conv.groups;
    outputs = conv.out_channels / conv.groups;
    const bool depthwise = conv.groups > 1 && inputs == 1;
    // Two lanes of double are no quad.
    const bool quads = conv.groups > 1 && inputs <= kQuad && outputs <= kQuad && kLanes<double> > 2;
    lanewise = depthwise || quads;
    mix = lanewise && !depthwise ? static_cast<int>(kQuad) : 1;
    multiplier = depthwise ? outputs : 1;
    if (depthwise) in = out = Lanes(1, conv.in_channels);
    row = in.row();
    groups = lanewise ? 1 : conv.groups;
    channels = lanewise ? row : inputs;
    if (lanewise) outputs = row;
    taps = conv.y.kernel * conv.x.kernel;
  }

  // Lanewise: weight vectors of a tap.
  int64_t weights_of_tap() const { return multiplier * mix; }
};

constexpr int64_t kBlock = 64;  // channels gathered at a time

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

// Blocks that are one task of the backward: nobody else writes their part of a gradient.
struct Unit {
  std::vector<ChannelBlock> blocks;
};

inline std::vector<Unit> make_units(const std::vector<ChannelBlock>& blocks, int64_t channels) {
  std::vector<Unit> units;
  int64_t filled = channels;
  for (const ChannelBlock& block : blocks) {
    if (filled >= channels) {
      units.emplace_back();
      filled = 0;
    }
    units.back().blocks.push_back(block);
    filled += block.padded;
  }
  return units;
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

// Lanewise: body(output, channel of the group, k, lane) for every weight of a tap. Lanes are those
// of the output, so that sums over k are outputs, or with Back those of the input.
template <bool Back, class Body>
SURFCONV_INLINE void for_lane_weights(const Conv& conv, const Plan& plan, const Body& body) {
  if (plan.mix == 1) {
    for (int64_t o = 0; o < conv.out_channels; ++o) {
      body(o, int64_t{0}, o % plan.multiplier, o / plan.multiplier);
    }
    return;
  }
  const int64_t inputs = conv.in_channels / conv.groups, outputs = conv.out_channels / conv.groups;
  for (int64_t o = 0; o < conv.out_channels; ++o) {
    for (int64_t c = 0; c < inputs; ++c) {
      const int64_t quad = o / outputs * kQuad, of_out = o % outputs;
      body(o, c, Back ? of_out : c, quad + (Back ? c : of_out));
    }
  }
}

// Weights as [tap][k][row].
template <class T, bool Back>
Buffer<T> pack_lanewise(const Conv& conv, const Plan& plan, const View& weight) {
  const int64_t step = plan.weights_of_tap() * plan.row;
  Buffer<T> packed(plan.taps * step);
  std::fill_n(packed.get(), plan.taps * step, T(0));
  visit_storage<T>(weight, [&](auto* data) {
    for_lane_weights<Back>(conv, plan, [&](int64_t o, int64_t c, int64_t k, int64_t lane) {
      const auto* filter = data + o * weight.n + c * weight.c;
      T* to = packed.get() + k * plan.row + lane;
      for (int64_t ty = 0; ty < conv.y.kernel; ++ty) {
        for (int64_t tx = 0; tx < conv.x.kernel; ++tx, to += step) {
          *to = widen(filter[ty * weight.y + tx * weight.x]);
        }
      }
    });
  });
  return packed;
}

inline LaneBlock lane_block(const Plan& plan, const ChannelBlock& block, int64_t first_tap,
                            int64_t taps) {
  return {block.padded, taps, plan.row, first_tap * plan.weights_of_tap() * plan.row + block.first,
          plan.multiplier};
}

// The channels that are output j of each input channel.
inline View multiplied(const View& view, const Plan& plan, int64_t j) {
  View plane = view;
  advance(plane, j * view.c);
  plane.c *= plan.multiplier;
  return plane;
}

// body(mix) with the plan's mix as a constant.
template <class T, class Body>
SURFCONV_INLINE void with_mix(const Plan& plan, const Body& body) {
  if constexpr (kLanes<T> >= kQuad) {
    if (plan.mix == kQuad) return body(std::integral_constant<int, static_cast<int>(kQuad)>{});
  }
  body(std::integral_constant<int, 1>{});
}
