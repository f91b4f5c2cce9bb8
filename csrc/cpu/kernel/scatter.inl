// total += a * b in a register; the narrower vectors of a channel tail add to memory.
template <bool InRegister, class T, class V, class Total>
SURFCONV_INLINE void add_product(Total& total, T* memory, V a, V b) {
  if constexpr (InRegister) {
    total += a * b;
  } else {
    store(memory, V(load<V>(memory) + a * b));
  }
}

// The backward pass over one tap of a tile. `rows` holds the gradient of the gathered matrix and is
// overwritten by the gathered matrix itself, which the weight's gradient needs next.
//   grad_input[corner] += weight * gradient          (Writes)
//   dot[m]             += gradient * d(sample)/d(scale), one vector of partial sums a pixel (S)
// With Kinked, corners of zero weight hold a real pixel for the derivative's sake and must not
// touch the sample: 0 * inf.
template <class T, int CORNERS, bool Writes, Slopes S, bool Kinked, class Channels>
void scatter_corners(const TapCorners<T>& tap, const char* read_base, char* write_base, int count,
                     Channels channels, T* __restrict rows, int64_t ld, T* dot, T* dot_x) {
  constexpr int L = kLanes<T>;
  for (int m = 0; m < count; ++m) {
    const T* from[CORNERS];
    T* to[CORNERS];
    T weight[CORNERS], slope[CORNERS], slope_x[CORNERS];
#pragma GCC unroll 4
    for (int q = 0; q < CORNERS; ++q) {
      from[q] = reinterpret_cast<const T*>(read_base + tap.read[q * kTile + m]);
      weight[q] = tap.weight[q * kTile + m];
      if constexpr (Writes) to[q] = reinterpret_cast<T*>(write_base + tap.write[q * kTile + m]);
      if constexpr (S != Slopes::none) slope[q] = tap.slope[q * kTile + m];
      if constexpr (S == Slopes::two) slope_x[q] = tap.slope_x[q * kTile + m];
    }
    T* row = rows + m * ld;
    Vec<T, L> total{}, total_x{};
    for_channels<T>(channels, [&](int64_t c, auto width) SURFCONV_INLINED {
      constexpr int lanes = decltype(width)::lanes;
      using V = Vec<T, lanes>;
      const V gradient = load<V>(row + c);
      V sample{}, along{}, along_x{};
#pragma GCC unroll 4
      for (int q = 0; q < CORNERS; ++q) {
        const V x = load<V>(from[q] + c);
        if constexpr (Kinked) {
          if (weight[q] != 0) sample += x * weight[q];
        } else {
          sample += x * weight[q];
        }
        if constexpr (S != Slopes::none) along += x * slope[q];
        if constexpr (S == Slopes::two) along_x += x * slope_x[q];
      }
      if constexpr (S != Slopes::none) add_product<lanes == L>(total, dot + m * L, along, gradient);
      if constexpr (S == Slopes::two) {
        add_product<lanes == L>(total_x, dot_x + m * L, along_x, gradient);
      }
      if constexpr (Writes) {
#pragma GCC unroll 4
        for (int q = 0; q < CORNERS; ++q) {
          store(to[q] + c, V(load<V>(to[q] + c) + gradient * weight[q]));
        }
      }
      store(row + c, sample);
    });
    using Full = Vec<T, L>;
    if constexpr (S != Slopes::none) store(dot + m * L, Full(load<Full>(dot + m * L) + total));
    if constexpr (S == Slopes::two) store(dot_x + m * L, Full(load<Full>(dot_x + m * L) + total_x));
  }
}

template <class T, bool Writes, Slopes S>
void scatter_tap(const TapCorners<T>& tap, const char* read_base, char* write_base, int count,
                 int64_t channels, T* rows, int64_t ld, T* dot, T* dot_x) {
  const auto run = [&](auto corners, auto kinked, auto known) {
    scatter_corners<T, decltype(corners)::value, Writes, S, decltype(kinked)::value>(
        tap, read_base, write_base, count, known, rows, ld, dot, dot_x);
  };
  const auto by_kink = [&](auto corners) {
    if constexpr (S != Slopes::none) {
      if (tap.kink) return run(corners, std::true_type{}, channels);
    }
    with_channels<T>(channels, [&](auto known) { run(corners, std::false_type{}, known); });
  };
  switch (tap.corners) {
    case 1:
      return by_kink(std::integral_constant<int, 1>{});
    case 2:
      return by_kink(std::integral_constant<int, 2>{});
    default:
      return by_kink(std::integral_constant<int, 4>{});
  }
}
