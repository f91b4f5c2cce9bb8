// Depthwise forward, one output a channel: samples go straight into the sums, without a gathered
// matrix. Of each pixel's taps only what is seen of the image is walked, so that pixels between
// pixels, on the grid and at the border differ in numbers alone; the guide, which looks at corners
// one by one, is left to the gathered matrix.

// One tap of one pixel along one axis.
template <class T>
struct SeenTap {
  int64_t read;  // byte offset of the first place seen; the second is the next pixel
  T weight[2];
};

template <class T>
struct SeenAxis {
  int64_t taps;
  SeenTap<T>* seen;  // [taps][kTile]
  int8_t* sides;     // [taps][kTile]: places seen, 0 to 2

  static int64_t need(const Axis& axis) {
    return Workspace::need<SeenTap<T>>(axis.kernel * kTile) +
           Workspace::need<int8_t>(axis.kernel * kTile);
  }
  void take(const Axis& axis, Workspace& memory) {
    taps = axis.kernel;
    seen = memory.take<SeenTap<T>>(taps * kTile);
    sides = memory.take<int8_t>(taps * kTile);
  }

  void fill(Axis axis, AxisTable<T> table, const Run& run) const {
    for (int64_t t = 0; t < taps; ++t) {
      for (int m = run.begin; m < run.end; ++m) {
        SeenSide<T> side;
        const int places = see<false, Slopes::none>(axis, table, t, m, side);
        seen[t * kTile + m] = {side.read[0], {side.weight[0], side.weight[1]}};
        sides[t * kTile + m] = static_cast<int8_t>(places);
      }
    }
  }

  // differs[m] becomes true where pixels m and m + 1 do not see as many places of every tap.
  void compare(const Run& run, int8_t* differs) const {
    for (int64_t t = 0; t < taps; ++t) {
      const int8_t* count = sides + t * kTile;
      for (int m = run.begin; m + 1 < run.end; ++m) differs[m] |= count[m] ^ count[m + 1];
    }
  }
};

// What the walk over a tile's pixels needs beside the channels.
template <class T>
struct LaneScratch {
  SeenAxis<T> rows, columns;

  static int64_t need(const Conv& conv) {
    return SeenAxis<T>::need(conv.y) + SeenAxis<T>::need(conv.x);
  }
  void take(const Conv& conv, Workspace& memory) {
    rows.take(conv.y, memory);
    columns.take(conv.x, memory);
  }
};

constexpr bool kManyRegisters = SURFCONV_VECTOR_BYTES == 64;  // 32, not 16

// out[p] = initial + the contraction of PIXELS pixels from m on that see alike. Two at a time read
// each weight once: loads, not products, are what there is most of.
// In a function of its own: among its callers' variables g++ 12 keeps addresses in vector
// registers.
template <int PIXELS, class T, int64_t N>
__attribute__((noinline)) void lane_pixels(const LaneScratch<T>& scratch, int m, const char* base,
                                           int64_t step_y, int64_t step_x, Fixed<N>,
                                           const T* weight, int64_t weight_step, const T* initial,
                                           T* out, int64_t ld_out) {
  constexpr int L = widest_lanes<T>(Fixed<N>{}), VECTORS = N / L;
  using V = Vec<T, L>;
  const SeenAxis<T> rows = scratch.rows, columns = scratch.columns;
  V sum[PIXELS][VECTORS];
#pragma GCC unroll 2
  for (int p = 0; p < PIXELS; ++p) {
#pragma GCC unroll 6
    for (int i = 0; i < VECTORS; ++i) sum[p][i] = load<V>(initial + i * L);
  }
  for (int64_t ty = 0; ty < rows.taps; ++ty) {
    const SeenTap<T>* y = rows.seen + ty * kTile + m;
    const auto walk_row = [&](auto rows_of_tap) SURFCONV_INLINED {
      constexpr int ROWS = decltype(rows_of_tap)::value;
      const char* row[PIXELS];
      T weight_y[PIXELS][ROWS];
#pragma GCC unroll 2
      for (int p = 0; p < PIXELS; ++p) {
        row[p] = base + y[p].read;
#pragma GCC unroll 2
        for (int i = 0; i < ROWS; ++i) weight_y[p][i] = y[p].weight[i];
      }
      const SeenTap<T>* const end = columns.seen + columns.taps * kTile + m;
      const int8_t* sides = columns.sides + m;
#pragma GCC unroll 1
      for (const SeenTap<T>* x = columns.seen + m; x != end;
           x += kTile, sides += kTile, weight += weight_step) {
        const auto add = [&](auto columns_of_tap) SURFCONV_INLINED {
          constexpr int COLUMNS = decltype(columns_of_tap)::value, CORNERS = ROWS * COLUMNS;
          V of_tap[VECTORS];
#pragma GCC unroll 6
          for (int i = 0; i < VECTORS; ++i) {
            of_tap[i] = load<V>(weight + i * L);
            if constexpr (PIXELS > 1) keep_in_register(of_tap[i]);
          }
#pragma GCC unroll 2
          for (int p = 0; p < PIXELS; ++p) {
            const char* place = row[p] + x[p].read;
            const T* from[CORNERS];
            T share[CORNERS];
#pragma GCC unroll 4
            for (int q = 0; q < CORNERS; ++q) {
              const int i = q / COLUMNS, j = q % COLUMNS;
              from[q] = reinterpret_cast<const T*>(place + i * step_y + j * step_x);
              share[q] = weight_y[p][i] * x[p].weight[j];
            }
#pragma GCC unroll 6
            for (int i = 0; i < VECTORS; ++i) {
              V sample = load<V>(from[0] + i * L) * share[0];
#pragma GCC unroll 3
              for (int q = 1; q < CORNERS; ++q) sample += load<V>(from[q] + i * L) * share[q];
              sum[p][i] += sample * of_tap[i];
            }
          }
        };
        if (__builtin_expect(*sides == 2, 1)) {
          add(Two{});
        } else if (*sides == 1) {
          add(One{});
        }
      }
    };
    switch (rows.sides[ty * kTile + m]) {
      case 2:
        walk_row(Two{});
        break;
      case 1:
        walk_row(One{});
        break;
      default:
        weight += columns.taps * weight_step;
    }
  }
#pragma GCC unroll 2
  for (int p = 0; p < PIXELS; ++p) {
#pragma GCC unroll 6
    for (int i = 0; i < VECTORS; ++i) store(out + p * ld_out + i * L, sum[p][i]);
  }
}

// body(first lane, Fixed<lanes>): as many vectors at a time as leave registers to what they share;
// eight or nine, which six would leave too few of, by fours.
template <class T, class Body>
void for_fixed_lanes(int64_t lanes, const Body& body) {
  constexpr int64_t L = kLanes<T>;
  int64_t c = 0;
  for (; lanes - c >= 6 * L && (lanes - c) / (2 * L) != 4; c += 6 * L) body(c, Fixed<6 * L>{});
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

// Runs of the tile that lane_forward does, the others being the gathered matrix'.
template <class T>
bool lane_forward_does(const Tile<T>& tile, const Run& run) {
  return run.place != Place::other || !tile.guided();
}

template <class T>
void lane_forward(const Conv& conv, const Plan& plan, const Tile<T>& tile,
                  const LaneScratch<T>& scratch, const char* base, int64_t step_y, int64_t step_x,
                  const T* weights, const T* initial, T* out, int64_t ld_out) {
  constexpr int PIXELS = kManyRegisters ? 2 : 1;
  int8_t differs[kTile] = {};
  tile.for_runs([&](const Run& run) {
    if (!lane_forward_does(tile, run)) return;
    scratch.rows.fill(conv.y, tile.rows(), run);
    scratch.columns.fill(conv.x, tile.columns(), run);
    if constexpr (PIXELS > 1) {
      scratch.rows.compare(run, differs);
      scratch.columns.compare(run, differs);
    }
  });
  for_fixed_lanes<T>(plan.row, [&](int64_t c, auto lanes) {
    const char* from = base + c * static_cast<int64_t>(sizeof(T));
    tile.for_runs([&](const Run& run) {
      if (!lane_forward_does(tile, run)) return;
      for (int m = run.begin; m < run.end;) {
        const auto some = [&](auto pixels) {
          constexpr int count = decltype(pixels)::value;
          lane_pixels<count>(scratch, m, from, step_y, step_x, lanes, weights + c, plan.row,
                             initial + c, out + m * ld_out + c, ld_out);
          m += count;
        };
        if (PIXELS > 1 && m + 1 < run.end && differs[m] == 0) {
          some(std::integral_constant<int, PIXELS>{});
        } else {
          some(One{});
        }
      }
    });
  });
}
