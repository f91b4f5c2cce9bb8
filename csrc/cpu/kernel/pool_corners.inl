// The corners that one output pixel's taps see: those of tap t are entries first[t] ..
// first[t + 1] - 1. What the guide hides counts as zero: it has no entry, but weighs in the total.
template <class T>
struct PoolCorners {
  const int64_t* offset;  // elements from the image's first pixel
  const T* weight;
  const T* slope;    // of the weight, by the scale, or with two of them by scale_y
  const T* slope_x;  // by scale_x, with two scales alone
  const int32_t* first;
  int64_t step;  // from entry to entry in the four arrays above
  int64_t count;
  int each;                                // corners of every tap, 0 where they differ
  T total;                                 // of the weights
  bool moves_total;                        // whether it changes with the scale
  const bool* hidden = nullptr;            // taps all of whose corners the guide hides
  T hidden_slope = 0, hidden_slope_x = 0;  // of the weights of all that it hides

  bool sees(int64_t t) const { return first[t] != first[t + 1]; }
  bool has_tap(int64_t t) const { return sees(t) || (hidden != nullptr && hidden[t]); }
};

// body(corners as a constant, tap, place of its first in the arrays) for the taps of which
// something is seen.
template <class T, class Body>
SURFCONV_INLINE void for_seen_taps(const PoolCorners<T>& corners, int64_t taps, const Body& body) {
  for (int64_t t = 0; t < taps; ++t) {
    const int64_t at = corners.first[t] * corners.step;
    switch (corners.first[t + 1] - corners.first[t]) {
      case 0:
        break;
      case 1:
        body(std::integral_constant<int, 1>{}, t, at);
        break;
      case 2:
        body(std::integral_constant<int, 2>{}, t, at);
        break;
      case 3:
        body(std::integral_constant<int, 3>{}, t, at);
        break;
      default:
        body(std::integral_constant<int, 4>{}, t, at);
    }
  }
}

// Memory of corners, [entry][pixel].
template <class T>
struct CornerMemory {
  int64_t* offset;
  T* weight;
  T* slope;
  T* slope_x;

  static int64_t need(int64_t entries) {
    return Workspace::need<int64_t>(entries) + 3 * Workspace::need<T>(entries);
  }
  void take(int64_t entries, Workspace& memory) {
    offset = memory.take<int64_t>(entries);
    weight = memory.take<T>(entries);
    slope = memory.take<T>(entries);
    slope_x = memory.take<T>(entries);
  }
};

// Which corners a tap has where all taps of a pixel are alike.
enum class Cell {
  whole,    // between pixels: all of them
  edges,    // on a pixel: that one and what the sample moves towards, inside the image
  on_pixel  // on a pixel: that one
};

// The corners of all of a tile's pixels at once, in one order for all of them.
template <class T>
class CornerPattern {
 public:
  static constexpr int64_t kMostEntries = 100;  // of a tile in the second-level cache

  static int64_t entries(const Pool& pool, Cell cell) {
    int64_t count = 0;
    for_entries(pool, cell, [&](int64_t, int64_t, int64_t) { ++count; });
    return count;
  }
  static int64_t need(const Pool& pool, Cell cell) {
    return CornerMemory<T>::need(entries(pool, cell) * kTile);
  }

  void take(const Pool& pool, Cell cell, Workspace& memory) {
    cell_ = cell;
    memory_.take(entries(pool, cell) * kTile, memory);
    first_.assign(static_cast<size_t>(pool.taps() + 1), 0);
    for_entries(pool, cell,
                [&](int64_t tap, int64_t, int64_t) { ++first_[static_cast<size_t>(tap + 1)]; });
    for (size_t t = 1; t < first_.size(); ++t) first_[t] += first_[t - 1];
    taps_ = pool.taps();
    each_ = cell == Cell::on_pixel ? 1 : (first_.back() == 4 * taps_ ? 4 : 0);
  }

  template <Slopes S>
  void fill(const Pool& pool, const PoolAxis<T>& rows, const PoolAxis<T>& columns) {
    int64_t* offset = memory_.offset;
    T *weight = memory_.weight, *slope = memory_.slope, *slope_x = memory_.slope_x;
    for_entries(pool, cell_, [&](int64_t, int64_t row, int64_t column) {
      const int64_t *y = rows.offset + row * kTile, *x = columns.offset + column * kTile;
      const T *weight_y = rows.weight + row * kTile, *weight_x = columns.weight + column * kTile;
      const T *by_y = rows.slope + row * kTile, *by_x = columns.slope + column * kTile;
      for (int m = 0; m < kTile; ++m) offset[m] = y[m] + x[m];
      for (int m = 0; m < kTile; ++m) weight[m] = weight_y[m] * weight_x[m];
      if constexpr (S != Slopes::none) {
        for (int m = 0; m < kTile; ++m) {
          const T along_y = by_y[m] * weight_x[m], along_x = weight_y[m] * by_x[m];
          slope[m] = S == Slopes::one ? along_y + along_x : along_y;
          if constexpr (S == Slopes::two) slope_x[m] = along_x;
        }
      }
      offset += kTile, weight += kTile, slope += kTile, slope_x += kTile;
    });
  }

  // Those of pixel m.
  PoolCorners<T> corners(int64_t m) const {
    return {memory_.offset + m,    memory_.weight + m,
            memory_.slope + m,     memory_.slope_x + m,
            first_.data(),         kTile,
            first_.back(),         each_,
            static_cast<T>(taps_), false};
  }

 private:
  // body(tap, entry of the rows' table, entry of the columns')
  template <class Body>
  static void for_entries(const Pool& pool, Cell cell, const Body& body) {
    for (int64_t ty = 0, t = 0; ty < pool.y.kernel; ++ty) {
      for (int64_t tx = 0; tx < pool.x.kernel; ++tx, ++t) {
        for (int64_t side = 0; side < 4; ++side) {
          const int64_t side_y = side / 2, side_x = side % 2;
          if ((pool.y.fixed(ty) && side_y == 1) || (pool.x.fixed(tx) && side_x == 1)) continue;
          const int away =
              away_from_centre(pool.y, ty, side_y) + away_from_centre(pool.x, tx, side_x);
          if (away > (cell == Cell::whole ? 2 : (cell == Cell::edges ? 1 : 0))) continue;
          body(t, ty * 2 + side_y, tx * 2 + side_x);
        }
      }
    }
  }
  // Whether that side has no weight where the tap lies on a pixel, see locate().
  static int away_from_centre(const Axis& axis, int64_t t, int64_t side) {
    return !axis.fixed(t) && side == (axis.tap_doubled(t) < 0 ? 0 : 1);
  }

  Cell cell_;
  CornerMemory<T> memory_;
  std::vector<int32_t> first_;
  int64_t taps_;
  int each_;
};
