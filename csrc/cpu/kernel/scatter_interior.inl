// Scattering the taps of interior pixels, straight from the tables of the two axes.

// A tap along one axis: its two places, or the first alone where the tap is fixed.
template <class T>
struct TapSide {
  int64_t offset[2];  // bytes; of columns, which lie alike in the input and in its gradient
  T weight[2];
  T tap;  // tap(t) of the relation
};

// One tap in two rows and two columns, one vector of channels: along the rows first, so that the
// weights of the two axes are enough.
template <bool Writes, Slopes S, class T, class Channels, class Dot>
SURFCONV_INLINE void scatter_square(const T* const* from, T* const* to, const TapSide<T>& y,
                                    const TapSide<T>& x, Channels, T* row, Dot& dot) {
  using V = Vec<T, static_cast<int>(Channels::value)>;
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

template <int ROWS, int COLUMNS, bool Writes, Slopes S, class T, class Channels, class Dot>
SURFCONV_INLINE void scatter_place(const char* const* read, char* const* write, const TapSide<T>& y,
                                   const TapSide<T>& x, Channels channels, T* row, Dot& dot) {
  constexpr int CORNERS = ROWS * COLUMNS;
  const T* from[CORNERS];
  T* to[CORNERS];
#pragma GCC unroll 4
  for (int q = 0; q < CORNERS; ++q) {
    const int i = q / COLUMNS, j = q % COLUMNS;
    from[q] = reinterpret_cast<const T*>(read[i] + x.offset[j]);
    if constexpr (Writes) to[q] = reinterpret_cast<T*>(write[i] + x.offset[j]);
  }
  if constexpr (CORNERS == 4 && is_one_vector<T>(Channels{})) {
    scatter_square<Writes, S>(from, to, y, x, channels, row, dot);
  } else {
    T weight[CORNERS], slope[CORNERS], slope_x[CORNERS];
#pragma GCC unroll 4
    for (int q = 0; q < CORNERS; ++q) {
      const int i = q / COLUMNS, j = q % COLUMNS;
      const T weight_y = ROWS == 1 ? T(1) : y.weight[i];
      const T weight_x = COLUMNS == 1 ? T(1) : x.weight[j];
      const T along_y = ROWS == 1 ? T(0) : (i == 0 ? -y.tap : y.tap) * weight_x;
      const T along_x = COLUMNS == 1 ? T(0) : (j == 0 ? -x.tap : x.tap) * weight_y;
      weight[q] = weight_y * weight_x;
      slope[q] = S == Slopes::one ? along_y + along_x : along_y;
      slope_x[q] = along_x;
    }
    scatter_corners<CORNERS, Writes, S, false>(from, to, weight, slope, slope_x, channels, row,
                                               dot);
  }
}

template <bool Writes, Slopes S, int ROWS, int KX, class T, class Channels, class Dot>
SURFCONV_INLINE void scatter_tap_row(const char* const* read, char* const* write,
                                     const TapSide<T>& y, const Axis& axis_x, const int64_t* read_x,
                                     const T* weight_x, Channels channels, T* row, Dot& dot) {
  const int64_t kernel_x = KX > 0 ? KX : axis_x.kernel;
  const int64_t fixed_x = KX > 0 ? KX / 2 : axis_x.fixed_tap();
#pragma GCC unroll 3
  for (int64_t tx = 0; tx < kernel_x; ++tx) {
    if (tx == fixed_x) {
      const TapSide<T> x{{*read_x, 0}, {T(1), T(0)}, T(0)};
      scatter_place<ROWS, 1, Writes, S>(read, write, y, x, channels, row, dot);
    } else {
      const TapSide<T> x{{read_x[0], read_x[kTile]},
                         {weight_x[0], weight_x[kTile]},
                         static_cast<T>(axis_x.tap_doubled(tx)) / 2};
      scatter_place<ROWS, 2, Writes, S>(read, write, y, x, channels, row, dot);
    }
    read_x += 2 * kTile;
    weight_x += 2 * kTile;
    row += count_of(channels);
  }
}

// Whole rows of taps of the interior pixels begin .. end-1.
template <bool Writes, Slopes S, int KX, class T, class Channels>
void scatter_interior(const Conv& conv, const AxisTable<T>& rows, const AxisTable<T>& columns,
                      Rows taps_y, const ScatterTarget<T>& target, int begin, int end,
                      Channels channels, T* matrix, int64_t ld) {
  const Axis axis_y = conv.y, axis_x = conv.x;
  const int64_t first = taps_y.begin * 2 * kTile;
  const int64_t *read_y = rows.read + first, *write_y = rows.write + first, *read_x = columns.read;
  const T *weight_y = rows.weight + first, *weight_x = columns.weight;
  const ScatterTarget<T> to = target;
  for (int m = begin; m < end; ++m) {
    PixelDot<T, Channels> dot(to, m);
    T* row = matrix + m * ld;
    int64_t at = m;
    for (int64_t ty = taps_y.begin; ty < taps_y.end; ++ty) {
      const char* read[2] = {to.read + read_y[at], to.read + read_y[at + kTile]};
      char* write[2] = {};
      if constexpr (Writes) {
        write[0] = to.write + write_y[at];
        write[1] = to.write + write_y[at + kTile];
      }
      const TapSide<T> y{
          {}, {weight_y[at], weight_y[at + kTile]}, static_cast<T>(axis_y.tap_doubled(ty)) / 2};
      if (axis_y.fixed(ty)) {
        scatter_tap_row<Writes, S, 1, KX>(read, write, y, axis_x, read_x + m, weight_x + m,
                                          channels, row, dot);
      } else {
        scatter_tap_row<Writes, S, 2, KX>(read, write, y, axis_x, read_x + m, weight_x + m,
                                          channels, row, dot);
      }
      row += axis_x.kernel * count_of(channels);
      at += 2 * kTile;
    }
    if constexpr (S != Slopes::none) dot.finish();
    if constexpr (S == Slopes::two) dot.finish_x();
  }
}

// All pixels of a tile: `taps` from first_tap on, of `channels` each.
template <bool Writes, Slopes S, class T>
void scatter_tile(const Conv& conv, const Tile<T>& tile, int64_t first_tap, int64_t taps,
                  const ScatterTarget<T>& target, int64_t channels, T* matrix, int64_t ld) {
  const Rows taps_y{first_tap / conv.x.kernel, (first_tap + taps) / conv.x.kernel};
  tile.for_runs([&](const Run& run) {
    if (!run.interior) {
      for (int64_t t = 0; t < taps; ++t) {
        scatter_tap<Writes, S>(tile.tap(t), target, run.begin, run.end, channels,
                               matrix + t * channels, ld);
      }
      return;
    }
    with_channels<T>(channels, [&](auto known) {
      const auto scatter = [&](auto kernel_x) {
        scatter_interior<Writes, S, decltype(kernel_x)::value>(conv, tile.rows(), tile.columns(),
                                                               taps_y, target, run.begin, run.end,
                                                               known, matrix, ld);
      };
      conv.x.kernel == 3 ? scatter(std::integral_constant<int, 3>{})
                         : scatter(std::integral_constant<int, 0>{});
    });
  });
}
