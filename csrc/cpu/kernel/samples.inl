// Where the taps of one tile of output pixels fall, and what each corner weighs.
// Loops over a tile always run to its full length, a number the compiler knows; entries beyond the
// tile's pixels hold the geometry of a scale of zero and are not used.
constexpr int kTile = 48;

// Taps gathered at a time are whole rows of the kernel where a row has no more taps than this.
constexpr int64_t kMostTaps = 64;
SURFCONV_INLINE bool has_whole_rows(const Conv& conv) { return conv.x.kernel <= kMostTaps; }

// Whether 32 bits hold all positions: then there are as many in a vector as floats.
SURFCONV_INLINE bool has_narrow_reach(const Axis& y, const Axis& x) {
  return std::max(y.reach(), x.reach()) < (int64_t{1} << 28);
}

// Per axis, tap and side (pixel `lo`, then `lo + 1`), one entry for each pixel of the tile.
template <class T>
struct AxisTable {
  T* weight;       // 0 outside the image
  T* inside;       // 1 inside the image, else 0
  int64_t* read;   // byte offset in the input
  int64_t* write;  // of rows: byte offset in the gradient of the input; columns lie as in the input
  int64_t* pixel;  // this axis' share of the flat pixel number

  static int64_t entries(const Axis& axis) { return axis.kernel * 2 * kTile; }
  static int64_t need(const Axis& axis) {
    return 2 * Workspace::need<T>(entries(axis)) + 3 * Workspace::need<int64_t>(entries(axis));
  }
  void take(const Axis& axis, Workspace& memory) {
    weight = memory.take<T>(entries(axis));
    inside = memory.take<T>(entries(axis));
    read = memory.take<int64_t>(entries(axis));
    write = memory.take<int64_t>(entries(axis));
    pixel = memory.take<int64_t>(entries(axis));
  }
};

// The rows of the gradient that a task scatters to; what taps send further is added when all tasks
// are done, and nothing else then.
struct RowPlaces {
  int64_t begin = 0, end = 0;
  int64_t step = 0;     // bytes
  int64_t nowhere = 0;  // a row that nobody reads, bytes from row 0
  bool only_further = false;
  bool limited = false;  // some rows are sent to nowhere: comparisons that cost the others time

  int64_t operator()(int64_t row) const {
    const bool in_reach = (row >= begin) & (row < end);
    return in_reach == only_further ? nowhere : row * step;
  }
};

// Byte steps of an axis; places: of the gradient's rows, or null.
struct AxisSteps {
  int64_t read = 0, pixel = 0;
  const RowPlaces* places = nullptr;
};

// (lo + side) * step; a step of 32 bits lets a narrow Int use the widening multiply.
template <class Int>
SURFCONV_INLINE void fill_offsets(const Int* __restrict lo, int sides, int64_t step,
                                  int64_t* __restrict to) {
  if (sizeof(Int) == 4 && step == static_cast<int32_t>(step)) {
    const int32_t narrow_step = static_cast<int32_t>(step);
    for (int m = 0; m < kTile; ++m) to[m] = static_cast<int64_t>(lo[m]) * narrow_step;
  } else {
    for (int m = 0; m < kTile; ++m) to[m] = static_cast<int64_t>(lo[m]) * step;
  }
  if (sides == 2) {
    for (int m = 0; m < kTile; ++m) to[kTile + m] = to[m] + step;
  }
}

// What the weights of a pixel's taps have in common, both axes together.
template <class T>
struct WeightBounds {
  T lowest[kTile];   // of all weights: positive where every tap lies between pixels of the image
  T nearest[kTile];  // of each tap's side towards the centre: 1 where every tap lies on a pixel of
                     // it
};

// One tap of all pixels: the lower pixel, then weight and presence of both.
template <bool Descending, class T, class Int>
void locate_tile(T half, T tap, Int size, const T* __restrict scale, const Int* __restrict centre,
                 Int* __restrict lo, T* __restrict weight, T* __restrict inside,
                 WeightBounds<T>& bounds) {
  T* __restrict lowest = bounds.lowest;
  T* __restrict nearest = bounds.nearest;
  constexpr int lanes = sizeof(T) == sizeof(Int) ? kComparedLanes<T> : 1;
  using Real = Vec<T, lanes>;
  using Integer = Vec<Int, lanes>;
  using Mask = decltype(Real{} > Real{});
  const T limit = static_cast<T>(int64_t{1} << (sizeof(Int) == 4 ? 29 : 61));
  const Real zero{}, one = zero + T(1);
  for (int m = 0; m < kTile; m += lanes) {
    const auto position =
        locate<Descending>(load<Integer>(centre + m), half, tap, load<Real>(scale + m), limit);
    const Integer at = position.lo;
    const Integer lo_in = position.reachable & (at >= 0) & (at < size);
    const Integer hi_in = position.reachable & (at >= -1) & (at < size - 1);
    const auto in_lo = __builtin_convertvector(lo_in, Mask);
    const auto in_hi = __builtin_convertvector(hi_in, Mask);
    // Far positions become pixel 0, of which nothing is seen: their offsets could overflow.
    store(lo + m, at & (lo_in | hi_in));
    store(inside + m, in_lo ? one : zero);
    store(inside + kTile + m, in_hi ? one : zero);
    const Real weight_lo = in_lo ? one - position.fraction : zero;
    const Real weight_hi = in_hi ? position.fraction : zero;
    store(weight + m, weight_lo);
    store(weight + kTile + m, weight_hi);
    const Real both = weight_lo < weight_hi ? weight_lo : weight_hi;
    const Real low = load<Real>(lowest + m);
    store(lowest + m, Real(both < low ? both : low));
    const Real side = Descending ? weight_hi : weight_lo;
    const Real near = load<Real>(nearest + m);
    store(nearest + m, Real(side < near ? side : near));
  }
}

template <class T, class Int>
void fill_axis(const Axis& axis, const AxisSteps& steps, const T* __restrict scale,
               const Int* __restrict centre, const AxisTable<T>& table, WeightBounds<T>& bounds) {
  const T half = axis.centre_is_half() ? T(0.5) : T(0);
  const Int size = static_cast<Int>(axis.in);
  for (int64_t t = 0; t < axis.kernel; ++t) {
    const T tap = static_cast<T>(axis.tap_doubled(t)) / 2;
    const int64_t at = t * 2 * kTile;
    Int lo[kTile];
    T* __restrict weight = table.weight + at;
    T* __restrict inside = table.inside + at;
    if (axis.fixed(t)) {
      T* __restrict lowest = bounds.lowest;
      T* __restrict nearest = bounds.nearest;
      for (int m = 0; m < kTile; ++m) {
        const bool in = (centre[m] >= 0) & (centre[m] < size);
        lo[m] = in ? centre[m] : 0;
        const T present = in ? T(1) : T(0);
        weight[m] = inside[m] = present;
        lowest[m] = lowest[m] < present ? lowest[m] : present;
        nearest[m] = nearest[m] < present ? nearest[m] : present;
      }
    } else if (tap < 0) {
      locate_tile<true>(half, tap, size, scale, centre, lo, weight, inside, bounds);
    } else {
      locate_tile<false>(half, tap, size, scale, centre, lo, weight, inside, bounds);
    }
    const int sides = axis.fixed(t) ? 1 : 2;
    fill_offsets(lo, sides, steps.read, table.read + at);
    if (steps.pixel != 0) fill_offsets(lo, sides, steps.pixel, table.pixel + at);
    if (steps.places != nullptr) {
      const RowPlaces places = *steps.places;
      if (!places.limited) {
        fill_offsets(lo, sides, places.step, table.write + at);
        continue;
      }
      for (int side = 0; side < sides; ++side) {
        int64_t* __restrict write = table.write + at + side * kTile;
        for (int m = 0; m < kTile; ++m) write[m] = places(static_cast<int64_t>(lo[m]) + side);
      }
    }
  }
}

// The guide around a tile: what each corner's value is compared with.
template <class T>
struct GuideTile {
  const T* image = nullptr;  // the whole image's guide, pixel by pixel; null: no guide
  T tolerance = 0;
  T centre[kTile] = {};
  T exempt[kTile] = {};  // 1 where the centre's own value is not finite: all corners are visible
  int32_t all_seen[kTile] = {};  // 1 where every corner is known to be visible
};

// Corners of one tap: 1, 2 or 4 of them, [corner][kTile]. A corner of zero weight is never seen:
// its offsets point to a row of zeros and to a row that nobody reads.
template <class T>
struct TapCorners {
  int corners;
  bool kink;  // some corner of zero weight still counts for the derivative
  T* weight;
  int64_t* read;
  int64_t* write;
  T* slope;    // d(sample)/d(scale), or of scale_y where there are two components
  T* slope_x;  // of scale_x
};

// body(corners as a constant)
template <class Body>
SURFCONV_INLINE void with_corners(int corners, const Body& body) {
  switch (corners) {
    case 1:
      return body(std::integral_constant<int, 1>{});
    case 2:
      return body(std::integral_constant<int, 2>{});
    default:
      return body(std::integral_constant<int, 4>{});
  }
}

template <class T>
struct CornerTable {
  T* weight;
  T* slope;
  int64_t* read;
  int64_t* write;
  std::vector<TapCorners<T>> taps;

  static int64_t entries(int64_t taps) { return taps * 4 * kTile; }
  static int64_t need(int64_t taps) {
    return 3 * Workspace::need<T>(entries(taps)) + 2 * Workspace::need<int64_t>(entries(taps));
  }
  void take(int64_t count, Workspace& memory) {
    weight = memory.take<T>(entries(count));
    slope = memory.take<T>(2 * entries(count));
    read = memory.take<int64_t>(entries(count));
    write = memory.take<int64_t>(entries(count));
    taps.resize(static_cast<size_t>(count));
    for (int64_t t = 0; t < count; ++t) {
      taps[t] = {4,
                 false,
                 weight + t * 4 * kTile,
                 read + t * 4 * kTile,
                 write + t * 4 * kTile,
                 slope + t * 8 * kTile,
                 slope + t * 8 * kTile + 4 * kTile};
    }
  }
};

enum class Slopes { none, one, two };

// ty, tx: the tap's place in the kernel; unseen_read, unseen_write: where unseen corners point.
template <class T, bool Guided, bool Writes, Slopes S>
void fill_corners(const Conv& conv, int64_t ty, int64_t tx, const AxisTable<T>& rows,
                  const AxisTable<T>& columns, const GuideTile<T>& guide, int64_t unseen_read,
                  int64_t unseen_write, TapCorners<T>& tap) {
  const int sides_y = conv.y.fixed(ty) ? 1 : 2, sides_x = conv.x.fixed(tx) ? 1 : 2;
  const T tap_y = static_cast<T>(conv.y.tap_doubled(ty)) / 2;
  const T tap_x = static_cast<T>(conv.x.tap_doubled(tx)) / 2;
  tap.corners = sides_y * sides_x;
  int kinks = 0;
  for (int i = 0; i < sides_y; ++i) {
    for (int j = 0; j < sides_x; ++j) {
      const int64_t at_y = (ty * 2 + i) * kTile, at_x = (tx * 2 + j) * kTile;
      const int64_t corner = (i * sides_x + j) * kTile;
      const T* __restrict weight_y = rows.weight + at_y;
      const T* __restrict weight_x = columns.weight + at_x;
      const T* __restrict inside_y = rows.inside + at_y;
      const T* __restrict inside_x = columns.inside + at_x;
      T* __restrict weight = tap.weight + corner;
      T visible[kTile];
      if constexpr (Guided) {
        const int64_t* __restrict pixel_y = rows.pixel + at_y;
        const int64_t* __restrict pixel_x = columns.pixel + at_x;
        int64_t pixel[kTile];
        for (int m = 0; m < kTile; ++m) {
          const bool in = (inside_y[m] != 0) & (inside_x[m] != 0);
          pixel[m] = in ? pixel_y[m] + pixel_x[m] : 0;
        }
        T value[kTile];
        for (int m = 0; m < kTile; ++m) value[m] = guide.image[pixel[m]];
        for (int m = 0; m < kTile; ++m) {
          const T distance = std::fabs(value[m] - guide.centre[m]);
          visible[m] = distance <= guide.tolerance ? T(1) : guide.exempt[m];
        }
      }
      for (int m = 0; m < kTile; ++m) {
        weight[m] = weight_y[m] * weight_x[m];
        if constexpr (Guided) weight[m] *= visible[m];
      }
      const int64_t* __restrict read_y = rows.read + at_y;
      const int64_t* __restrict read_x = columns.read + at_x;
      int64_t* __restrict read = tap.read + corner;
      if constexpr (S == Slopes::none) {
        for (int m = 0; m < kTile; ++m)
          read[m] = weight[m] != 0 ? read_y[m] + read_x[m] : unseen_read;
      } else {
        const T sign_y = sides_y == 1 ? T(0) : (i == 0 ? -tap_y : tap_y);
        const T sign_x = sides_x == 1 ? T(0) : (j == 0 ? -tap_x : tap_x);
        T* __restrict slope = tap.slope + corner;
        T* __restrict slope_x = tap.slope_x + corner;
        for (int m = 0; m < kTile; ++m) {
          T along_y = sign_y * inside_y[m] * weight_x[m];
          T along_x = sign_x * weight_y[m] * inside_x[m];
          if constexpr (Guided) {
            along_y *= visible[m];
            along_x *= visible[m];
          }
          slope[m] = S == Slopes::one ? along_y + along_x : along_y;
          if constexpr (S == Slopes::two) slope_x[m] = along_x;
          const bool sloping = (along_y != 0) | (along_x != 0);
          const bool seen = weight[m] != 0;
          kinks |= sloping & !seen;
          read[m] = sloping | seen ? read_y[m] + read_x[m] : unseen_read;
        }
      }
      if constexpr (Writes) {
        const int64_t* __restrict write_y = rows.write + at_y;
        int64_t* __restrict write = tap.write + corner;
        for (int m = 0; m < kTile; ++m) {
          write[m] = weight[m] != 0 ? write_y[m] + read_x[m] : unseen_write;
        }
      }
    }
  }
  tap.kink = kinks != 0;
}
