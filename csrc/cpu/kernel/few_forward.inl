// Forward of few outputs from few channels: a tap's sample is one vector of channels and goes
// straight into a vector of products for each output, whose lanes are added up when all taps are
// done. The product with a gathered matrix would broadcast every value of it from memory.
struct Few {
  int lanes = 0;  // of a sample; 0: not for this convolution
  int outputs = 0;

  explicit operator bool() const { return lanes > 0; }
};

constexpr int kFew = 8;  // most channels, and most outputs

template <class T>
Few few_of(const Plan& plan, int64_t taps_at_once) {
  const bool in_registers = sizeof(T) == 4 && kLanes<T> >= kFew;
  if (!in_registers || plan.lanewise || plan.groups > 1 || taps_at_once < plan.taps) return {};
  const int64_t lanes = to_quads(plan.channels), outputs = to_quads(plan.outputs);
  if (lanes > kFew || outputs > lanes) return {};
  return {static_cast<int>(lanes), static_cast<int>(outputs)};
}

// Columns of corners in one vector of samples: pixels of one quad lie side by side in memory.
constexpr int columns_at_once(int lanes) { return lanes == kQuad ? 2 : 1; }

// Weights as [tap][output][column][lane], zeros for the second column of a tap that has but one.
template <class T>
Buffer<T> pack_few(const Few& few, const Conv& conv, const Plan& plan, const View& weight) {
  const int columns = columns_at_once(few.lanes);
  const int64_t row = columns * few.lanes, step = few.outputs * row;
  Buffer<T> packed(plan.taps * step);
  std::fill_n(packed.get(), plan.taps * step, T(0));
  for (int64_t o = 0; o < plan.outputs; ++o) {
    for (int64_t t = 0; t < plan.taps; ++t) {
      T* to = packed.get() + t * step + o * row;
      load_pixels<T>(weight, o, 0, plan.channels, conv.x.kernel, t, 1, to, row, few.lanes);
      if (columns == 2 && !conv.x.fixed(t % conv.x.kernel))
        std::copy_n(to, few.lanes, to + few.lanes);
    }
  }
  return packed;
}

// Four sums over lanes, side by side.
template <class T, int LANES>
SURFCONV_INLINE Vec<T, 4> add_up(const Vec<T, LANES>* vectors) {
  using Quad = Vec<T, 4>;
  Quad q[4];
#pragma GCC unroll 4
  for (int i = 0; i < 4; ++i) q[i] = fold<Quad, T>(vectors[i]);
  const Quad ab = SURFCONV_SHUFFLE(T, 4, q[0], q[1], 0, 4, 1, 5) +
                  SURFCONV_SHUFFLE(T, 4, q[0], q[1], 2, 6, 3, 7);
  const Quad cd = SURFCONV_SHUFFLE(T, 4, q[2], q[3], 0, 4, 1, 5) +
                  SURFCONV_SHUFFLE(T, 4, q[2], q[3], 2, 6, 3, 7);
  return SURFCONV_SHUFFLE(T, 4, ab, cd, 0, 1, 4, 5) + SURFCONV_SHUFFLE(T, 4, ab, cd, 2, 3, 6, 7);
}

// The pixels of a tile and what they share.
template <class T>
struct FewTile {
  const Conv& conv;
  const Tile<T>& tile;
  const char* base;
  const T *weights, *initial;
  T* out;
  int64_t ld_out;
};

// The products of pixels that share the loads of the weights. SAMPLE: lanes of a sample, of one
// column of corners or of two.
template <class T, int SAMPLE, int LANES, int OUTPUTS, int PIXELS>
class FewSums {
 public:
  using V = Vec<T, SAMPLE>;

  SURFCONV_INLINE void add(const V* samples, const FewTile<T>& few, int64_t t) {
    constexpr int step = LANES * columns_at_once(LANES);
    const T* weight = few.weights + t * (OUTPUTS * step);
    // Else g++ moves the loads that both arms of a branch have in common before it, and spills.
    if (!__builtin_constant_p(t)) asm volatile("" : "+r"(weight));
#pragma GCC unroll 8
    for (int o = 0; o < OUTPUTS; ++o) {
      V w = load<V>(weight + o * step);
      if constexpr (PIXELS > 1) keep_in_register(w);
#pragma GCC unroll 2
      for (int p = 0; p < PIXELS; ++p) sums_[p][o] += samples[p] * w;
    }
  }
  SURFCONV_INLINE void finish(const FewTile<T>& few, const int* m) const {
#pragma GCC unroll 2
    for (int p = 0; p < PIXELS; ++p) {
#pragma GCC unroll 2
      for (int o = 0; o < OUTPUTS; o += 4) {
        const auto sum = load<Vec<T, 4>>(few.initial + o) + add_up<T, SAMPLE>(sums_[p] + o);
        store(few.out + m[p] * few.ld_out + o, sum);
      }
    }
  }

 private:
  V sums_[PIXELS][OUTPUTS] = {};
};

// walk(m, add) for each pixel m of the run; add(sample, t) for each tap of it that is seen.
template <int LANES, int OUTPUTS, class T, class Walk>
SURFCONV_INLINE void few_pixels(const FewTile<T>& few, const Run& run, const Walk& walk) {
  for (int m = run.begin; m < run.end; ++m) {
    FewSums<T, LANES, LANES, OUTPUTS, 1> sums;
    walk(m, [&](Vec<T, LANES> sample, int64_t t) SURFCONV_INLINED { sums.add(&sample, few, t); });
    sums.finish(few, &m);
  }
}

// One tap of an interior pixel, the columns of its corners side by side: what they weigh together
// is added up with the lanes.
template <int ROWS, int COLUMNS, class T, class W>
SURFCONV_INLINE W sample_columns(const char* base, const TapSide<W>& y, const TapSide<W>& x) {
  using Lanes = Vec<int32_t, 2 * kQuad>;
  const auto row = [&](int i) SURFCONV_INLINED {
    const T* from = reinterpret_cast<const T*>(base + y.read[i] + x.read[0]);
    if constexpr (COLUMNS == 2) {
      return load<W>(from);
    } else {
      auto column = load<Vec<double, kQuad / 2>>(from);  // as g++ knows to join vectors
      keep_in_register(column);
      return (W)Vec<double, kQuad>{column[0], column[1]};
    }
  };
  W sample = row(0);
  if constexpr (ROWS == 2) sample = sample * y.weight[0] + row(1) * y.weight[1];
  if constexpr (COLUMNS == 2) {
    sample *= Lanes{0, 0, 0, 0, -1, -1, -1, -1} ? x.weight[1] : x.weight[0];
  }
  return sample;
}

// Pixels inside the image or on its grid: sample(rows, columns, y, x) from side_y(rows, tap, m) and
// side_x(columns, tap, m).
template <int K, int SAMPLE, int LANES, int OUTPUTS, class T, class SideY, class SideX,
          class Sample>
SURFCONV_INLINE void few_walk(const FewTile<T>& few, const Run& run, const SideY& side_y,
                              const SideX& side_x, const Sample& sample) {
  constexpr int PIXELS = OUTPUTS == 4 ? 2 : 1;  // as many sums as registers hold
  const Axis axis_y = few.conv.y, axis_x = few.conv.x;
  for (int m = run.begin; m < run.end; m += PIXELS) {
    const int pixels[2] = {m, std::min(m + 1, run.end - 1)};
    FewSums<T, SAMPLE, LANES, OUTPUTS, PIXELS> sums;
    const auto row = [&](auto r, int64_t ty, int64_t t) SURFCONV_INLINED {
      decltype(side_y(r, ty, 0)) y[PIXELS];
#pragma GCC unroll 2
      for (int p = 0; p < PIXELS; ++p) y[p] = side_y(r, ty, pixels[p]);
      walk_columns<K>(axis_x, [&](auto c, int64_t tx) SURFCONV_INLINED {
        Vec<T, SAMPLE> samples[PIXELS];
#pragma GCC unroll 2
        for (int p = 0; p < PIXELS; ++p) samples[p] = sample(r, c, y[p], side_x(c, tx, pixels[p]));
        sums.add(samples, few, t + tx);
      });
    };
    walk_rows<K>(axis_y, axis_x, {0, axis_y.kernel}, row);
    sums.finish(few, pixels);
  }
}

template <int K, int LANES, int OUTPUTS, class T>
void few_interior(FewTile<T> few, const Run& run) {
  constexpr int SAMPLE = LANES * columns_at_once(LANES);
  using W = Vec<T, SAMPLE>;
  const Axis axis_y = few.conv.y, axis_x = few.conv.x;
  const AxisTable<T> rows = few.tile.rows(), columns = few.tile.columns();
  few_walk<K, SAMPLE, LANES, OUTPUTS>(
      few, run,
      [&](auto r, int64_t t, int m)
          SURFCONV_INLINED { return tap_side<decltype(r)::value == 2, W>(axis_y, rows, t, m); },
      [&](auto c, int64_t t, int m)
          SURFCONV_INLINED { return tap_side<decltype(c)::value == 2, W>(axis_x, columns, t, m); },
      [&](auto r, auto c, const TapSide<W>& y, const TapSide<W>& x) SURFCONV_INLINED {
        constexpr int ROWS = decltype(r)::value, COLUMNS = decltype(c)::value;
        W sum;
        if constexpr (SAMPLE > LANES) {
          sum = sample_columns<ROWS, COLUMNS, T>(few.base, y, x);
        } else {
          sample_tap<ROWS, COLUMNS, T>(few.base, y, x, Fixed<LANES>{},
                                       [&](int64_t, W value) SURFCONV_INLINED { sum = value; });
        }
        return sum;
      });
}

template <int K, int LANES, int OUTPUTS, class T>
void few_grid(FewTile<T> few, const Run& run) {
  const Axis axis_y = few.conv.y, axis_x = few.conv.x;
  const AxisTable<T> rows = few.tile.rows(), columns = few.tile.columns();
  few_walk<K, LANES, LANES, OUTPUTS>(
      few, run,
      [&](auto r, int64_t t, int m)
          SURFCONV_INLINED { return grid_side<K, decltype(r)::value == 2>(axis_y, rows, t, m); },
      [&](auto c, int64_t t, int m)
          SURFCONV_INLINED { return grid_side<K, decltype(c)::value == 2>(axis_x, columns, t, m); },
      [&](auto, auto, const GridSide<T>& y, const GridSide<T>& x) SURFCONV_INLINED {
        return load<Vec<T, LANES>>(reinterpret_cast<const T*>(few.base + y.read + x.read));
      });
}

// Pixels of which part may lie outside the image.
template <int LANES, int OUTPUTS, class T>
void few_seen(FewTile<T> few, const Run& run) {
  const Axis axis_y = few.conv.y, axis_x = few.conv.x;
  const AxisTable<T> rows = few.tile.rows(), columns = few.tile.columns();
  const auto walk = [&](int m, const auto& add) SURFCONV_INLINED {
    const auto tap = [&](auto r, auto c, const SeenSide<T>& y, const SeenSide<T>& x,
                         int64_t t) SURFCONV_INLINED {
      if constexpr (decltype(r)::value > 0) {
        blend_seen<decltype(r)::value, decltype(c)::value>(
            few.base, y, x, Fixed<LANES>{},
            [&](int64_t, Vec<T, LANES> sample) SURFCONV_INLINED { add(sample, t); });
      }
    };
    walk_seen<false, Slopes::none>(axis_y, axis_x, rows, columns, {0, axis_y.kernel}, m, tap);
  };
  few_pixels<LANES, OUTPUTS>(few, run, walk);
}

// Pixels whose corners are listed.
template <int LANES, int OUTPUTS, class T>
void few_listed(FewTile<T> few, const Run& run) {
  const int64_t taps = few.conv.y.kernel * few.conv.x.kernel;
  few_pixels<LANES, OUTPUTS>(few, run, [&](int m, const auto& add) SURFCONV_INLINED {
    for (int64_t t = 0; t < taps; ++t) {
      with_corners(few.tile.tap(t).corners, [&](auto corners) SURFCONV_INLINED {
        blend_listed<decltype(corners)::value>(few.tile.tap(t), few.base, m, Fixed<LANES>{},
                                               [&](int64_t, Vec<T, LANES> sample)
                                                   SURFCONV_INLINED { add(sample, t); });
      });
    }
  });
}

template <int LANES, int OUTPUTS, class T>
void few_runs(const FewTile<T>& few) {
  const bool listed = few.tile.needs_list();
  few.tile.for_runs([&](const Run& run) {
    if (run.place == Place::other) {
      return listed ? few_listed<LANES, OUTPUTS>(few, run) : few_seen<LANES, OUTPUTS>(few, run);
    }
    with_kernel(few.conv, {0, few.conv.y.kernel}, [&](auto kernel) {
      constexpr int K = decltype(kernel)::value;
      run.place == Place::on_grid ? few_grid<K, LANES, OUTPUTS>(few, run)
                                  : few_interior<K, LANES, OUTPUTS>(few, run);
    });
  });
}

template <class T>
void few_forward(const Few& shape, const FewTile<T>& few) {
  if constexpr (sizeof(T) == 4 && kLanes<T> >= kFew) {
    if (shape.lanes == 4) return few_runs<4, 4>(few);
    if (shape.outputs == 4) return few_runs<8, 4>(few);
    few_runs<8, 8>(few);
  }
}
