// to[m * ld + c] = sum over the tap's corners of weight * x, for the tile's pixels.
template <class T, int CORNERS, class Channels>
void gather_corners(const TapCorners<T>& tap, const char* base, int count, Channels channels,
                    T* __restrict to, int64_t ld) {
  const int64_t* __restrict read = tap.read;
  const T* __restrict weights = tap.weight;
  for (int m = 0; m < count; ++m) {
    const T* __restrict from[CORNERS];
    T weight[CORNERS];
#pragma GCC unroll 4
    for (int q = 0; q < CORNERS; ++q) {
      from[q] = reinterpret_cast<const T*>(base + read[q * kTile + m]);
      weight[q] = weights[q * kTile + m];
    }
    for_channels<T>(channels, [&](int64_t c, auto width) {
      using V = Vec<T, decltype(width)::lanes>;
      V sum = load<V>(from[0] + c) * weight[0];
#pragma GCC unroll 3
      for (int q = 1; q < CORNERS; ++q) sum += load<V>(from[q] + c) * weight[q];
      store(to + c, sum);
    });
    to += ld;
  }
}

template <class T>
void gather_tap(const TapCorners<T>& tap, const char* base, int count, int64_t channels, T* to,
                int64_t ld) {
  with_channels<T>(channels, [&](auto known) {
    switch (tap.corners) {
      case 1:
        return gather_corners<T, 1>(tap, base, count, known, to, ld);
      case 2:
        return gather_corners<T, 2>(tap, base, count, known, to, ld);
      default:
        return gather_corners<T, 4>(tap, base, count, known, to, ld);
    }
  });
}
