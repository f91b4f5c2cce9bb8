// The corners of the taps of one tile of output pixels, and what each weighs: for pixels whose axes
// alone do not tell.

// The guide around a tile: what each corner's value is compared with.
template <class T>
struct GuideTile {
  const T* image = nullptr;  // the whole image's guide, pixel by pixel; null: no guide
  T tolerance = 0;
  T centre[kTile] = {};
  T exempt[kTile] = {};  // 1 where the centre's own value is not finite: all corners are visible
  int32_t all_seen[kTile] = {};  // 1 where every corner is known to be visible
};

// Corners of one tap: 1, 2 or 4 of them, [corner][kTile]. A corner of zero weight is never seen:
// its offsets point to a row of zeros and to a row that nobody reads.
template <class T>
struct TapCorners {
  int corners;
  bool kink;  // some corner of zero weight still counts for the derivative
  T* weight;
  int64_t* read;
  int64_t* write;
  T* slope;    // d(sample)/d(scale), or of scale_y where there are two components
  T* slope_x;  // of scale_x
};

// body(corners as a constant)
template <class Body>
SURFCONV_INLINE void with_corners(int corners, const Body& body) {
  switch (corners) {
    case 1:
      return body(std::integral_constant<int, 1>{});
    case 2:
      return body(std::integral_constant<int, 2>{});
    default:
      return body(std::integral_constant<int, 4>{});
  }
}

template <class T>
struct CornerTable {
  T* weight;
  T* slope;
  int64_t* read;
  int64_t* write;
  std::vector<TapCorners<T>> taps;

  static int64_t entries(int64_t taps) { return taps * 4 * kTile; }
  static int64_t need(int64_t taps) {
    return 3 * Workspace::need<T>(entries(taps)) + 2 * Workspace::need<int64_t>(entries(taps));
  }
  void take(int64_t count, Workspace& memory) {
    weight = memory.take<T>(entries(count));
    slope = memory.take<T>(2 * entries(count));
    read = memory.take<int64_t>(entries(count));
    write = memory.take<int64_t>(entries(count));
    taps.resize(static_cast<size_t>(count));
    for (int64_t t = 0; t < count; ++t) {
      taps[t] = {4,
                 false,
                 weight + t * 4 * kTile,
                 read + t * 4 * kTile,
                 write + t * 4 * kTile,
                 slope + t * 8 * kTile,
                 slope + t * 8 * kTile + 4 * kTile};
    }
  }
};

// ty, tx: the tap's place in the kernel; unseen_read, unseen_write: where unseen corners point.
template <class T, bool Guided, bool Writes, Slopes S>
void fill_corners(const Conv& conv, int64_t ty, int64_t tx, const AxisTable<T>& rows,
                  const AxisTable<T>& columns, const GuideTile<T>& guide, int64_t unseen_read,
                  int64_t unseen_write, TapCorners<T>& tap) {
  const int sides_y = conv.y.fixed(ty) ? 1 : 2, sides_x = conv.x.fixed(tx) ? 1 : 2;
  const T tap_y = static_cast<T>(conv.y.tap_doubled(ty)) / 2;
  const T tap_x = static_cast<T>(conv.x.tap_doubled(tx)) / 2;
  tap.corners = sides_y * sides_x;
  int kinks = 0;
  for (int i = 0; i < sides_y; ++i) {
    for (int j = 0; j < sides_x; ++j) {
      const int64_t at_y = (ty * 2 + i) * kTile, at_x = (tx * 2 + j) * kTile;
      const int64_t corner = (i * sides_x + j) * kTile;
      const T* __restrict weight_y = rows.weight + at_y;
      const T* __restrict weight_x = columns.weight + at_x;
      const T* __restrict inside_y = rows.inside + at_y;
      const T* __restrict inside_x = columns.inside + at_x;
      T* __restrict weight = tap.weight + corner;
      T visible[kTile];
      if constexpr (Guided) {
        const int64_t* __restrict pixel_y = rows.pixel + at_y;
        const int64_t* __restrict pixel_x = columns.pixel + at_x;
        int64_t pixel[kTile];
        for (int m = 0; m < kTile; ++m) {
          const bool in = (inside_y[m] != 0) & (inside_x[m] != 0);
          pixel[m] = in ? pixel_y[m] + pixel_x[m] : 0;
        }
        T value[kTile];
        for (int m = 0; m < kTile; ++m) value[m] = guide.image[pixel[m]];
        for (int m = 0; m < kTile; ++m) {
          const T distance = std::fabs(value[m] - guide.centre[m]);
          visible[m] = distance <= guide.tolerance ? T(1) : guide.exempt[m];
        }
      }
      for (int m = 0; m < kTile; ++m) {
        weight[m] = weight_y[m] * weight_x[m];
        if constexpr (Guided) weight[m] *= visible[m];
      }
      const int64_t* __restrict read_y = rows.read + at_y;
      const int64_t* __restrict read_x = columns.read + at_x;
      int64_t* __restrict read = tap.read + corner;
      if constexpr (S == Slopes::none) {
        for (int m = 0; m < kTile; ++m)
          read[m] = weight[m] != 0 ? read_y[m] + read_x[m] : unseen_read;
      } else {
        const T sign_y = sides_y == 1 ? T(0) : (i == 0 ? -tap_y : tap_y);
        const T sign_x = sides_x == 1 ? T(0) : (j == 0 ? -tap_x : tap_x);
        T* __restrict slope = tap.slope + corner;
        T* __restrict slope_x = tap.slope_x + corner;
        for (int m = 0; m < kTile; ++m) {
          T along_y = sign_y * inside_y[m] * weight_x[m];
          T along_x = sign_x * weight_y[m] * inside_x[m];
          if constexpr (Guided) {
            along_y *= visible[m];
            along_x *= visible[m];
          }
          slope[m] = S == Slopes::one ? along_y + along_x : along_y;
          if constexpr (S == Slopes::two) slope_x[m] = along_x;
          const bool sloping = (along_y != 0) | (along_x != 0);
          const bool seen = weight[m] != 0;
          kinks |= sloping & !seen;
          read[m] = sloping | seen ? read_y[m] + read_x[m] : unseen_read;
        }
      }
      if constexpr (Writes) {
        const int64_t* __restrict write_y = rows.write + at_y;
        int64_t* __restrict write = tap.write + corner;
        for (int m = 0; m < kTile; ++m) {
          write[m] = weight[m] != 0 ? write_y[m] + read_x[m] : unseen_write;
        }
      }
    }
  }
  tap.kink = kinks != 0;
}
