// to[c] = sum over corners of weight * x
template <class T, int CORNERS, class Channels>
SURFCONV_INLINE void blend(const T* const* __restrict from, const T* weight, Channels channels,
                           T* __restrict to) {
  for_channels<T>(channels, [&](int64_t c, auto width) SURFCONV_INLINED {
    using V = Vec<T, decltype(width)::lanes>;
    V sum = load<V>(from[0] + c) * weight[0];
#pragma GCC unroll 3
    for (int q = 1; q < CORNERS; ++q) sum += load<V>(from[q] + c) * weight[q];
    store(to + c, sum);
  });
}

// Pixels begin .. end-1 of the tile, m of them at to + m * ld.
template <class T, int CORNERS, class Channels>
void gather_corners(const TapCorners<T>& tap, const char* base, int begin, int end,
                    Channels channels, T* __restrict to, int64_t ld) {
  const int64_t* __restrict read = tap.read;
  const T* __restrict weights = tap.weight;
  for (int m = begin; m < end; ++m) {
    const T* from[CORNERS];
    T weight[CORNERS];
#pragma GCC unroll 4
    for (int q = 0; q < CORNERS; ++q) {
      from[q] = reinterpret_cast<const T*>(base + read[q * kTile + m]);
      weight[q] = weights[q * kTile + m];
    }
    blend<T, CORNERS>(from, weight, channels, to + m * ld);
  }
}

template <class T>
void gather_tap(const TapCorners<T>& tap, const char* base, int begin, int end, int64_t channels,
                T* to, int64_t ld) {
  with_channels<T>(channels, [&](auto known) {
    switch (tap.corners) {
      case 1:
        return gather_corners<T, 1>(tap, base, begin, end, known, to, ld);
      case 2:
        return gather_corners<T, 2>(tap, base, begin, end, known, to, ld);
      default:
        return gather_corners<T, 4>(tap, base, begin, end, known, to, ld);
    }
  });
}

// The corners of one tap in two rows and two columns. One vector of channels: along the rows first,
// so that four weights are enough; more: each corner's weight is worth a product of its own.
template <class T, class Channels>
SURFCONV_INLINE void blend_square(const T* const* __restrict from, T above, T below, T left,
                                  T right, Channels channels, T* __restrict to) {
  if constexpr (is_one_vector<T>(Channels{})) {
    using V = Vec<T, static_cast<int>(Channels::value)>;
    const V upper = load<V>(from[0]) * left + load<V>(from[1]) * right;
    const V lower = load<V>(from[2]) * left + load<V>(from[3]) * right;
    store(to, V(upper * above + lower * below));
  } else {
    const T weight[] = {above * left, above * right, below * left, below * right};
    blend<T, 4>(from, weight, channels, to);
  }
}

// One row of taps of an interior pixel. upper, lower: its two rows of the image, above and below
// their weights; read, weights: the pixel's entries of the first tap's columns.
template <class T, bool TWO_ROWS, int KX, class Channels>
SURFCONV_INLINE void gather_tap_row(const char* upper, const char* lower, T above, T below,
                                    const int64_t* read, const T* weights, int64_t kernel_x,
                                    int64_t fixed, Channels channels, int64_t step, T* to) {
  const auto at = [](const char* row, int64_t offset)
                      SURFCONV_INLINED { return reinterpret_cast<const T*>(row + offset); };
#pragma GCC unroll 3
  for (int64_t tx = 0; tx < (KX > 0 ? KX : kernel_x); ++tx) {
    if (tx == fixed) {
      const T* from[2] = {at(upper, *read)};
      const T weight[] = {above, below};
      if constexpr (TWO_ROWS) from[1] = at(lower, *read);
      blend<T, TWO_ROWS ? 2 : 1>(from, weight, channels, to);
    } else {
      const T left = weights[0], right = weights[kTile];
      const T* from[4] = {at(upper, read[0]), at(upper, read[kTile])};
      if constexpr (TWO_ROWS) {
        from[2] = at(lower, read[0]);
        from[3] = at(lower, read[kTile]);
        blend_square<T>(from, above, below, left, right, channels, to);
      } else {
        const T weight[] = {left, right};
        blend<T, 2>(from, weight, channels, to);
      }
    }
    read += 2 * kTile;
    weights += 2 * kTile;
    to += step;
  }
}

// Whole rows of taps of the interior pixels begin .. end-1, one tap after the other at to + m * ld.
// The tables' pointers are copied: as members they would be read again after every store.
template <class T, int KX, class Channels>
void gather_interior(const Conv& conv, const AxisTable<T>& rows, const AxisTable<T>& columns,
                     Rows taps_y, const char* base, int begin, int end, Channels channels, T* to,
                     int64_t ld) {
  const int64_t step = count_of(channels);
  const int64_t kernel_x = KX > 0 ? KX : conv.x.kernel, fixed_y = conv.y.fixed_tap();
  const int64_t fixed_x = KX > 0 ? KX / 2 : conv.x.fixed_tap();
  const int64_t *read_y = rows.read + taps_y.begin * 2 * kTile, *read_x = columns.read;
  const T *weight_y = rows.weight + taps_y.begin * 2 * kTile, *weight_x = columns.weight;
  for (int m = begin; m < end; ++m) {
    T* out = to + m * ld;
    const int64_t* read = read_y + m;
    const T* weight = weight_y + m;
    for (int64_t ty = taps_y.begin; ty < taps_y.end; ++ty) {
      if (ty == fixed_y) {
        gather_tap_row<T, false, KX>(base + *read, nullptr, T(1), T(0), read_x + m, weight_x + m,
                                     kernel_x, fixed_x, channels, step, out);
      } else {
        gather_tap_row<T, true, KX>(base + read[0], base + read[kTile], weight[0], weight[kTile],
                                    read_x + m, weight_x + m, kernel_x, fixed_x, channels, step,
                                    out);
      }
      out += kernel_x * step;
      read += 2 * kTile;
      weight += 2 * kTile;
    }
  }
}

// The gathered matrix of a tile: `taps` from first_tap on, of `channels` each.
template <class T>
void gather_tile(const Conv& conv, const Tile<T>& tile, int64_t first_tap, int64_t taps,
                 const char* base, int64_t channels, T* to, int64_t ld) {
  const Rows taps_y{first_tap / conv.x.kernel, (first_tap + taps) / conv.x.kernel};
  tile.for_runs([&](const Run& run) {
    if (!run.interior) {
      for (int64_t t = 0; t < taps; ++t) {
        gather_tap(tile.tap(t), base, run.begin, run.end, channels, to + t * channels, ld);
      }
      return;
    }
    with_channels<T>(channels, [&](auto known) {
      const auto gather = [&](auto kernel_x) {
        gather_interior<T, decltype(kernel_x)::value>(conv, tile.rows(), tile.columns(), taps_y,
                                                      base, run.begin, run.end, known, to, ld);
      };
      conv.x.kernel == 3 ? gather(std::integral_constant<int, 3>{})
                         : gather(std::integral_constant<int, 0>{});
    });
  });
}
