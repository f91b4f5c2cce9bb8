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
SURFCONV_INLINE TapSide<W> tap_side(const int64_t* read, const int64_t* write, const T* weight,
                                    T tap) {
  if constexpr (TWO) {
    return {{read[0], read[kTile]},
            {write[0], write[kTile]},
            {weight_of<W>(weight[0]), weight_of<W>(weight[kTile])},
            weight_of<W>(tap)};
  }
  return {{read[0], 0}, {write[0], 0}, {weight_of<W>(T(1)), W{}}, W{}};
}

// body(rows, columns, y, x, t) for each tap in the rows taps_y of the kernel: constants that say
// how many rows and columns of corners the tap has, its sides and its number from the first. KX:
// the kernel's odd width where it is known, else 0. W: the type of the weights.
template <int KX, class W, class T, class Body>
SURFCONV_INLINE void walk_taps(const Axis& axis_y, const Axis& axis_x, const AxisTable<T>& rows,
                               const AxisTable<T>& columns, Rows taps_y, int m, const Body& body) {
  using One = std::integral_constant<int, 1>;
  using Two = std::integral_constant<int, 2>;
  const int64_t kernel_x = KX > 0 ? KX : axis_x.kernel;
  const int64_t fixed_x = KX > 0 ? KX / 2 : axis_x.fixed_tap();
  const int64_t before = fixed_x < 0 ? kernel_x : fixed_x;
  int64_t at_y = taps_y.begin * 2 * kTile + m, t = 0;
  for (int64_t ty = taps_y.begin; ty < taps_y.end; ++ty, at_y += 2 * kTile) {
    const auto walk_row = [&](auto rows_of_tap) SURFCONV_INLINED {
      constexpr bool two_rows = decltype(rows_of_tap)::value == 2;
      const T tap_y = static_cast<T>(axis_y.tap_doubled(ty)) / 2;
      const TapSide<W> y =
          tap_side<two_rows, W>(rows.read + at_y, rows.write + at_y, rows.weight + at_y, tap_y);
      const auto walk_columns = [&](int64_t begin, int64_t end) SURFCONV_INLINED {
        const int64_t* read = columns.read + begin * 2 * kTile + m;
        const T* weight = columns.weight + begin * 2 * kTile + m;
        for (int64_t tx = begin; tx < end; ++tx, ++t, read += 2 * kTile, weight += 2 * kTile) {
          const T tap_x = static_cast<T>(axis_x.tap_doubled(tx)) / 2;
          body(rows_of_tap, Two{}, y, tap_side<true, W>(read, read, weight, tap_x), t);
        }
      };
      walk_columns(0, before);
      if (before == kernel_x) return;
      const int64_t* read = columns.read + before * 2 * kTile + m;
      body(rows_of_tap, One{}, y, tap_side<false, W>(read, read, columns.weight, T(0)), t++);
      walk_columns(before + 1, kernel_x);
    };
    axis_y.fixed(ty) ? walk_row(One{}) : walk_row(Two{});
  }
}

// A tap along one axis of a pixel on the grid. Bytes.
template <class T>
struct GridSide {
  int64_t read, write;  // where the tap is; write: of rows
  int64_t beyond;       // the pixel it moves towards as the scale grows
  bool at_border;       // that one is outside the image
  T tap;                // magnitude of tap(t)
};

template <bool TWO, class T>
SURFCONV_INLINE GridSide<T> grid_side(const Axis& axis, const AxisTable<T>& table, int64_t t,
                                      int m) {
  // The side towards the centre holds the tap: see locate.
  const int64_t tap = axis.tap_doubled(t), at = 2 * t * kTile + m;
  const int64_t near = TWO && tap < 0 ? at + kTile : at, far = near == at ? at + kTile : at;
  if constexpr (!TWO) return {table.read[near], table.write[near], 0, true, T(0)};
  return {table.read[near], table.write[near], table.read[far], table.inside[far] == 0,
          static_cast<T>(std::abs(tap)) / 2};
}

// body(rows, columns, y, x, t) for each tap of a pixel on the grid, as walk_taps has it: the tap is
// one corner of weight 1, and rows and columns say along which axes it moves with the scale.
template <int KX, class T, class Body>
SURFCONV_INLINE void walk_grid(const Axis& axis_y, const Axis& axis_x, const AxisTable<T>& rows,
                               const AxisTable<T>& columns, Rows taps_y, int m, const Body& body) {
  using One = std::integral_constant<int, 1>;
  using Two = std::integral_constant<int, 2>;
  const int64_t kernel_x = KX > 0 ? KX : axis_x.kernel;
  const int64_t fixed_x = KX > 0 ? KX / 2 : axis_x.fixed_tap();
  int64_t t = 0;
  for (int64_t ty = taps_y.begin; ty < taps_y.end; ++ty) {
    const auto walk_row = [&](auto rows_of_tap) SURFCONV_INLINED {
      const auto y = grid_side<decltype(rows_of_tap)::value == 2>(axis_y, rows, ty, m);
#pragma GCC unroll 3
      for (int64_t tx = 0; tx < kernel_x; ++tx, ++t) {
        if (tx == fixed_x) {
          body(rows_of_tap, One{}, y, grid_side<false>(axis_x, columns, tx, m), t);
        } else {
          body(rows_of_tap, Two{}, y, grid_side<true>(axis_x, columns, tx, m), t);
        }
      }
    };
    axis_y.fixed(ty) ? walk_row(One{}) : walk_row(Two{});
  }
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

// body(kernel's width as a constant) where it is one that nets have, else 0.
template <class Body>
SURFCONV_INLINE void with_width(int64_t kernel_x, const Body& body) {
  kernel_x == 3 ? body(std::integral_constant<int, 3>{}) : body(std::integral_constant<int, 0>{});
}
