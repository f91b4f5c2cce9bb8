// The contraction where groups are small: element by element over channels. Depthwise, a lane of
// the gathered matrix meets a weight of its own; in groups of up to four channels and outputs,
// which fill a quad of lanes each, all lanes of a quad meet all others (Mix 4). Weights lie
// [tap][k][row]: k is one of `multiplier` outputs of a channel, or a quad's lane that is spread
// over the quad.
struct LaneBlock {
  int64_t lanes;         // of the block, whole quads
  int64_t taps;          // gathered in rows
  int64_t weight_step;   // from one k to the next
  int64_t weight_start;  // of the block's first tap and lane
  int64_t multiplier;
};

// Every quad filled with its lane k.
template <int K, class T, int N>
SURFCONV_INLINE Vec<T, N> spread(Vec<T, N> v) {
  if constexpr (N == 16) {
    return SURFCONV_SHUFFLE(T, 16, v, v, K, K, K, K, K + 4, K + 4, K + 4, K + 4, K + 8, K + 8,
                            K + 8, K + 8, K + 12, K + 12, K + 12, K + 12);
  } else if constexpr (N == 8) {
    return SURFCONV_SHUFFLE(T, 8, v, v, K, K, K, K, K + 4, K + 4, K + 4, K + 4);
  } else {
    static_assert(N == 4, "a quad or more");
    return SURFCONV_SHUFFLE(T, 4, v, v, K, K, K, K);
  }
}

// sum += what the lanes of x contribute; `step` from one k's weights to the next.
template <int MIX, class T, class V>
SURFCONV_INLINE void add_lanes(V& sum, V x, const T* weight, int64_t step) {
  constexpr int L = static_cast<int>(sizeof(V) / sizeof(T));
  if constexpr (MIX == 1) {
    sum += x * load<V>(weight);
  } else {
    sum += spread<0, T, L>(x) * load<V>(weight);
    sum += spread<1, T, L>(x) * load<V>(weight + step);
    sum += spread<2, T, L>(x) * load<V>(weight + 2 * step);
    sum += spread<3, T, L>(x) * load<V>(weight + 3 * step);
  }
}

// body(first lane, Width, VECTORS): four vectors at a time, so that their sums overlap.
template <class T, class Body>
SURFCONV_INLINE void for_lane_chunks(int64_t lanes, const Body& body) {
  constexpr int64_t most = 4 * kLanes<T>;
  int64_t c = 0;
  for (; c + most <= lanes; c += most) {
    body(c, Width<kLanes<T>>{}, std::integral_constant<int, 4>{});
  }
  for_channels<T>(lanes - c, [&](int64_t rest, auto width) SURFCONV_INLINED {
    body(c + rest, width, std::integral_constant<int, 1>{});
  });
}

// out[m][j][lane] += sum over taps of rows[m][tap] * weight; out_row apart for j, ld_out for m.
template <int MIX, class T>
void lane_multiply(const LaneBlock& block, int count, const T* rows, int64_t ld, const T* weights,
                   T* out, int64_t ld_out, int64_t out_row) {
  const int64_t lanes = block.lanes, taps = block.taps, step = block.weight_step;
  const int64_t tap_step = step * block.multiplier * MIX;
  for (int64_t j = 0; j < block.multiplier; ++j) {
    const T* first = weights + block.weight_start + j * step;
    for (int m = 0; m < count; ++m) {
      for_lane_chunks<T>(lanes, [&](int64_t c, auto width, auto vectors) SURFCONV_INLINED {
        constexpr int L = decltype(width)::lanes, N = decltype(vectors)::value;
        using V = Vec<T, L>;
        T* to = out + m * ld_out + j * out_row + c;
        const T* row = rows + m * ld + c;
        const T* weight = first + c;
        V sum[N];
#pragma GCC unroll 4
        for (int i = 0; i < N; ++i) sum[i] = load<V>(to + i * L);
        for (int64_t t = 0; t < taps; ++t) {
#pragma GCC unroll 4
          for (int i = 0; i < N; ++i) {
            add_lanes<MIX>(sum[i], load<V>(row + i * L), weight + i * L, step);
          }
          row += lanes;
          weight += tap_step;
        }
#pragma GCC unroll 4
        for (int i = 0; i < N; ++i) store(to + i * L, sum[i]);
      });
    }
  }
}

// rows[m][tap] = sum over k of gradient[m] * weight; weights are packed for the way back.
template <int MIX, class T>
void lane_matrix_gradient(const LaneBlock& block, int count, const T* gradient, int64_t ld_gradient,
                          int64_t gradient_row, const T* weights, T* rows, int64_t ld) {
  const int64_t lanes = block.lanes, taps = block.taps, step = block.weight_step;
  const int64_t multiplier = block.multiplier, tap_step = step * multiplier * MIX;
  for (int m = 0; m < count; ++m) {
    for_channels<T>(lanes, [&](int64_t c, auto width) SURFCONV_INLINED {
      constexpr int L = decltype(width)::lanes;
      using V = Vec<T, L>;
      const T* from = gradient + m * ld_gradient + c;
      const T* weight = weights + block.weight_start + c;
      T* row = rows + m * ld + c;
      const V g = load<V>(from);
      for (int64_t t = 0; t < taps; ++t) {
        V sum;
        if constexpr (MIX == 1) {
          sum = g * load<V>(weight);
          for (int64_t j = 1; j < multiplier; ++j) {
            sum += load<V>(from + j * gradient_row) * load<V>(weight + j * step);
          }
        } else {
          sum = V{};
          add_lanes<MIX>(sum, g, weight, step);
        }
        store(row, sum);
        row += lanes;
        weight += tap_step;
      }
    });
  }
}

// partial[tap][k][lane] += sum over m of rows[m][tap] * gradient[m]
template <int MIX, class T>
void lane_weight_gradient(const LaneBlock& block, int count, const T* rows, int64_t ld,
                          const T* gradient, int64_t ld_gradient, int64_t gradient_row,
                          T* partial) {
  const int64_t lanes = block.lanes;
  for (int64_t t = 0; t < block.taps; ++t) {
    for (int64_t j = 0; j < block.multiplier; ++j) {
      const T* row = rows + t * lanes;
      const T* from = gradient + j * gradient_row;
      T* to = partial + (t * block.multiplier + j) * MIX * lanes;
      const auto add = [&](int64_t c, auto width, auto vectors) SURFCONV_INLINED {
        constexpr int L = decltype(width)::lanes, N = decltype(vectors)::value;
        using V = Vec<T, L>;
        V sum[N * MIX];
#pragma GCC unroll 4
        for (int i = 0; i < N * MIX; ++i) {
          sum[i] = load<V>(MIX == 1 ? to + c + i * L : to + i * lanes + c);
        }
        for (int m = 0; m < count; ++m) {
          if constexpr (MIX == 1) {
#pragma GCC unroll 4
            for (int i = 0; i < N; ++i) {
              sum[i] +=
                  load<V>(row + m * ld + c + i * L) * load<V>(from + m * ld_gradient + c + i * L);
            }
          } else {
            const V x = load<V>(row + m * ld + c), g = load<V>(from + m * ld_gradient + c);
            sum[0] += spread<0, T, L>(x) * g;
            sum[1] += spread<1, T, L>(x) * g;
            sum[2] += spread<2, T, L>(x) * g;
            sum[3] += spread<3, T, L>(x) * g;
          }
        }
#pragma GCC unroll 4
        for (int i = 0; i < N * MIX; ++i) {
          store(MIX == 1 ? to + c + i * L : to + i * lanes + c, sum[i]);
        }
      };
      if constexpr (MIX == 1) {
        for_lane_chunks<T>(lanes, add);
      } else {
        for_channels<T>(lanes, [&](int64_t c, auto width) SURFCONV_INLINED {
          add(c, width, std::integral_constant<int, 1>{});
        });
      }
    }
  }
}
