// sink(c, sum over corners of weight * x), vector by vector
template <int CORNERS, class T, class W, class Channels, class Sink>
SURFCONV_INLINE void blend(const T* const* from, const W* weight, Channels channels,
                           const Sink& sink) {
  for_channels<T>(channels, [&](int64_t c, auto width) SURFCONV_INLINED {
    using V = Vec<T, decltype(width)::lanes>;
    V sum = load<V>(from[0] + c) * weight[0];
#pragma GCC unroll 3
    for (int q = 1; q < CORNERS; ++q) sum += load<V>(from[q] + c) * weight[q];
    sink(c, sum);
  });
}

// One tap of an interior pixel. One vector of channels: along the rows first, so that the weights
// of the two axes are enough; more: each corner's weight is worth a product of its own.
template <int ROWS, int COLUMNS, class T, class W, class Channels, class Sink>
SURFCONV_INLINE void sample_tap(const char* base, const TapSide<W>& y, const TapSide<W>& x,
                                Channels channels, const Sink& sink) {
  const auto corners = corners_of<ROWS, COLUMNS, T>(base, y, x);
  if constexpr (ROWS == 2 && COLUMNS == 2 && is_one_vector<T>(Channels{})) {
    using V = W;
    const T* const* from = corners.from;
    const V upper = load<V>(from[0]) * x.weight[0] + load<V>(from[1]) * x.weight[1];
    const V lower = load<V>(from[2]) * x.weight[0] + load<V>(from[3]) * x.weight[1];
    sink(int64_t{0}, V(upper * y.weight[0] + lower * y.weight[1]));
  } else {
    blend<ROWS * COLUMNS>(corners.from, corners.weight, channels, sink);
  }
}

// One tap of a pixel near the border: a sample of zeros where nothing of it is seen.
template <int ROWS, int COLUMNS, class T, class Channels, class Sink>
SURFCONV_INLINE void blend_seen(const char* base, const SeenSide<T>& y, const SeenSide<T>& x,
                                Channels channels, const Sink& sink) {
  if constexpr (ROWS == 0) {
    for_channels<T>(channels, [&](int64_t c, auto width)
                                  SURFCONV_INLINED { sink(c, Vec<T, decltype(width)::lanes>{}); });
  } else {
    const auto corners = corners_of<ROWS, COLUMNS, T>(base, y, x);
    blend<ROWS * COLUMNS>(corners.from, corners.weight, channels, sink);
  }
}

// One tap of a pixel whose corners are listed.
template <int CORNERS, class T, class Channels, class Sink>
SURFCONV_INLINE void blend_listed(const TapCorners<T>& tap, const char* base, int m,
                                  Channels channels, const Sink& sink) {
  const T* from[CORNERS];
  T weight[CORNERS];
#pragma GCC unroll 4
  for (int q = 0; q < CORNERS; ++q) {
    from[q] = reinterpret_cast<const T*>(base + tap.read[q * kTile + m]);
    weight[q] = tap.weight[q * kTile + m];
  }
  blend<CORNERS>(from, weight, channels, sink);
}

// Pixels begin .. end-1 of the tile, m of them at to + m * ld.
template <class T, int CORNERS, class Channels>
void gather_corners(TapCorners<T> tap, const char* base, int begin, int end, Channels channels,
                    T* __restrict to, int64_t ld) {
  for (int m = begin; m < end; ++m) {
    T* row = to + m * ld;
    blend_listed<CORNERS>(tap, base, m, channels,
                          [&](int64_t c, auto sum) SURFCONV_INLINED { store(row + c, sum); });
  }
}

template <class T>
void gather_tap(const TapCorners<T>& tap, const char* base, int begin, int end, int64_t channels,
                T* to, int64_t ld) {
  with_channels<T>(channels, [&](auto known) {
    with_corners(tap.corners, [&](auto corners) {
      gather_corners<T, decltype(corners)::value>(tap, base, begin, end, known, to, ld);
    });
  });
}

// Whole rows of taps of the interior pixels begin .. end-1, one tap after the other, a step apart,
// at to + m * ld.
template <int K, class T, class Channels>
void gather_interior(const Conv& conv, AxisTable<T> rows, AxisTable<T> columns, Range taps_y,
                     const char* base, int begin, int end, Channels channels, T* to, int64_t ld,
                     int64_t step) {
  using W = typename WeightOf<T, Channels>::type;
  const Axis axis_y = conv.y, axis_x = conv.x;
  for (int m = begin; m < end; ++m) {
    T* out = to + m * ld;
    walk_taps<K, W>(
        axis_y, axis_x, rows, columns, taps_y, m,
        [&](auto r, auto c, const TapSide<W>& y, const TapSide<W>& x, int64_t t) SURFCONV_INLINED {
          T* place = out + t * step;
          sample_tap<decltype(r)::value, decltype(c)::value, T>(
              base, y, x, channels,
              [&](int64_t at, auto sum) SURFCONV_INLINED { store(place + at, sum); });
        });
  }
}

template <int K, class T, class Channels>
void gather_grid(const Conv& conv, AxisTable<T> rows, AxisTable<T> columns, Range taps_y,
                 const char* base, int begin, int end, Channels channels, T* to, int64_t ld,
                 int64_t step) {
  const Axis axis_y = conv.y, axis_x = conv.x;
  for (int m = begin; m < end; ++m) {
    T* out = to + m * ld;
    walk_grid<K>(axis_y, axis_x, rows, columns, taps_y, m,
                 [&](auto, auto, const GridSide<T>& y, const GridSide<T>& x, int64_t t)
                     SURFCONV_INLINED {
                       T* place = out + t * step;
                       const T* from = reinterpret_cast<const T*>(base + y.read + x.read);
                       for_channels<T>(channels, [&](int64_t c, auto width) SURFCONV_INLINED {
                         store(place + c, load<Vec<T, decltype(width)::lanes>>(from + c));
                       });
                     });
  }
}

// Whole rows of taps of the pixels begin .. end-1, of which part may lie outside the image.
template <class T, class Channels>
void gather_seen(const Conv& conv, AxisTable<T> rows, AxisTable<T> columns, Range taps_y,
                 const char* base, int begin, int end, Channels channels, T* to, int64_t ld,
                 int64_t step) {
  const Axis axis_y = conv.y, axis_x = conv.x;
  for (int m = begin; m < end; ++m) {
    T* out = to + m * ld;
    walk_seen<false, Slopes::none>(
        axis_y, axis_x, rows, columns, taps_y, m,
        [&](auto r, auto c, const SeenSide<T>& y, const SeenSide<T>& x, int64_t t)
            SURFCONV_INLINED {
              T* place = out + t * step;
              blend_seen<decltype(r)::value, decltype(c)::value>(
                  base, y, x, channels,
                  [&](int64_t at, auto sum) SURFCONV_INLINED { store(place + at, sum); });
            });
  }
}

// The gathered matrix of a tile: `taps` from first_tap on, of `channels` each, a step apart, which
// may be less than the channels: then a tap overwrites what pads the one before. Or only of the
// pixels that need their corners listed.
template <class T>
void gather_tile(const Conv& conv, const Tile<T>& tile, int64_t first_tap, int64_t taps,
                 const char* base, int64_t channels, T* to, int64_t ld, int64_t step,
                 bool corners_only = false) {
  const Range taps_y{first_tap / conv.x.kernel, (first_tap + taps) / conv.x.kernel};
  const bool listed = tile.needs_list();
  tile.for_runs([&](const Run& run) {
    if (run.place == Place::other && listed) {
      for (int64_t t = 0; t < taps; ++t) {
        gather_tap(tile.tap(t), base, run.begin, run.end, channels, to + t * step, ld);
      }
      return;
    }
    if (corners_only) return;
    with_channels<T>(channels, [&](auto known) {
      if (run.place == Place::other) {
        return gather_seen(conv, tile.rows(), tile.columns(), taps_y, base, run.begin, run.end,
                           known, to, ld, step);
      }
      with_kernel(conv, taps_y, [&](auto kernel) {
        if (run.place == Place::on_grid) {
          return gather_grid<decltype(kernel)::value>(conv, tile.rows(), tile.columns(), taps_y,
                                                      base, run.begin, run.end, known, to, ld,
                                                      step);
        }
        gather_interior<decltype(kernel)::value>(conv, tile.rows(), tile.columns(), taps_y, base,
                                                 run.begin, run.end, known, to, ld, step);
      });
    });
  });
}
