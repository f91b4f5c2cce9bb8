// Where the taps of a pool's output pixels fall: tables of a tile of pixels for each axis, and from
// them the corners of one pixel's taps.
enum class Edges { zero, clamp };  // what samples outside the image are: an average's, a maximum's

// Per axis, tap and side (pixel `lo`, then `lo + 1`), one entry for each pixel of the tile.
template <class T>
struct PoolAxis {
  T* weight;
  T* slope;        // of the weight, by the scale; also where the weight is 0 on a pixel
  int64_t* pixel;  // inside the image, whatever the weight

  static int64_t entries(const Axis& axis) { return axis.kernel * 2 * kTile; }
  static int64_t need(const Axis& axis) {
    return 2 * Workspace::need<T>(entries(axis)) + Workspace::need<int64_t>(entries(axis));
  }
  void take(const Axis& axis, Workspace& memory) {
    weight = memory.take<T>(entries(axis));
    slope = memory.take<T>(entries(axis));
    pixel = memory.take<int64_t>(entries(axis));
  }
};

template <class T>
struct PoolPositions {
  int64_t lo[kTile];
  T fraction[kTile];
  int64_t reachable[kTile];
};

template <bool Descending, class T>
void locate_pool(T half, T tap, const T* scale, const int64_t* centre, PoolPositions<T>& to) {
  constexpr int lanes = 4;
  using Real = Vec<T, lanes>;
  using Integer = Vec<int64_t, lanes>;
  const T limit = static_cast<T>(int64_t{1} << 61);
  for (int m = 0; m < kTile; m += lanes) {
    const auto position =
        locate<Descending>(load<Integer>(centre + m), half, tap, load<Real>(scale + m), limit);
    store(to.lo + m, position.lo);
    store(to.fraction + m, position.fraction);
    store(to.reachable + m, position.reachable);
  }
}

template <Edges E, class T>
void fill_pool_axis(const Axis& axis, const T* __restrict scale, const int64_t* __restrict centre,
                    const PoolAxis<T>& table) {
  const T half = axis.centre_is_half() ? T(0.5) : T(0);
  const int64_t last = axis.in - 1;
  PoolPositions<T> at;
  for (int64_t t = 0; t < axis.kernel; ++t) {
    T* __restrict weight = table.weight + t * 2 * kTile;
    T* __restrict slope = table.slope + t * 2 * kTile;
    int64_t* __restrict pixel = table.pixel + t * 2 * kTile;
    const T tap = static_cast<T>(axis.tap_doubled(t)) / 2;
    if (axis.fixed(t)) {
      for (int m = 0; m < kTile; ++m) {
        const bool in = (centre[m] >= 0) & (centre[m] <= last);
        const bool seen = in | (E == Edges::clamp && scale[m] != 1);
        pixel[m] = pixel[kTile + m] = std::min(std::max<int64_t>(centre[m], 0), last);
        weight[m] = seen ? T(1) : T(0);
        weight[kTile + m] = slope[m] = slope[kTile + m] = 0;
      }
      continue;
    }
    if (tap < 0) {
      locate_pool<true>(half, tap, scale, centre, at);
    } else {
      locate_pool<false>(half, tap, scale, centre, at);
    }
    for (int m = 0; m < kTile; ++m) {
      const bool near = at.reachable[m] != 0;
      const int64_t lo = at.lo[m];
      // In steps of what 1 - fraction can tell: a quotient of weights keeps its precision where
      // the guide leaves nothing but a corner that is all but at its end.
      T fraction = 1 - (1 - at.fraction[m]);
      bool in_lo, in_hi;
      if constexpr (E == Edges::zero) {
        in_lo = near & (lo >= 0) & (lo <= last);
        in_hi = near & (lo >= -1) & (lo < last);
        pixel[m] = in_lo ? lo : 0;
        pixel[kTile + m] = in_hi ? lo + 1 : 0;
        weight[m] = in_lo ? 1 - fraction : T(0);
        weight[kTile + m] = in_hi ? fraction : T(0);
      } else {
        const bool finite = std::fabs(scale[m]) <= std::numeric_limits<T>::max();
        const bool before = near ? lo < 0 : scale[m] * tap < 0;
        const bool behind = near ? lo >= last : !before;
        // As in nn, where a clamped tap could fall between the pixels of a dilated kernel.
        const int64_t exact = lo + (fraction == 1);
        const bool left_out = (!finite) | ((scale[m] == 1) & ((exact < 0) | (exact > last)));
        fraction = before | behind ? T(0) : fraction;
        in_lo = in_hi = !(before | behind | left_out);
        pixel[m] = before ? 0 : (behind ? last : lo);
        pixel[kTile + m] = in_hi ? lo + 1 : pixel[m];
        weight[m] = left_out ? T(0) : 1 - fraction;
        weight[kTile + m] = left_out ? T(0) : fraction;
      }
      slope[m] = in_lo ? -tap : T(0);
      slope[kTile + m] = in_hi ? tap : T(0);
    }
  }
}

// The corners of one output pixel's taps, those of tap t from first[t] to first[t + 1].
template <class T>
struct PoolCorners {
  int64_t* offset;  // elements from the image's first pixel
  T* weight;
  T* slope_y;  // of the weight, by scale_y
  T* slope_x;
  int32_t* first;
  int64_t count;
  int each;  // corners of every tap, 0 where they differ
  T total;   // of the weights

  // One tap more than there are, for winners that name none, and four more entries behind it.
  static int64_t entries(int64_t taps) { return (taps + 2) * 4; }
  static int64_t need(int64_t taps) {
    return Workspace::need<int64_t>(entries(taps)) + 3 * Workspace::need<T>(entries(taps)) +
           Workspace::need<int32_t>(taps + 2);
  }
  void take(int64_t taps, Workspace& memory) {
    offset = memory.take<int64_t>(entries(taps));
    weight = memory.take<T>(entries(taps));
    slope_y = memory.take<T>(entries(taps));
    slope_x = memory.take<T>(entries(taps));
    first = memory.take<int32_t>(taps + 2);
  }
};

// Everything about the samples of one worker's tile.
template <Edges E, class T>
class PoolSampler {
 public:
  static int64_t need(const Pool& pool) {
    return PoolAxis<T>::need(pool.y) + PoolAxis<T>::need(pool.x) +
           PoolCorners<T>::need(pool.taps());
  }

  // Steps of the image whose corners are listed, in elements.
  PoolSampler(const Pool& pool, int64_t step_y, int64_t step_x, Workspace& memory)
      : pool_(pool), step_y_(step_y), step_x_(step_x) {
    rows_.take(pool.y, memory);
    columns_.take(pool.x, memory);
    corners.take(pool.taps(), memory);
  }

  // Pixels first .. first+count-1 of output n; guide: image n's, or null.
  void start_tile(const View& scale, const T* guide, int64_t n, int64_t first, int64_t count) {
    T scale_y[kTile] = {}, scale_x[kTile] = {};
    load_pixels<T>(scale, n, 0, 1, pool_.x.out, first, count, scale_y, 1, 1);
    load_pixels<T>(scale, n, pool_.scale_components - 1, 1, pool_.x.out, first, count, scale_x, 1,
                   1);
    int64_t row[kTile] = {}, column[kTile] = {};
    for (int64_t m = 0; m < count; ++m) {
      oy_[m] = (first + m) / pool_.x.out;
      ox_[m] = (first + m) % pool_.x.out;
      row[m] = pool_.y.centre_floor(oy_[m]);
      column[m] = pool_.x.centre_floor(ox_[m]);
    }
    fill_pool_axis<E>(pool_.y, scale_y, row, rows_);
    fill_pool_axis<E>(pool_.x, scale_x, column, columns_);
    guide_ = guide;
  }

  // Fills `corners` for pixel m of the tile.
  template <bool Sloped>
  void list(int64_t m) {
    if (guide_ == nullptr) return list_seen<false, Sloped>(m);
    const T centre =
        guide_[pool_.y.centre_pixel(oy_[m]) * pool_.x.in + pool_.x.centre_pixel(ox_[m])];
    if (!(std::fabs(centre) <= std::numeric_limits<T>::max())) return list_seen<false, Sloped>(m);
    centre_ = centre;
    list_seen<true, Sloped>(m);
    // A maximum that sees nothing through its guide goes without.
    if (E == Edges::clamp && corners.total == 0) list_seen<false, Sloped>(m);
  }

  // An average's divisor at pixel m, whose corners are listed.
  T divisor(int64_t m) const {
    if (pool_.divisor_override != 0) return static_cast<T>(pool_.divisor_override);
    if (!pool_.count_include_pad) return corners.total;
    return static_cast<T>(pool_.y.pool_window(oy_[m]) * pool_.x.pool_window(ox_[m]));
  }

  PoolCorners<T> corners;

 private:
  template <bool Guided, bool Sloped>
  void list_seen(int64_t m) {
    PoolCorners<T>& to = corners;
    int32_t n = 0;
    int64_t t = 0;
    T total = 0;
    int least = 4, most = 0;
    const T tolerance = static_cast<T>(pool_.guide_tolerance);
    for (int64_t ty = 0; ty < pool_.y.kernel; ++ty) {
      for (int64_t tx = 0; tx < pool_.x.kernel; ++tx, ++t) {
        const int32_t begin = to.first[t] = n;
        bool hidden = false;
        for (int side = 0; side < 4; ++side) {
          const int64_t at_y = (ty * 2 + side / 2) * kTile + m;
          const int64_t at_x = (tx * 2 + side % 2) * kTile + m;
          const T weight = rows_.weight[at_y] * columns_.weight[at_x];
          const int64_t row = rows_.pixel[at_y], column = columns_.pixel[at_x];
          to.offset[n] = row * step_y_ + column * step_x_;
          to.weight[n] = weight;
          bool kept = weight != 0;
          if constexpr (Sloped) {
            to.slope_y[n] = rows_.slope[at_y] * columns_.weight[at_x];
            to.slope_x[n] = rows_.weight[at_y] * columns_.slope[at_x];
            kept |= (to.slope_y[n] != 0) | (to.slope_x[n] != 0);
          }
          if constexpr (Guided) {
            const bool seen =
                !kept || std::fabs(guide_[row * pool_.x.in + column] - centre_) <= tolerance;
            hidden |= !seen & (weight != 0);
            kept &= seen;
          }
          total += kept ? weight : T(0);
          n += kept;
        }
        if constexpr (Guided && E == Edges::clamp) {
          if (hidden) even_out<Sloped>(begin, n);
        }
        least = std::min(least, n - begin);
        most = std::max(most, n - begin);
      }
    }
    to.first[t] = to.first[t + 1] = to.count = n;
    to.each = least == most ? least : 0;
    to.total = total;
    for (int side = 0; side < 4; ++side) {
      to.offset[n + side] = 0;
      to.weight[n + side] = 0;
    }
  }

  // Weights that add up to 1, and the slopes of their quotients.
  template <bool Sloped>
  void even_out(int32_t begin, int32_t end) {
    PoolCorners<T>& to = corners;
    T weight = 0, slope_y = 0, slope_x = 0;
    for (int32_t q = begin; q < end; ++q) {
      weight += to.weight[q];
      if constexpr (Sloped) slope_y += to.slope_y[q], slope_x += to.slope_x[q];
    }
    if (weight == 0) return;
    for (int32_t q = begin; q < end; ++q) {
      to.weight[q] /= weight;
      if constexpr (Sloped) {
        to.slope_y[q] = (to.slope_y[q] - to.weight[q] * slope_y) / weight;
        to.slope_x[q] = (to.slope_x[q] - to.weight[q] * slope_x) / weight;
      }
    }
  }

  const Pool& pool_;
  int64_t step_y_, step_x_;
  PoolAxis<T> rows_, columns_;
  const T* guide_ = nullptr;
  T centre_ = 0;
  int64_t oy_[kTile], ox_[kTile];
};
