// Depthwise forward of interior pixels, one output a channel: samples go straight into the sums,
// without a gathered matrix.
template <int KX, class T, int64_t N>
void lane_interior(const Conv& conv, AxisTable<T> rows, AxisTable<T> columns, const char* base,
                   int begin, int end, Fixed<N> lanes, const T* weights, int64_t weight_step,
                   T* out, int64_t ld_out) {
  constexpr int L = widest_lanes<T>(Fixed<N>{});
  using V = Vec<T, L>;
  const Axis axis_y = conv.y, axis_x = conv.x;
  const Rows taps_y{0, axis_y.kernel};
  for (int m = begin; m < end; ++m) {
    V sum[N / L];
#pragma GCC unroll 8
    for (int i = 0; i < N / L; ++i) sum[i] = load<V>(out + m * ld_out + i * L);
    walk_taps<KX>(axis_y, axis_x, rows, columns, taps_y, m,
                  [&](auto r, auto c, const TapSide<T>& y, const TapSide<T>& x, int64_t t)
                      SURFCONV_INLINED {
                        const T* weight = weights + t * weight_step;
                        sample_tap<decltype(r)::value, decltype(c)::value>(
                            base, y, x, lanes, [&](int64_t at, V sample) SURFCONV_INLINED {
                              sum[at / L] += sample * load<V>(weight + at);
                            });
                      });
#pragma GCC unroll 8
    for (int i = 0; i < N / L; ++i) store(out + m * ld_out + i * L, sum[i]);
  }
}

// body(first lane, Fixed<lanes>): as many vectors at a time as sums stay in registers.
template <class T, class Body>
void for_fixed_lanes(int64_t lanes, const Body& body) {
  constexpr int64_t L = kLanes<T>;
  int64_t c = 0;
  if constexpr (L == 8) {  // 64 lanes as well where vectors are short
    for (; c + 8 * L <= lanes; c += 8 * L) body(c, Fixed<8 * L>{});
  }
  for (; c + 4 * L <= lanes; c += 4 * L) body(c, Fixed<4 * L>{});
  for (; c + 2 * L <= lanes; c += 2 * L) body(c, Fixed<2 * L>{});
  for (; c + L <= lanes; c += L) body(c, Fixed<L>{});
  if constexpr (L > 8) {
    for (; c + 8 <= lanes; c += 8) body(c, Fixed<8>{});
  }
  if constexpr (L > 4) {
    for (; c + 4 <= lanes; c += 4) body(c, Fixed<4>{});
  }
}

template <class T>
void lane_forward(const Conv& conv, const Plan& plan, const Tile<T>& tile, const char* base,
                  const T* weights, T* out, int64_t ld_out) {
  with_width(conv.x.kernel, [&](auto width) {
    for_fixed_lanes<T>(plan.row, [&](int64_t c, auto lanes) {
      tile.for_runs([&](const Run& run) {
        if (run.place != Place::interior) return;
        lane_interior<decltype(width)::value>(
            conv, tile.rows(), tile.columns(), base + c * static_cast<int64_t>(sizeof(T)),
            run.begin, run.end, lanes, weights + c, plan.row, out + c, ld_out);
      });
    });
  });
}
