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

// Weights as [tap][output][lane].
template <class T>
Buffer<T> pack_few(const Few& few, const Plan& plan, const View& weight, int64_t kernel_x) {
  const int64_t step = few.outputs * few.lanes;
  Buffer<T> packed(plan.taps * step);
  std::fill_n(packed.get(), plan.taps * step, T(0));
  for (int64_t o = 0; o < plan.outputs; ++o) {
    load_pixels<T>(weight, o, 0, plan.channels, kernel_x, 0, plan.taps,
                   packed.get() + o * few.lanes, step, few.lanes);
  }
  return packed;
}

// Four sums over lanes, side by side.
template <class T, int LANES>
SURFCONV_INLINE Vec<T, 4> add_up(const Vec<T, LANES>* vectors) {
  using Quad = Vec<T, 4>;
  Quad q[4];
#pragma GCC unroll 4
  for (int i = 0; i < 4; ++i) {
    __builtin_memcpy(&q[i], &vectors[i], sizeof(Quad));
    if constexpr (LANES == 8) {
      Quad upper;
      __builtin_memcpy(&upper, reinterpret_cast<const T*>(&vectors[i]) + 4, sizeof(Quad));
      q[i] += upper;
    }
  }
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

// The products of one pixel.
template <class T, int LANES, int OUTPUTS>
class FewSums {
 public:
  using V = Vec<T, LANES>;

  SURFCONV_INLINE void add(V sample, const FewTile<T>& few, int64_t t) {
    const T* weight = few.weights + t * (OUTPUTS * LANES);
    // Else g++ moves the loads that both arms of a branch have in common before it, and spills.
    asm volatile("" : "+r"(weight));
#pragma GCC unroll 8
    for (int o = 0; o < OUTPUTS; ++o) sums_[o] += sample * load<V>(weight + o * LANES);
  }
  SURFCONV_INLINE void finish(const FewTile<T>& few, int m) const {
#pragma GCC unroll 2
    for (int o = 0; o < OUTPUTS; o += 4) {
      const auto sum = load<Vec<T, 4>>(few.initial + o) + add_up<T, LANES>(sums_ + o);
      store(few.out + m * few.ld_out + o, sum);
    }
  }

 private:
  V sums_[OUTPUTS] = {};
};

// walk(m, add) for each pixel m of the run; add(sample, t) for each tap of it that is seen.
template <int LANES, int OUTPUTS, class T, class Walk>
SURFCONV_INLINE void few_pixels(const FewTile<T>& few, const Run& run, const Walk& walk) {
  for (int m = run.begin; m < run.end; ++m) {
    FewSums<T, LANES, OUTPUTS> sums;
    walk(m, [&](Vec<T, LANES> sample, int64_t t) SURFCONV_INLINED { sums.add(sample, few, t); });
    sums.finish(few, m);
  }
}

template <int KX, int LANES, int OUTPUTS, class T>
void few_interior(FewTile<T> few, const Run& run) {
  using W = Vec<T, LANES>;
  const Axis axis_y = few.conv.y, axis_x = few.conv.x;
  const AxisTable<T> rows = few.tile.rows(), columns = few.tile.columns();
  few_pixels<LANES, OUTPUTS>(few, run, [&](int m, const auto& add) SURFCONV_INLINED {
    walk_taps<KX, W>(axis_y, axis_x, rows, columns, {0, axis_y.kernel}, m,
                     [&](auto r, auto c, const TapSide<W>& y, const TapSide<W>& x, int64_t t)
                         SURFCONV_INLINED {
                           sample_tap<decltype(r)::value, decltype(c)::value, T>(
                               few.base, y, x, Fixed<LANES>{},
                               [&](int64_t, W sample) SURFCONV_INLINED { add(sample, t); });
                         });
  });
}

template <int KX, int LANES, int OUTPUTS, class T>
void few_grid(FewTile<T> few, const Run& run) {
  const Axis axis_y = few.conv.y, axis_x = few.conv.x;
  const AxisTable<T> rows = few.tile.rows(), columns = few.tile.columns();
  few_pixels<LANES, OUTPUTS>(few, run, [&](int m, const auto& add) SURFCONV_INLINED {
    walk_grid<KX>(axis_y, axis_x, rows, columns, {0, axis_y.kernel}, m,
                  [&](auto, auto, const GridSide<T>& y, const GridSide<T>& x, int64_t t)
                      SURFCONV_INLINED {
                        const T* from = reinterpret_cast<const T*>(few.base + y.read + x.read);
                        add(load<Vec<T, LANES>>(from), t);
                      });
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
    with_width(few.conv.x.kernel, [&](auto width) {
      constexpr int KX = decltype(width)::value;
      run.place == Place::on_grid ? few_grid<KX, LANES, OUTPUTS>(few, run)
                                  : few_interior<KX, LANES, OUTPUTS>(few, run);
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
