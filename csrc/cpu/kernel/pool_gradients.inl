// What one output pixel of a pool adds to the gradients.

// Lanes of -1 where two numbers, neither of them negative, are equal, else 0.
template <class V>
SURFCONV_INLINE V equal_lanes(V a, V b) {
  if constexpr (sizeof(V) <= kComparedBytes) {
    return a == b;
  } else {
    return ((a ^ b) - 1) >> static_cast<int>(8 * sizeof(a[0]) - 1);
  }
}

// Zero where the mask is not set, also of what is not finite.
template <class V, class M>
SURFCONV_INLINE V masked(M mask, V value) {
  return (V)((M)value & mask);
}

// Which tap has won each channel of a strip. It is random, and so would be branches on it.
template <class T, class S>
struct WinnersOf {
  using Number = std::conditional_t<sizeof(T) == 8, int64_t, int32_t>;
  using Numbers = Vec<Number, S::lanes>;
  Numbers winner[S::vectors];

  template <class W>
  explicit SURFCONV_INLINE WinnersOf(const W* from) {
#pragma GCC unroll 4
    for (int i = 0; i < S::vectors; ++i) {
      winner[i] = __builtin_convertvector(load<Vec<W, S::lanes>>(from + i * S::lanes), Numbers);
    }
  }
  // Lanes of -1 in vector i where tap t has won.
  SURFCONV_INLINE Numbers operator()(int i, int64_t t) const {
    return equal_lanes(winner[i], Numbers{} + static_cast<Number>(t));
  }
};

// to += weight * share
template <class S, class T, class V>
SURFCONV_INLINE void add_strip(S, T weight, const V (&share)[S::vectors], T* to) {
#pragma GCC unroll 4
  for (int i = 0; i < S::vectors; ++i) {
    T* place = to + i * S::lanes;
    store(place, V(load<V>(place) + weight * share[i]));
  }
}

// winners and grad: whole quads of channels.
template <class T, class W>
SURFCONV_INLINE void scatter_winners(const PoolCorners<T>& corners, int64_t taps, int64_t channels,
                                     const T* grad, const W* winners, T* to) {
  for_strips<T>(channels, [&](int64_t c, auto strip) SURFCONV_INLINED {
    using S = decltype(strip);
    using V = Vec<T, S::lanes>;
    const WinnersOf<T, S> won(winners + c);
    for_seen_taps(corners, taps, [&](auto count, int64_t t, int64_t at) SURFCONV_INLINED {
      V share[S::vectors];
#pragma GCC unroll 4
      for (int i = 0; i < S::vectors; ++i) {
        share[i] = masked(won(i, t), load<V>(grad + c + i * S::lanes));
      }
#pragma GCC unroll 4
      for (int q = 0; q < decltype(count)::value; ++q, at += corners.step) {
        add_strip(strip, corners.weight[at], share, to + corners.offset[at] + c);
      }
    });
  });
}

template <class T>
SURFCONV_INLINE void scatter_average(const PoolCorners<T>& corners, T divisor, int64_t channels,
                                     const T* grad, T* to) {
  if (divisor == 0) return;
  for_strips<T>(channels, [&](int64_t c, auto strip) SURFCONV_INLINED {
    using S = decltype(strip);
    using V = Vec<T, S::lanes>;
    V share[S::vectors];
#pragma GCC unroll 4
    for (int i = 0; i < S::vectors; ++i) share[i] = load<V>(grad + c + i * S::lanes) / divisor;
    for (int64_t q = 0; q < corners.count; ++q) {
      const int64_t at = q * corners.step;
      add_strip(strip, corners.weight[at], share, to + corners.offset[at] + c);
    }
  });
}

template <class T>
struct ScaleGradient {
  T y = 0, x = 0;  // by the scale, or by its two components
};

// Sums of a strip's lanes, added up over the strips of a pixel.
template <class T>
class LaneSums {
 public:
  template <class V, int N>
  SURFCONV_INLINE void add(const V (&parts)[N]) {
    V sum = parts[0];
#pragma GCC unroll 4
    for (int i = 1; i < N; ++i) sum += parts[i];
    if constexpr (sizeof(V) == sizeof(whole_)) {
      whole_ += sum;
    } else {
      tail_ += sum_lanes<T>(sum);
    }
  }
  T total() const { return sum_lanes<T>(whole_) + tail_; }

 private:
  Vec<T, kLanes<T>> whole_{};
  T tail_ = 0;
};

template <Slopes Of, class T, class W>
ScaleGradient<T> slopes_of_winners(const PoolCorners<T>& corners, int64_t taps, int64_t channels,
                                   const T* grad, const W* winners, const T* image) {
  LaneSums<T> sum, sum_x;
  for_strips<T>(channels, [&](int64_t c, auto strip) SURFCONV_INLINED {
    using S = decltype(strip);
    using V = Vec<T, S::lanes>;
    const WinnersOf<T, S> won(winners + c);
    V along[S::vectors] = {}, along_x[S::vectors] = {};
    for_seen_taps(corners, taps, [&](auto count, int64_t t, int64_t at) SURFCONV_INLINED {
      V slope[S::vectors] = {}, slope_x[S::vectors] = {};
#pragma GCC unroll 4
      for (int q = 0; q < decltype(count)::value; ++q, at += corners.step) {
        const T* pixel = image + corners.offset[at] + c;
#pragma GCC unroll 4
        for (int i = 0; i < S::vectors; ++i) {
          const V value = load<V>(pixel + i * S::lanes);
          slope[i] += corners.slope[at] * value;
          if constexpr (Of == Slopes::two) slope_x[i] += corners.slope_x[at] * value;
        }
      }
#pragma GCC unroll 4
      for (int i = 0; i < S::vectors; ++i) {
        const V outer = load<V>(grad + c + i * S::lanes);
        along[i] += masked(won(i, t), V(slope[i] * outer));
        if constexpr (Of == Slopes::two) along_x[i] += masked(won(i, t), V(slope_x[i] * outer));
      }
    });
    sum.add(along);
    if constexpr (Of == Slopes::two) sum_x.add(along_x);
  });
  return {sum.total(), sum_x.total()};
}

// weighted: the weights make up the divisor, and what they gain takes from each corner its share.
template <Slopes Of, class T>
ScaleGradient<T> slopes_of_average(const PoolCorners<T>& corners, bool weighted, T divisor,
                                   int64_t channels, const T* grad, const T* image) {
  if (divisor == 0) return {};
  const bool gains = weighted && corners.moves_total;
  double gain = 0, gain_x = 0;
  if (gains) {
    gain = static_cast<double>(corners.hidden_slope);
    gain_x = static_cast<double>(corners.hidden_slope_x);
    for (int64_t q = 0; q < corners.count; ++q) {
      gain += static_cast<double>(corners.slope[q * corners.step]);
      if (Of == Slopes::two) gain_x += static_cast<double>(corners.slope_x[q * corners.step]);
    }
    gain /= static_cast<double>(divisor);
    gain_x /= static_cast<double>(divisor);
  }
  const auto net_slope = [&](T slope, T weight, double by) SURFCONV_INLINED {
    if (!gains) return slope;
    return static_cast<T>(static_cast<double>(slope) - static_cast<double>(weight) * by);
  };
  LaneSums<T> sum, sum_x;
  for_strips<T>(channels, [&](int64_t c, auto strip) SURFCONV_INLINED {
    using S = decltype(strip);
    using V = Vec<T, S::lanes>;
    V along[S::vectors] = {}, along_x[S::vectors] = {};
    for (int64_t q = 0; q < corners.count; ++q) {
      const int64_t at = q * corners.step;
      const T slope = net_slope(corners.slope[at], corners.weight[at], gain);
      const T slope_x =
          Of == Slopes::two ? net_slope(corners.slope_x[at], corners.weight[at], gain_x) : T(0);
      // What is not finite concerns nothing that does not move.
      if (slope == 0 && slope_x == 0) continue;
      const T* pixel = image + corners.offset[at] + c;
#pragma GCC unroll 4
      for (int i = 0; i < S::vectors; ++i) {
        const V value = load<V>(pixel + i * S::lanes);
        along[i] += slope * value;
        if constexpr (Of == Slopes::two) along_x[i] += slope_x * value;
      }
    }
#pragma GCC unroll 4
    for (int i = 0; i < S::vectors; ++i) {
      const V outer = load<V>(grad + c + i * S::lanes);
      along[i] *= outer;
      along_x[i] *= outer;
    }
    sum.add(along);
    if constexpr (Of == Slopes::two) sum_x.add(along_x);
  });
  return {sum.total() / divisor, sum_x.total() / divisor};
}
