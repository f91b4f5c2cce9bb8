// Scattering the taps of pixels that need no list of corners, straight from the tables of both
// axes.

// One tap in two rows and two columns, one vector of channels: along the rows first, so that the
// weights of the two axes are enough.
template <bool Writes, Slopes S, class T, class V, class Dot>
SURFCONV_INLINE void scatter_square(const T* const* from, T* const* to, const TapSide<V>& y,
                                    const TapSide<V>& x, T* row, Dot& dot) {
  const V gradient = load<V>(row);
  const V x00 = load<V>(from[0]), x01 = load<V>(from[1]);
  const V x10 = load<V>(from[2]), x11 = load<V>(from[3]);
  const V upper = x00 * x.weight[0] + x01 * x.weight[1];
  const V lower = x10 * x.weight[0] + x11 * x.weight[1];
  if constexpr (S != Slopes::none) {
    const V across = (x01 - x00) * y.weight[0] + (x11 - x10) * y.weight[1];
    const V along_y = (lower - upper) * y.tap;
    if constexpr (S == Slopes::one) {
      dot.add(V(along_y + across * x.tap), gradient);
    } else {
      dot.add(along_y, gradient);
      dot.add_x(V(across * x.tap), gradient);
    }
  }
  if constexpr (Writes) {
    const V above = gradient * y.weight[0], below = gradient * y.weight[1];
    store(to[0], V(load<V>(to[0]) + above * x.weight[0]));
    store(to[1], V(load<V>(to[1]) + above * x.weight[1]));
    store(to[2], V(load<V>(to[2]) + below * x.weight[0]));
    store(to[3], V(load<V>(to[3]) + below * x.weight[1]));
  }
  store(row, V(upper * y.weight[0] + lower * y.weight[1]));
}

template <int ROWS, int COLUMNS, bool Writes, Slopes S, class T, class W, class Channels, class Dot>
SURFCONV_INLINE void scatter_place(const ScatterTarget<T>& target, const TapSide<W>& y,
                                   const TapSide<W>& x, Channels channels, T* row, Dot& dot) {
  constexpr int CORNERS = ROWS * COLUMNS;
  const auto corners = corners_of<ROWS, COLUMNS, T>(target.read, y, x);
  T* to[CORNERS] = {};
  W slope[CORNERS], slope_x[CORNERS];
#pragma GCC unroll 4
  for (int q = 0; q < CORNERS; ++q) {
    const int i = q / COLUMNS, j = q % COLUMNS;
    if constexpr (Writes) to[q] = reinterpret_cast<T*>(target.write + y.write[i] + x.read[j]);
    const W along_y = ROWS == 1 ? W{} : (i == 0 ? -y.tap : y.tap) * x.weight[j];
    const W along_x = COLUMNS == 1 ? W{} : (j == 0 ? -x.tap : x.tap) * y.weight[i];
    slope[q] = S == Slopes::one ? along_y + along_x : along_y;
    slope_x[q] = along_x;
  }
  if constexpr (CORNERS == 4 && is_one_vector<T>(Channels{})) {
    scatter_square<Writes, S>(corners.from, to, y, x, row, dot);
  } else {
    scatter_corners<CORNERS, Writes, S, false>(corners.from, to, corners.weight, slope, slope_x,
                                               channels, row, dot);
  }
}

// Whole rows of taps of the interior pixels begin .. end-1.
template <bool Writes, Slopes S, int K, class T, class Channels>
void scatter_interior(const Conv& conv, AxisTable<T> rows, AxisTable<T> columns, Range taps_y,
                      ScatterTarget<T> target, int begin, int end, Channels channels, T* matrix,
                      int64_t ld) {
  using W = typename WeightOf<T, Channels>::type;
  const Axis axis_y = conv.y, axis_x = conv.x;
  for (int m = begin; m < end; ++m) {
    PixelDot<T, Channels> dot(target, m);
    T* row = matrix + m * ld;
    walk_taps<K, W>(axis_y, axis_x, rows, columns, taps_y, m,
                    [&](auto r, auto c, const TapSide<W>& y, const TapSide<W>& x, int64_t t)
                        SURFCONV_INLINED {
                          scatter_place<decltype(r)::value, decltype(c)::value, Writes, S>(
                              target, y, x, channels, row + t * count_of(channels), dot);
                        });
    if constexpr (S != Slopes::none) dot.finish();
    if constexpr (S == Slopes::two) dot.finish_x();
  }
}

// Whole rows of taps of the pixels begin .. end-1, which are on the grid: the derivative is the
// step to the pixel that a tap moves towards.
template <bool Writes, Slopes S, int K, class T, class Channels>
void scatter_grid(const Conv& conv, AxisTable<T> rows, AxisTable<T> columns, Range taps_y,
                  ScatterTarget<T> target, int begin, int end, Channels channels, T* matrix,
                  int64_t ld) {
  const Axis axis_y = conv.y, axis_x = conv.x;
  for (int m = begin; m < end; ++m) {
    PixelDot<T, Channels> dot(target, m);
    T* row = matrix + m * ld;
    walk_grid<K>(axis_y, axis_x, rows, columns, taps_y, m,
                 [&](auto r, auto c, const GridSide<T>& y, const GridSide<T>& x, int64_t t)
                     SURFCONV_INLINED {
                       constexpr bool Down = S != Slopes::none && decltype(r)::value == 2;
                       constexpr bool Aside = S != Slopes::none && decltype(c)::value == 2;
                       const auto read = [&](bool inside, int64_t offset) SURFCONV_INLINED {
                         return inside ? reinterpret_cast<const T*>(target.read + offset)
                                       : target.zeros;
                       };
                       T* place = row + t * count_of(channels);
                       const T* from = read(true, y.read + x.read);
                       const T* below = read(Down && !y.at_border, y.beyond + x.read);
                       const T* beside = read(Aside && !x.at_border, y.read + x.beyond);
                       T* to = nullptr;
                       if constexpr (Writes)
                         to = reinterpret_cast<T*>(target.write + y.write + x.read);
                       for_channels<T>(channels, [&](int64_t k, auto width) SURFCONV_INLINED {
                         using V = Vec<T, decltype(width)::lanes>;
                         const V gradient = load<V>(place + k), sample = load<V>(from + k);
                         V along{}, along_x{};
                         if constexpr (Down) along = (load<V>(below + k) - sample) * y.tap;
                         if constexpr (Aside) along_x = (load<V>(beside + k) - sample) * x.tap;
                         if constexpr (S == Slopes::one && (Down || Aside)) {
                           dot.add(V(along + along_x), gradient);
                         }
                         if constexpr (S == Slopes::two && Down) dot.add(along, gradient);
                         if constexpr (S == Slopes::two && Aside) dot.add_x(along_x, gradient);
                         if constexpr (Writes) store(to + k, V(load<V>(to + k) + gradient));
                         store(place + k, sample);
                       });
                     });
    if constexpr (S != Slopes::none) dot.finish();
    if constexpr (S == Slopes::two) dot.finish_x();
  }
}

template <int ROWS, int COLUMNS, bool Writes, Slopes S, class T, class Channels, class Dot>
SURFCONV_INLINE void scatter_seen_place(const ScatterTarget<T>& target, const SeenSide<T>& y,
                                        const SeenSide<T>& x, Channels channels, T* row, Dot& dot) {
  constexpr int CORNERS = ROWS * COLUMNS;
  if constexpr (CORNERS == 0) {
    for_channels<T>(channels, [&](int64_t c, auto width) SURFCONV_INLINED {
      store(row + c, Vec<T, decltype(width)::lanes>{});
    });
  } else {
    const auto corners = corners_of<ROWS, COLUMNS, T>(target.read, y, x);
    T* to[CORNERS] = {};
    T slope[CORNERS], slope_x[CORNERS];
#pragma GCC unroll 4
    for (int q = 0; q < CORNERS; ++q) {
      const int i = q / COLUMNS, j = q % COLUMNS;
      if constexpr (Writes) {
        // A corner of zero weight is here for the slope alone.
        to[q] = corners.weight[q] == 0
                    ? target.discard
                    : reinterpret_cast<T*>(target.write + y.write[i] + x.read[j]);
      }
      if constexpr (S != Slopes::none) {
        const T along_y = y.slope[i] * x.weight[j], along_x = x.slope[j] * y.weight[i];
        slope[q] = S == Slopes::one ? along_y + along_x : along_y;
        slope_x[q] = along_x;
      }
    }
    scatter_corners<CORNERS, Writes, S, S != Slopes::none>(corners.from, to, corners.weight, slope,
                                                           slope_x, channels, row, dot);
  }
}

// Whole rows of taps of the pixels begin .. end-1, of which part may lie outside the image.
template <bool Writes, Slopes S, class T, class Channels>
void scatter_seen(const Conv& conv, AxisTable<T> rows, AxisTable<T> columns, Range taps_y,
                  ScatterTarget<T> target, int begin, int end, Channels channels, T* matrix,
                  int64_t ld) {
  const Axis axis_y = conv.y, axis_x = conv.x;
  for (int m = begin; m < end; ++m) {
    PixelDot<T, Channels> dot(target, m);
    T* row = matrix + m * ld;
    walk_seen<Writes, S>(axis_y, axis_x, rows, columns, taps_y, m,
                         [&](auto r, auto c, const SeenSide<T>& y, const SeenSide<T>& x,
                             int64_t t) SURFCONV_INLINED {
                           scatter_seen_place<decltype(r)::value, decltype(c)::value, Writes, S>(
                               target, y, x, channels, row + t * count_of(channels), dot);
                         });
    if constexpr (S != Slopes::none) dot.finish();
    if constexpr (S == Slopes::two) dot.finish_x();
  }
}

// All pixels of a tile: `taps` from first_tap on, of `channels` each.
template <bool Writes, Slopes S, class T>
void scatter_tile(const Conv& conv, const Tile<T>& tile, int64_t first_tap, int64_t taps,
                  const ScatterTarget<T>& target, int64_t channels, T* matrix, int64_t ld) {
  const Range taps_y{first_tap / conv.x.kernel, (first_tap + taps) / conv.x.kernel};
  const bool listed = tile.needs_list();
  tile.for_runs([&](const Run& run) {
    if (run.place == Place::other && listed) {
      for (int64_t t = 0; t < taps; ++t) {
        scatter_tap<Writes, S>(tile.tap(t), target, run.begin, run.end, channels,
                               matrix + t * channels, ld);
      }
      return;
    }
    with_channels<T>(channels, [&](auto known) {
      if (run.place == Place::other) {
        return scatter_seen<Writes, S>(conv, tile.rows(), tile.columns(), taps_y, target, run.begin,
                                       run.end, known, matrix, ld);
      }
      with_kernel(conv, taps_y, [&](auto kernel) {
        constexpr int K = decltype(kernel)::value;
        if (run.place == Place::on_grid) {
          return scatter_grid<Writes, S, K>(conv, tile.rows(), tile.columns(), taps_y, target,
                                            run.begin, run.end, known, matrix, ld);
        }
        scatter_interior<Writes, S, K>(conv, tile.rows(), tile.columns(), taps_y, target, run.begin,
                                       run.end, known, matrix, ld);
      });
    });
  });
}
