// Where the taps of a pool's output pixels fall: tables of a tile of pixels for each axis.
enum class Edges { zero, clamp };  // what samples outside the image are: an average's, a maximum's

// Per axis, tap and side (pixel `lo`, then `lo + 1`), one entry for each pixel of the tile.
template <class T>
struct PoolAxis {
  T* weight;
  T* slope;         // of the weight, by the scale; also where the weight is 0 on a pixel
  int64_t* pixel;   // inside the image, whatever the weight
  int64_t* offset;  // of the pixel, in elements

  static int64_t entries(const Axis& axis) { return axis.kernel * 2 * kTile; }
  static int64_t need(const Axis& axis) {
    return 2 * Workspace::need<T>(entries(axis)) + 2 * Workspace::need<int64_t>(entries(axis));
  }
  void take(const Axis& axis, Workspace& memory) {
    weight = memory.take<T>(entries(axis));
    slope = memory.take<T>(entries(axis));
    pixel = memory.take<int64_t>(entries(axis));
    offset = memory.take<int64_t>(entries(axis));
  }
};

// What all taps of a pixel have in common, both axes together.
template <class T>
struct PoolBounds {
  T between[kTile];  // of their weights the least: positive where every tap lies between pixels
  T on_grid[kTile];  // of the weights on each tap's side towards the centre the least: 1 where
                     // every tap lies on a pixel
  T inside[kTile];   // 1 where both sides of every tap are in the image, else 0
};

// A tap other than the centre's, of all pixels.
template <Edges E, bool Descending, class T, class Int>
void locate_pool(const Axis& axis, T half, T tap, const T* __restrict scale,
                 const Int* __restrict centre, T* __restrict weight, T* __restrict slope,
                 int64_t* __restrict pixel, PoolBounds<T>& bounds) {
  constexpr int lanes = sizeof(T) == sizeof(Int) ? kComparedLanes<T> : 4;
  using Real = Vec<T, lanes>;
  using Integer = Vec<Int, lanes>;
  using Mask = decltype(Real{} > Real{});
  constexpr T kLargest = std::numeric_limits<T>::max();
  const T limit = static_cast<T>(kFar<Int>);
  const Int last = static_cast<Int>(axis.in - 1);
  const Real zero{}, one = zero + T(1);
  const auto as_mask = [](Integer mask) { return __builtin_convertvector(mask, Mask); };
  const auto as_integer = [](Mask mask) { return __builtin_convertvector(mask, Integer); };
  for (int m = 0; m < kTile; m += lanes) {
    const Real own_scale = load<Real>(scale + m);
    const auto position = locate<Descending, Real, Integer>(half, tap, own_scale, limit);
    const Integer near = position.reachable, lo = load<Integer>(centre + m) + position.lo;
    // In steps of what 1 - fraction can tell: a quotient of weights keeps its precision where the
    // guide leaves nothing but a corner that is all but at its end.
    Real fraction = one - (one - position.fraction);
    Integer in_lo, in_hi, pixel_lo, pixel_hi;
    Mask seen_lo, seen_hi;
    if constexpr (E == Edges::zero) {
      in_lo = near & (lo >= 0) & (lo <= last);
      in_hi = near & (lo >= -1) & (lo < last);
      pixel_lo = lo & in_lo;
      pixel_hi = (lo + 1) & in_hi;
      seen_lo = as_mask(in_lo);
      seen_hi = as_mask(in_hi);
    } else {
      const Integer backwards = as_integer(own_scale * tap < 0);
      const Integer before = (near & (lo < 0)) | (~near & backwards);
      const Integer behind = (near & (lo >= last)) | (~near & ~backwards);
      const Integer finite = as_integer((own_scale <= kLargest) & (own_scale >= -kLargest));
      // As in nn, where a clamped tap could fall between the pixels of a dilated kernel.
      const Integer exact = lo - as_integer(fraction == 1);
      const Integer left_out =
          ~finite | (as_integer(own_scale == 1) & ((exact < 0) | (exact > last)));
      fraction = as_mask(before | behind) ? zero : fraction;
      in_lo = in_hi = ~(before | behind | left_out);
      pixel_lo = ~before & ((behind & last) | (~behind & lo));
      pixel_hi = (in_hi & (lo + 1)) | (~in_hi & pixel_lo);
      seen_lo = seen_hi = as_mask(~left_out);
    }
    const Real weight_lo = seen_lo ? one - fraction : zero;
    const Real weight_hi = seen_hi ? fraction : zero;
    store(pixel + m, __builtin_convertvector(pixel_lo, Vec<int64_t, lanes>));
    store(pixel + kTile + m, __builtin_convertvector(pixel_hi, Vec<int64_t, lanes>));
    store(weight + m, weight_lo);
    store(weight + kTile + m, weight_hi);
    store(slope + m, Real(as_mask(in_lo) ? zero - tap : zero));
    store(slope + kTile + m, Real(as_mask(in_hi) ? zero + tap : zero));
    const auto lower = [&](T* to, Real value) {
      const Real least = load<Real>(to);
      store(to, Real(value < least ? value : least));
    };
    lower(bounds.between + m, weight_lo < weight_hi ? weight_lo : weight_hi);
    lower(bounds.on_grid + m, Descending ? weight_hi : weight_lo);
    lower(bounds.inside + m, as_mask(in_lo & in_hi) ? one : zero);
  }
}

// step: of offsets
template <Edges E, class T, class Int>
void fill_pool_axis(const Axis& axis, int64_t step, const T* __restrict scale,
                    const Int* __restrict centre, const PoolAxis<T>& table, PoolBounds<T>& bounds) {
  const T half = axis.centre_is_half() ? T(0.5) : T(0);
  const Int last = static_cast<Int>(axis.in - 1);
  for (int64_t t = 0; t < axis.kernel; ++t) {
    T* weight = table.weight + t * 2 * kTile;
    T* slope = table.slope + t * 2 * kTile;
    int64_t* pixel = table.pixel + t * 2 * kTile;
    const T tap = static_cast<T>(axis.tap_doubled(t)) / 2;
    if (axis.fixed(t)) {
      for (int m = 0; m < kTile; ++m) {
        const bool in = (centre[m] >= 0) & (centre[m] <= last);
        const bool seen = in | (E == Edges::clamp && scale[m] != 1);
        pixel[m] = pixel[kTile + m] = std::min(std::max<Int>(centre[m], 0), last);
        weight[m] = seen ? T(1) : T(0);
        weight[kTile + m] = slope[m] = slope[kTile + m] = 0;
        bounds.between[m] = std::min(bounds.between[m], weight[m]);
        bounds.on_grid[m] = std::min(bounds.on_grid[m], weight[m]);
      }
    } else if (tap < 0) {
      locate_pool<E, true>(axis, half, tap, scale, centre, weight, slope, pixel, bounds);
    } else {
      locate_pool<E, false>(axis, half, tap, scale, centre, weight, slope, pixel, bounds);
    }
    int64_t* __restrict offset = table.offset + t * 2 * kTile;
    for (int i = 0; i < 2 * kTile; ++i) offset[i] = pixel[i] * step;
  }
}
