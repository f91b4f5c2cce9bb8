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

// Calls body(channel, width, tap, which lanes it has won) for all channels and taps: which tap has
// won a channel is random, and so would be branches on it.
template <class T, class W, class Body>
SURFCONV_INLINE void for_winners(const PoolCorners<T>& corners, int64_t taps, int64_t channels,
                                 const W* winners, const Body& body) {
  using Number = std::conditional_t<sizeof(T) == 8, int64_t, int32_t>;
  const auto visit = [&](int64_t c, auto width) SURFCONV_INLINED {
    constexpr int lanes = decltype(width)::lanes;
    using Numbers = Vec<Number, lanes>;
    const auto winner = __builtin_convertvector(load<Vec<W, lanes>>(winners + c), Numbers);
    for (int64_t t = 0; t < taps; ++t) {
      if (!corners.sees(t)) continue;
      body(c, width, t, equal_lanes(winner, Numbers{} + static_cast<Number>(t)));
    }
  };
  for_channels<T>(channels, visit);
}

// winners and grad: whole quads of channels.
template <class T, class W>
SURFCONV_INLINE void scatter_winners(const PoolCorners<T>& corners, int64_t taps, int64_t channels,
                                     const T* grad, const W* winners, T* to) {
  for_winners(corners, taps, channels, winners,
              [&](int64_t c, auto width, int64_t t, auto won) SURFCONV_INLINED {
                using V = Vec<T, decltype(width)::lanes>;
                const V share = masked(won, load<V>(grad + c));
                for (int32_t q = corners.first[t]; q < corners.first[t + 1]; ++q) {
                  T* pixel = to + corners.offset[q * corners.step] + c;
                  store(pixel, V(load<V>(pixel) + corners.weight[q * corners.step] * share));
                }
              });
}

// grad is changed: it becomes the gradient of the sum.
template <class T>
SURFCONV_INLINE void scatter_average(const PoolCorners<T>& corners, T divisor, int64_t channels,
                                     T* grad, T* to) {
  if (divisor == 0) return;
  for_channels<T>(channels, [&](int64_t c, auto width) SURFCONV_INLINED {
    using V = Vec<T, decltype(width)::lanes>;
    store(grad + c, V(load<V>(grad + c) / divisor));
  });
  for (int64_t q = 0; q < corners.count; ++q) {
    T* pixel = to + corners.offset[q * corners.step];
    const T weight = corners.weight[q * corners.step];
    for_channels<T>(channels, [&](int64_t c, auto width) SURFCONV_INLINED {
      using V = Vec<T, decltype(width)::lanes>;
      store(pixel + c, V(load<V>(pixel + c) + weight * load<V>(grad + c)));
    });
  }
}

template <class T>
struct ScaleGradient {
  T y = 0, x = 0;  // by the scale, or by its two components
};

template <Slopes S, class T, class W>
ScaleGradient<T> slopes_of_winners(const PoolCorners<T>& corners, int64_t taps, int64_t channels,
                                   const T* grad, const W* winners, const T* image) {
  constexpr int most = kLanes<T>;
  Vec<T, most> sum_y{}, sum_x{};
  T tail_y = 0, tail_x = 0;
  for_winners(corners, taps, channels, winners,
              [&](int64_t c, auto width, int64_t t, auto won) SURFCONV_INLINED {
                constexpr int lanes = decltype(width)::lanes;
                using V = Vec<T, lanes>;
                V slope{}, slope_x{};
                for (int32_t q = corners.first[t]; q < corners.first[t + 1]; ++q) {
                  const int64_t at = q * corners.step;
                  const V value = load<V>(image + corners.offset[at] + c);
                  slope += corners.slope[at] * value;
                  if constexpr (S == Slopes::two) slope_x += corners.slope_x[at] * value;
                }
                const V outer = load<V>(grad + c);
                slope = masked(won, V(slope * outer));
                if constexpr (S == Slopes::two) slope_x = masked(won, V(slope_x * outer));
                if constexpr (lanes == most) {
                  sum_y += slope;
                  sum_x += slope_x;
                } else {
                  tail_y += sum_lanes<T>(slope);
                  tail_x += sum_lanes<T>(slope_x);
                }
              });
  return {sum_lanes<T>(sum_y) + tail_y, sum_lanes<T>(sum_x) + tail_x};
}

// weighted: the weights make up the divisor, and what they gain takes from each corner its share.
template <Slopes S, class T>
ScaleGradient<T> slopes_of_average(const PoolCorners<T>& corners, bool weighted, T divisor,
                                   int64_t channels, const T* grad, const T* image) {
  if (divisor == 0) return {};
  double gain = 0, gain_x = 0;
  if (weighted && corners.moves_total) {
    gain = static_cast<double>(corners.hidden_slope);
    gain_x = static_cast<double>(corners.hidden_slope_x);
    for (int64_t q = 0; q < corners.count; ++q) {
      gain += static_cast<double>(corners.slope[q * corners.step]);
      if (S == Slopes::two) gain_x += static_cast<double>(corners.slope_x[q * corners.step]);
    }
    gain /= static_cast<double>(divisor);
    gain_x /= static_cast<double>(divisor);
  }
  Vec<T, kLanes<T>> sum_y{}, sum_x{};
  T tail_y = 0, tail_x = 0;
  for_channels<T>(channels, [&](int64_t c, auto width) SURFCONV_INLINED {
    constexpr int lanes = decltype(width)::lanes;
    using V = Vec<T, lanes>;
    V along{}, along_x{};
    for (int64_t q = 0; q < corners.count; ++q) {
      const int64_t at = q * corners.step;
      const double weight = static_cast<double>(corners.weight[at]);
      const T slope = static_cast<T>(static_cast<double>(corners.slope[at]) - weight * gain);
      T slope_x = 0;
      if constexpr (S == Slopes::two) {
        slope_x = static_cast<T>(static_cast<double>(corners.slope_x[at]) - weight * gain_x);
      }
      // What is not finite concerns nothing that does not move.
      if (slope == 0 && slope_x == 0) continue;
      const V value = load<V>(image + corners.offset[at] + c);
      along += slope * value;
      if constexpr (S == Slopes::two) along_x += slope_x * value;
    }
    along *= load<V>(grad + c);
    if constexpr (S == Slopes::two) along_x *= load<V>(grad + c);
    if constexpr (lanes == kLanes<T>) {
      sum_y += along;
      sum_x += along_x;
    } else {
      tail_y += sum_lanes<T>(along);
      tail_x += sum_lanes<T>(along_x);
    }
  });
  return {(sum_lanes<T>(sum_y) + tail_y) / divisor, (sum_lanes<T>(sum_x) + tail_x) / divisor};
}
