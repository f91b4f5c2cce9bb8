// Where the taps of one tile of output pixels fall along each axis.
// Loops over a tile always run to its full length, a number the compiler knows; entries beyond the
// tile's pixels hold the geometry of a scale of zero and are not used.
constexpr int kTile = 48;
// The pixels of a tile are padded to it, whole blocks of a product.
constexpr int kRowPad = 6;
static_assert(kTile % kRowPad == 0, "no more than a tile");

// Of rows, taps or what else is counted.
struct Range {
  int64_t begin, end;
  int64_t count() const { return end - begin; }
  bool has(int64_t number) const { return number >= begin && number < end; }
};

// Taps gathered at a time are whole rows of the kernel where a row has no more taps than this.
constexpr int64_t kMostTaps = 64;
SURFCONV_INLINE bool has_whole_rows(const Conv& conv) { return conv.x.kernel <= kMostTaps; }

// Whether 32 bits hold all positions: then there are as many in a vector as floats.
SURFCONV_INLINE bool has_narrow_reach(const Axis& y, const Axis& x) {
  return std::max(y.reach(), x.reach()) < (int64_t{1} << 28);
}

// Derivatives by how many components of the scale are asked for.
enum class Slopes { none, one, two };

// So far from any centre that no image reaches it, and yet their sum does not overflow.
template <class Int>
constexpr Int kFar = Int{1} << (sizeof(Int) == 4 ? 29 : 61);

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

template <class V>
SURFCONV_INLINE V lesser(V a, V b) {
  return a < b ? a : b;
}

// The weights of a tap's two pixels.
template <class Real>
struct Sides {
  Real lower, upper;
};

// Stores one tap of some pixels: the lower pixel, counted from the image's first, then weight and
// presence of both. Returns the weights, 0 outside the image.
template <bool Presence, class T, class Int, class Real, class Integer>
SURFCONV_INLINE Sides<Real> store_tap(const Position<Real, Integer>& tap, Integer centre, Int last,
                                      Int* lo, T* weight, T* inside) {
  using Mask = decltype(Real{} > Real{});
  using Lane = std::make_unsigned_t<Int>;
  using Unsigned = Vec<Lane, sizeof(Integer) / sizeof(Int)>;
  const Real zero{}, one = zero + T(1);
  const Integer at = centre + (tap.reachable ? tap.lo : Integer{} + kFar<Int>);
  const auto from_first = (Unsigned)at;  // before the first, it is the largest of numbers
  const auto lower_in = from_first <= static_cast<Lane>(last);
  const auto upper_in = from_first + 1 <= static_cast<Lane>(last);
  const Mask in_lower = __builtin_convertvector(lower_in, Mask);
  const Mask in_upper = __builtin_convertvector(upper_in, Mask);
  const Sides<Real> seen{in_lower ? one - tap.fraction : zero, in_upper ? tap.fraction : zero};
  // Of a tap outside, of which nothing is seen, pixel 0: its offset could overflow.
  store(lo, Integer(at & (Integer)(lower_in | upper_in)));
  store(weight, seen.lower);
  store(weight + kTile, seen.upper);
  if constexpr (Presence) {
    store(inside, Real(in_lower ? one : zero));
    store(inside + kTile, Real(in_upper ? one : zero));
  }
  return seen;
}

// Tap t, which descends, and the one opposite to it. Half: centres lie between pixels.
template <bool Presence, bool Half, class T, class Int>
void locate_pair(const Axis& axis, int64_t t, const T* __restrict scale,
                 const Int* __restrict centre, const AxisTable<T>& table, Int* __restrict lo,
                 Int* __restrict lo_opposite, WeightBounds<T>& bounds) {
  constexpr int lanes = sizeof(T) == sizeof(Int) ? kComparedLanes<T> : 1;
  using Real = Vec<T, lanes>;
  using Integer = Vec<Int, lanes>;
  const int64_t at = t * 2 * kTile, at_opposite = (axis.kernel - 1 - t) * 2 * kTile;
  T* __restrict weight = table.weight + at;
  T* __restrict weight_opposite = table.weight + at_opposite;
  T* __restrict inside = table.inside + at;
  T* __restrict inside_opposite = table.inside + at_opposite;
  const T tap = static_cast<T>(axis.tap_doubled(axis.kernel - 1 - t)) / 2;
  const T half = Half ? T(0.5) : T(0);
  const T limit = static_cast<T>(kFar<Int>);
  const Int last = static_cast<Int>(axis.in - 1);
  for (int m = 0; m < kTile; m += lanes) {
    const Real own = load<Real>(scale + m);
    const Integer middle = load<Integer>(centre + m);
    const auto up = locate<false, Real, Integer>(half, tap, own, limit);
    const auto down = Half ? locate<true, Real, Integer>(half, -tap, own, limit) : opposite(up);
    const auto above = store_tap<Presence>(up, middle, last, lo_opposite + m, weight_opposite + m,
                                           inside_opposite + m);
    const auto below = store_tap<Presence>(down, middle, last, lo + m, weight + m, inside + m);
    const Real near = lesser(above.lower, below.upper), away = lesser(above.upper, below.lower);
    store(bounds.nearest + m, lesser(load<Real>(bounds.nearest + m), near));
    store(bounds.lowest + m, lesser(load<Real>(bounds.lowest + m), lesser(near, away)));
  }
}

template <class T, class Int>
void locate_fixed(const Axis& axis, const Int* __restrict centre, const AxisTable<T>& table,
                  Int* __restrict lo, WeightBounds<T>& bounds) {
  T* __restrict weight = table.weight + axis.fixed_tap() * 2 * kTile;
  T* __restrict inside = table.inside + axis.fixed_tap() * 2 * kTile;
  T* __restrict lowest = bounds.lowest;
  T* __restrict nearest = bounds.nearest;
  const Int size = static_cast<Int>(axis.in);
  for (int m = 0; m < kTile; ++m) {
    const bool in = (centre[m] >= 0) & (centre[m] < size);
    lo[m] = in ? centre[m] : 0;
    const T present = in ? T(1) : T(0);
    weight[m] = inside[m] = present;
    lowest[m] = lowest[m] < present ? lowest[m] : present;
    nearest[m] = nearest[m] < present ? nearest[m] : present;
  }
}

template <class T, class Int>
void fill_places(const Axis& axis, const AxisSteps& steps, int64_t t, const Int* lo,
                 const AxisTable<T>& table) {
  const int64_t at = t * 2 * kTile;
  const int sides = axis.fixed(t) ? 1 : 2;
  fill_offsets(lo, sides, steps.read, table.read + at);
  if (steps.pixel != 0) fill_offsets(lo, sides, steps.pixel, table.pixel + at);
  if (steps.places == nullptr) return;
  const RowPlaces places = *steps.places;
  if (!places.limited) return fill_offsets(lo, sides, places.step, table.write + at);
  for (int side = 0; side < sides; ++side) {
    int64_t* __restrict write = table.write + at + side * kTile;
    for (int m = 0; m < kTile; ++m) write[m] = places(static_cast<int64_t>(lo[m]) + side);
  }
}

// Presence: whether anybody asks for `inside`.
template <bool Presence, class T, class Int>
void fill_axis(const Axis& axis, const AxisSteps& steps, const T* __restrict scale,
               const Int* __restrict centre, const AxisTable<T>& table, WeightBounds<T>& bounds) {
  Int lo[kTile], lo_opposite[kTile];
  for (int64_t t = 0; t < axis.kernel / 2; ++t) {
    if (axis.centre_is_half()) {
      locate_pair<Presence, true>(axis, t, scale, centre, table, lo, lo_opposite, bounds);
    } else {
      locate_pair<Presence, false>(axis, t, scale, centre, table, lo, lo_opposite, bounds);
    }
    fill_places(axis, steps, t, lo, table);
    fill_places(axis, steps, axis.kernel - 1 - t, lo_opposite, table);
  }
  if (axis.fixed_tap() < 0) return;
  locate_fixed(axis, centre, table, lo, bounds);
  fill_places(axis, steps, axis.fixed_tap(), lo, table);
}
