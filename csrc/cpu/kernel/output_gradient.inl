// The gradient of the output as the backward pass of a unit meets it, a few tiles at a time.
template <class T>
class OutputGradient {
 public:
  // The gradient of the output at some pixels: a pixel every `ld`, of lanes
  // [multiplier][kBlock].
  struct Part {
    const T* data;
    int64_t ld, group_step, first_group;

    const T* of(const ChannelBlock& block) const {
      return data + (block.group - first_group) * group_step;
    }
  };

  OutputGradient(const Conv& conv, const Plan& plan, const View& view)
      : conv_(conv),
        plan_(plan),
        view_(view),
        width_(plan.lanewise ? plan.multiplier * kBlock : pad_width<T>(plan.outputs)),
        in_place_((plan.lanewise ? plan.multiplier == 1 && plan.row == conv.out_channels
                                 : plan.outputs == width_) &&
                  view.dtype == kComputeDType<T> && view.c == 1 && view.y == view.x * conv.x.out) {}

  int64_t width() const { return width_; }

  // In place where whole blocks of the products may read it there; then what follows is fetched.
  // scratch: [group of the unit][most pixels][width]
  Part read(const Unit& unit, int64_t n, int64_t begin, int count, T* scratch,
            int64_t most_pixels) const {
    const View& from = view_;
    const ChannelBlock& block = unit.blocks.front();
    if (in_place_ && count % kRowPad == 0) {
      const T* pixel = static_cast<const T*>(from.data) + n * from.n + begin * from.x;
      const int64_t first = plan_.lanewise ? block.first : block.group * plan_.outputs;
      fetch_next(pixel + first, count, plan_.lanewise ? block.padded : plan_.outputs);
      return {pixel + first, from.x, plan_.outputs, block.group};
    }
    if (plan_.lanewise) {  // a unit of lanes is one block
      for (int64_t j = 0; j < plan_.multiplier; ++j) {
        load_lanes<T>(multiplied(from, plan_, j), plan_.out, n, block.first, block.padded,
                      conv_.x.out, begin, count, scratch + j * kBlock, width_);
      }
    } else {
      for (int64_t g = block.group; g <= unit.blocks.back().group; ++g) {
        load_pixels<T>(from, n, g * plan_.outputs, plan_.outputs, conv_.x.out, begin, count,
                       scratch + (g - block.group) * most_pixels * width_, width_, width_);
      }
    }
    return {scratch, width_, most_pixels * width_, block.group};
  }

  void add_bias(const Part& part, const Unit& unit, int count, T* bias) const {
    for (const ChannelBlock& block : unit.blocks) {
      const T* from = part.of(block);
      if (!plan_.lanewise) {
        if (block.first != 0) continue;
        // Tile by tile: the same sums however many there are at once.
        for (int begin = 0; begin < count; begin += kTile) {
          add_columns(from + begin * part.ld, part.ld, std::min(kTile, count - begin),
                      plan_.outputs, bias + block.group * plan_.outputs);
        }
        continue;
      }
      for (int64_t j = 0; j < plan_.multiplier; ++j) {
        T sums[kBlock] = {};
        add_columns(from + j * kBlock, part.ld, count, block.padded, sums);
        for_lane_weights<false>(conv_, plan_, [&](int64_t o, int64_t c, int64_t k, int64_t lane) {
          const int64_t at = lane - block.first;
          const bool wanted = plan_.mix == 1 ? k == j : c == 0;
          if (wanted && at >= 0 && at < block.padded) bias[o] += sums[at];
        });
      }
    }
  }

 private:
  // As many pixels more.
  void fetch_next(const T* first, int count, int64_t lanes) const {
    constexpr int64_t bytes = sizeof(T);
    const uintptr_t start = reinterpret_cast<uintptr_t>(first);
    for (int64_t m = count; m < 2 * count; ++m) {
      fetch<false>(start + static_cast<uintptr_t>(m * view_.x * bytes), lanes * bytes);
    }
  }

  // to[c] += sum over pixels
  static void add_columns(const T* from, int64_t ld, int count, int64_t columns, T* to) {
    for_channels<T>(to_quads(columns), [&](int64_t c, auto width) SURFCONV_INLINED {
      constexpr int L = decltype(width)::lanes;
      using V = Vec<T, L>;
      V even{}, odd{};
      int m = 0;
      for (; m + 1 < count; m += 2) {
        even += load<V>(from + m * ld + c);
        odd += load<V>(from + (m + 1) * ld + c);
      }
      if (m < count) even += load<V>(from + m * ld + c);
      T sums[L];
      store(sums, V(even + odd));
      for (int i = 0; i < std::min<int64_t>(L, columns - c); ++i) to[c + i] += sums[i];
    });
  }

  const Conv& conv_;
  const Plan& plan_;
  const View& view_;
  const int64_t width_;
  const bool in_place_;  // it may be read where it lies
};
