// What one output pixel of a pool adds to the gradients.
// Which tap has won a channel is random, and so would be branches on it: all channels by all taps.
// Calls body(channel, width, tap, which lanes it has won) for all channels and taps.
template <class T, class W, class Body>
SURFCONV_INLINE void for_winners(const PoolCorners<T>& corners, int64_t taps, int64_t channels,
                                 const W* winners, const Body& body) {
  const auto visit = [&](int64_t c, auto width) SURFCONV_INLINED {
    constexpr int lanes = decltype(width)::lanes;
    using Mask = decltype(Vec<T, lanes>{} > Vec<T, lanes>{});
    using Number = std::conditional_t<sizeof(T) == 8, int64_t, int32_t>;
    const Mask winner = __builtin_convertvector(load<Vec<W, lanes>>(winners + c), Mask);
    for (int64_t t = 0; t < taps; ++t) {
      if (corners.first[t] == corners.first[t + 1]) continue;
      body(c, width, t, Mask(winner == Mask{} + static_cast<Number>(t)));
    }
  };
  constexpr int lanes = kMaxLanes<T>;
  int64_t c = 0;
  for (; c + lanes <= channels; c += lanes) visit(c, Width<lanes>{});
  if constexpr (lanes > 4) {
    if (c < channels) visit(c, Width<4>{});
  }
}

// winners and grad: whole quads of channels.
template <class T, class W>
SURFCONV_INLINE void scatter_winners(const PoolCorners<T>& corners, int64_t taps, int64_t channels,
                                     const T* grad, const W* winners, T* to) {
  if (corners.each == 1) {
    for (int64_t c = 0; c < channels; ++c) {
      const int64_t q = std::min<int64_t>(winners[c], taps);
      to[corners.offset[q] + c] += corners.weight[q] * grad[c];
    }
    return;
  }
  for_winners(corners, taps, channels, winners,
              [&](int64_t c, auto width, int64_t t, auto won) SURFCONV_INLINED {
                using V = Vec<T, decltype(width)::lanes>;
                const V share = won ? load<V>(grad + c) : V{};
                for (int32_t q = corners.first[t]; q < corners.first[t + 1]; ++q) {
                  T* pixel = to + corners.offset[q] + c;
                  store(pixel, V(load<V>(pixel) + corners.weight[q] * share));
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
    T* pixel = to + corners.offset[q];
    const T weight = corners.weight[q];
    for_channels<T>(channels, [&](int64_t c, auto width) SURFCONV_INLINED {
      using V = Vec<T, decltype(width)::lanes>;
      store(pixel + c, V(load<V>(pixel + c) + weight * load<V>(grad + c)));
    });
  }
}

template <class T>
struct ScaleGradient {
  T y = 0, x = 0;
};

template <class T, class W>
ScaleGradient<T> slopes_of_winners(const PoolCorners<T>& corners, int64_t taps, int64_t channels,
                                   const T* grad, const W* winners, const T* image) {
  constexpr int most = kMaxLanes<T>;
  Vec<T, most> sum_y{}, sum_x{};
  T tail_y = 0, tail_x = 0;
  for_winners(corners, taps, channels, winners,
              [&](int64_t c, auto width, int64_t t, auto won) SURFCONV_INLINED {
                constexpr int lanes = decltype(width)::lanes;
                using V = Vec<T, lanes>;
                V slope_y{}, slope_x{};
                for (int32_t q = corners.first[t]; q < corners.first[t + 1]; ++q) {
                  const V value = load<V>(image + corners.offset[q] + c);
                  slope_y += corners.slope_y[q] * value;
                  slope_x += corners.slope_x[q] * value;
                }
                // What is not finite concerns no channel but those that it has won.
                const V outer = load<V>(grad + c);
                slope_y = won ? slope_y * outer : V{};
                slope_x = won ? slope_x * outer : V{};
                if constexpr (lanes == most) {
                  sum_y += slope_y;
                  sum_x += slope_x;
                } else {
                  tail_y += sum_lanes<T>(slope_y);
                  tail_x += sum_lanes<T>(slope_x);
                }
              });
  return {sum_lanes<T>(sum_y) + tail_y, sum_lanes<T>(sum_x) + tail_x};
}

template <class T>
T channel_product(int64_t channels, const T* a, const T* b) {
  Vec<T, kLanes<T>> sum{};
  int64_t c = 0;
  for (; c + kLanes<T> <= channels; c += kLanes<T>) {
    sum += load<Vec<T, kLanes<T>>>(a + c) * load<Vec<T, kLanes<T>>>(b + c);
  }
  T total = sum_lanes<T>(sum);
  for (; c < channels; ++c) total += a[c] * b[c];
  return total;
}
