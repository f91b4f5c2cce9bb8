// The taps of a pixel of which part may lie outside the image: places outside are left out.

// The places of a tap along one axis, none to two of them, the seen ones first. Bytes.
template <class T>
struct SeenSide {
  int64_t read[2];
  int64_t write[2];  // of rows; columns lie in the gradient as in the input
  T weight[2];
  T slope[2];  // of the weight with the scale
};

// Returns how many places there are. For the slopes' sake those of zero weight count as well.
template <bool Writes, Slopes S, class T>
SURFCONV_INLINE int see(const Axis& axis, const AxisTable<T>& table, int64_t t, int m,
                        SeenSide<T>& seen) {
  const bool fixed = axis.fixed(t);
  const int64_t lower = 2 * t * kTile + m, upper = fixed ? lower : lower + kTile;
  const T* present = S == Slopes::none ? table.weight : table.inside;
  const bool has_lower = present[lower] != 0, has_upper = !fixed && present[upper] != 0;
  const int64_t first = has_lower ? lower : upper;
  seen.read[0] = table.read[first], seen.read[1] = table.read[upper];
  seen.weight[0] = table.weight[first], seen.weight[1] = table.weight[upper];
  if constexpr (Writes) seen.write[0] = table.write[first], seen.write[1] = table.write[upper];
  if constexpr (S != Slopes::none) {
    const T tap = fixed ? T(0) : static_cast<T>(axis.tap_doubled(t)) / 2;
    seen.slope[0] = has_lower ? -tap : tap, seen.slope[1] = tap;
  }
  return has_lower + has_upper;
}

// body(rows, columns, y, x, t) for each tap in the rows taps_y of the kernel: constants that say
// how many rows and columns of corners are seen, both 0 where none is, the tap's sides and its
// number from the first.
template <bool Writes, Slopes S, class T, class Body>
SURFCONV_INLINE void walk_seen(const Axis& axis_y, const Axis& axis_x, const AxisTable<T>& rows,
                               const AxisTable<T>& columns, Range taps_y, int m, const Body& body) {
  using Zero = std::integral_constant<int, 0>;
  SeenSide<T> seen_x[kMostTaps];
  int places_x[kMostTaps];
  for (int64_t tx = 0; tx < axis_x.kernel; ++tx) {
    places_x[tx] = see<false, S>(axis_x, columns, tx, m, seen_x[tx]);
  }
  int64_t t = 0;
  for (int64_t ty = taps_y.begin; ty < taps_y.end; ++ty) {
    SeenSide<T> y;
    const int places_y = see<Writes, S>(axis_y, rows, ty, m, y);
    for (int64_t tx = 0; tx < axis_x.kernel; ++tx, ++t) {
      const SeenSide<T>& x = seen_x[tx];
      const int places = places_y == 0 ? 0 : places_x[tx];
      if (places == 0) {
        body(Zero{}, Zero{}, y, x, t);
      } else if (places_y == 1) {
        places == 1 ? body(One{}, One{}, y, x, t) : body(One{}, Two{}, y, x, t);
      } else {
        places == 1 ? body(Two{}, One{}, y, x, t) : body(Two{}, Two{}, y, x, t);
      }
    }
  }
}
