// The taps of one pixel inside the image or on its grid, straight from the tables of the two axes.

// The type of a pixel's weights: where samples are one vector of channels, that vector, so that a
// weight is spread over its lanes once and not for every tap that it serves.
template <class T, class Channels>
struct WeightOf {
  using type = T;
};
template <class T, int64_t N>
struct WeightOf<T, Fixed<N>> {
  using type =
      std::conditional_t<is_one_vector<T>(Fixed<N>{}), Vec<T, widest_lanes<T>(Fixed<N>{})>, T>;
};
template <class W, class T>
SURFCONV_INLINE W weight_of(T value) {
  if constexpr (std::is_same_v<W, T>) {
    return value;
  } else {
    return broadcast<W>(value);
  }
}

// A tap along one axis: its two places, or the first alone where the tap is fixed. Bytes.
template <class W>
struct TapSide {
  int64_t read[2];
  int64_t write[2];  // of rows; columns lie in the gradient as in the input
  W weight[2];
  W tap;  // tap(t) of the relation
};

template <bool TWO, class W, class T>
SURFCONV_INLINE TapSide<W> tap_side(const Axis& axis, const AxisTable<T>& table, int64_t t, int m) {
  const int64_t at = 2 * t * kTile + m;
  const int64_t *read = table.read + at, *write = table.write + at;
  const T* weight = table.weight + at;
  if constexpr (TWO) {
    return {{read[0], read[kTile]},
            {write[0], write[kTile]},
            {weight_of<W>(weight[0]), weight_of<W>(weight[kTile])},
            weight_of<W>(static_cast<T>(axis.tap_doubled(t)) / 2)};
  }
  return {{read[0], 0}, {write[0], 0}, {weight_of<W>(T(1)), W{}}, W{}};
}

// body(rows of corners, tap along y, number of its first tap) for the rows taps_y of the kernel. K:
// the size of a square kernel that is walked whole, whose loops are then unrolled, or 0.
template <int K, class Body>
SURFCONV_INLINE void walk_rows(const Axis& axis_y, const Axis& axis_x, Range taps_y,
                               const Body& body) {
  if constexpr (K == 3) {
    body(Two{}, 0, 0);
    body(One{}, 1, K);
    body(Two{}, 2, 2 * K);
  } else {
    for (int64_t ty = taps_y.begin; ty < taps_y.end; ++ty) {
      const int64_t t = (ty - taps_y.begin) * axis_x.kernel;
      axis_y.fixed(ty) ? body(One{}, ty, t) : body(Two{}, ty, t);
    }
  }
}

// body(columns of corners, tap along x) for a row of the kernel, without a branch in the loops.
template <int K, class Body>
SURFCONV_INLINE void walk_columns(const Axis& axis_x, const Body& body) {
  const int64_t kernel = K > 0 ? K : axis_x.kernel;
  const int64_t fixed = K > 0 ? K / 2 : axis_x.fixed_tap(), before = fixed < 0 ? kernel : fixed;
  for (int64_t tx = 0; tx < before; ++tx) body(Two{}, tx);
  if (fixed < 0) return;
  body(One{}, fixed);
  for (int64_t tx = fixed + 1; tx < kernel; ++tx) body(Two{}, tx);
}

// body(rows, columns, y, x, t) for each tap in the rows taps_y of the kernel: constants that say
// how many rows and columns of corners the tap has, its sides and its number from the first. W: the
// type of the weights.
template <int K, class W, class T, class Body>
SURFCONV_INLINE void walk_taps(const Axis& axis_y, const Axis& axis_x, const AxisTable<T>& rows,
                               const AxisTable<T>& columns, Range taps_y, int m, const Body& body) {
  walk_rows<K>(axis_y, axis_x, taps_y, [&](auto r, int64_t ty, int64_t t) SURFCONV_INLINED {
    const auto y = tap_side<decltype(r)::value == 2, W>(axis_y, rows, ty, m);
    walk_columns<K>(axis_x, [&](auto c, int64_t tx) SURFCONV_INLINED {
      body(r, c, y, tap_side<decltype(c)::value == 2, W>(axis_x, columns, tx, m), t + tx);
    });
  });
}

// A tap along one axis of a pixel on the grid. Bytes.
template <class T>
struct GridSide {
  int64_t read, write;  // where the tap is; write: of rows
  int64_t beyond;       // the pixel it moves towards as the scale grows
  bool at_border;       // that one is outside the image
  T tap;                // magnitude of tap(t)
};

template <int K, bool TWO, class T>
SURFCONV_INLINE GridSide<T> grid_side(const Axis& axis, const AxisTable<T>& table, int64_t t,
                                      int m) {
  // The side towards the centre holds the tap: see locate.
  const int64_t kernel = K > 0 ? K : axis.kernel, at = 2 * t * kTile + m;
  const int64_t near = TWO && t < kernel / 2 ? at + kTile : at, far = near == at ? at + kTile : at;
  if constexpr (!TWO) return {table.read[near], table.write[near], 0, true, T(0)};
  return {table.read[near], table.write[near], table.read[far], table.inside[far] == 0,
          static_cast<T>(std::abs(axis.tap_doubled(t))) / 2};
}

// body(rows, columns, y, x, t) for each tap of a pixel on the grid, as walk_taps has it: the tap is
// one corner of weight 1, and rows and columns say along which axes it moves with the scale.
template <int K, class T, class Body>
SURFCONV_INLINE void walk_grid(const Axis& axis_y, const Axis& axis_x, const AxisTable<T>& rows,
                               const AxisTable<T>& columns, Range taps_y, int m, const Body& body) {
  walk_rows<K>(axis_y, axis_x, taps_y, [&](auto r, int64_t ty, int64_t t) SURFCONV_INLINED {
    const auto y = grid_side<K, decltype(r)::value == 2>(axis_y, rows, ty, m);
    walk_columns<K>(axis_x, [&](auto c, int64_t tx) SURFCONV_INLINED {
      body(r, c, y, grid_side<K, decltype(c)::value == 2>(axis_x, columns, tx, m), t + tx);
    });
  });
}

// The corners of a tap, row by row: where they are and what they weigh.
template <int ROWS, int COLUMNS, class T, class W>
struct Corners {
  static constexpr int count = ROWS * COLUMNS;
  const T* from[count];
  W weight[count];
};
// Side: where along an axis, and what it weighs there, see TapSide and SeenSide.
template <int ROWS, int COLUMNS, class T, template <class> class Side, class W>
SURFCONV_INLINE Corners<ROWS, COLUMNS, T, W> corners_of(const char* base, const Side<W>& y,
                                                        const Side<W>& x) {
  Corners<ROWS, COLUMNS, T, W> corners;
#pragma GCC unroll 4
  for (int q = 0; q < ROWS * COLUMNS; ++q) {
    const int i = q / COLUMNS, j = q % COLUMNS;
    corners.from[q] = reinterpret_cast<const T*>(base + y.read[i] + x.read[j]);
    corners.weight[q] = y.weight[i] * x.weight[j];
  }
  return corners;
}

// body(K as a constant), see walk_rows.
template <class Body>
SURFCONV_INLINE void with_kernel(const Conv& conv, Range taps_y, const Body& body) {
  if (taps_y.count() == 3 && conv.y.kernel == 3 && conv.x.kernel == 3) {
    return body(std::integral_constant<int, 3>{});
  }
  body(std::integral_constant<int, 0>{});
}
