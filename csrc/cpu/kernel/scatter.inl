// The backward pass over the taps of a tile. The matrix holds the gradient of the gathered matrix
// and is overwritten by the gathered matrix itself, which the weight's gradient needs next.
//   grad_input[corner] += weight * gradient          (Writes)
//   dot[m]             += gradient * d(sample)/d(scale), one vector of partial sums a pixel (S)
// dot and dot_x (of scale_x, where there are two components) hold kLanes sums for each pixel.
template <class T>
struct ScatterTarget {
  const char* read;  // input
  char* write;       // its gradient
  T* dot;
  T* dot_x;
  const T* zeros;  // what lies outside the image
  T* discard;      // what nobody reads
};

// A pixel's partial sums while its taps are walked: in a register; the narrower vectors of a
// channel tail add to memory.
template <class T, class Channels>
class PixelDot {
 public:
  PixelDot(const ScatterTarget<T>& target, int m)
      : dot_(target.dot + m * kLanes<T>), dot_x_(target.dot_x + m * kLanes<T>) {}

  // along: d(sample)/d(scale), or of its y component; along_x: of its x component
  template <class V>
  SURFCONV_INLINE void add(V along, V gradient) {
    add_to(total_, dot_, along, gradient);
  }
  template <class V>
  SURFCONV_INLINE void add_x(V along_x, V gradient) {
    add_to(total_x_, dot_x_, along_x, gradient);
  }
  SURFCONV_INLINE void finish() const { store(dot_, Full(load<Full>(dot_) + total_)); }
  SURFCONV_INLINE void finish_x() const { store(dot_x_, Full(load<Full>(dot_x_) + total_x_)); }

 private:
  using Full = Vec<T, widest_lanes<T>(Channels{})>;

  template <class V>
  static SURFCONV_INLINE void add_to(Full& total, T* memory, V along, V gradient) {
    if constexpr (sizeof(V) == sizeof(Full)) {
      total += along * gradient;
    } else {
      store(memory, V(load<V>(memory) + along * gradient));
    }
  }

  Full total_{}, total_x_{};
  T* dot_;
  T* dot_x_;
};

// One tap of one pixel from the weight and slope of each corner. With Kinked, corners of zero
// weight hold a real pixel for the derivative's sake and must not touch the sample: 0 * inf.
template <int CORNERS, bool Writes, Slopes S, bool Kinked, class T, class W, class Channels,
          class Dot>
SURFCONV_INLINE void scatter_corners(const T* const* from, T* const* to, const W* weight,
                                     const W* slope, const W* slope_x, Channels channels, T* row,
                                     Dot& dot) {
  for_channels<T>(channels, [&](int64_t c, auto width) SURFCONV_INLINED {
    using V = Vec<T, decltype(width)::lanes>;
    const V gradient = load<V>(row + c);
    V sample{}, along{}, along_x{};
#pragma GCC unroll 4
    for (int q = 0; q < CORNERS; ++q) {
      const V x = load<V>(from[q] + c);
      if constexpr (Kinked) {
        static_assert(std::is_same_v<T, W>, "weights that can be asked whether they are zero");
        if (weight[q] != 0) sample += x * weight[q];
      } else {
        sample += x * weight[q];
      }
      if constexpr (S != Slopes::none) along += x * slope[q];
      if constexpr (S == Slopes::two) along_x += x * slope_x[q];
    }
    if constexpr (S != Slopes::none) dot.add(along, gradient);
    if constexpr (S == Slopes::two) dot.add_x(along_x, gradient);
    if constexpr (Writes) {
#pragma GCC unroll 4
      for (int q = 0; q < CORNERS; ++q) {
        store(to[q] + c, V(load<V>(to[q] + c) + gradient * weight[q]));
      }
    }
    store(row + c, sample);
  });
}

// Pixels begin .. end-1 of one tap by its corner table.
template <int CORNERS, bool Writes, Slopes S, bool Kinked, class T, class Channels>
void scatter_run(const TapCorners<T>& tap, const ScatterTarget<T>& target, int begin, int end,
                 Channels channels, T* matrix, int64_t ld) {
  for (int m = begin; m < end; ++m) {
    const T* from[CORNERS];
    T* to[CORNERS];
    T weight[CORNERS], slope[CORNERS], slope_x[CORNERS];
#pragma GCC unroll 4
    for (int q = 0; q < CORNERS; ++q) {
      from[q] = reinterpret_cast<const T*>(target.read + tap.read[q * kTile + m]);
      weight[q] = tap.weight[q * kTile + m];
      if constexpr (Writes) to[q] = reinterpret_cast<T*>(target.write + tap.write[q * kTile + m]);
      if constexpr (S != Slopes::none) slope[q] = tap.slope[q * kTile + m];
      if constexpr (S == Slopes::two) slope_x[q] = tap.slope_x[q * kTile + m];
    }
    PixelDot<T, Channels> dot(target, m);
    scatter_corners<CORNERS, Writes, S, Kinked>(from, to, weight, slope, slope_x, channels,
                                                matrix + m * ld, dot);
    if constexpr (S != Slopes::none) dot.finish();
    if constexpr (S == Slopes::two) dot.finish_x();
  }
}

template <bool Writes, Slopes S, class T>
void scatter_tap(const TapCorners<T>& tap, const ScatterTarget<T>& target, int begin, int end,
                 int64_t channels, T* matrix, int64_t ld) {
  const auto run = [&](auto corners, auto kinked, auto known) {
    scatter_run<decltype(corners)::value, Writes, S, decltype(kinked)::value>(
        tap, target, begin, end, known, matrix, ld);
  };
  const auto by_kink = [&](auto corners) {
    if constexpr (S != Slopes::none) {
      if (tap.kink) return run(corners, std::true_type{}, channels);
    }
    with_channels<T>(channels, [&](auto known) { run(corners, std::false_type{}, known); });
  };
  with_corners(tap.corners, by_kink);
}
