// Everything about the samples of one worker's tile.
template <Edges E, Slopes S, class T>
class PoolSampler {
 public:
  static int64_t need(const Pool& pool) {
    int64_t patterns = 0;
    if (has_patterns(pool)) {
      patterns = CornerPattern<T>::need(pool, Cell::whole) + CornerPattern<T>::need(pool, kOnGrid);
    }
    return PoolAxis<T>::need(pool.y) + PoolAxis<T>::need(pool.x) +
           CornerMemory<T>::need(listed_entries(pool)) + Workspace::need<int32_t>(pool.taps() + 1) +
           Workspace::need<bool>(pool.taps()) + patterns;
  }

  // Steps of the image whose corners are listed, in elements.
  PoolSampler(const Pool& pool, int64_t step_y, int64_t step_x, Workspace& memory)
      : pool_(pool),
        step_y_(step_y),
        step_x_(step_x),
        has_patterns_(has_patterns(pool)),
        narrow_(has_narrow_reach(pool.y, pool.x)) {
    rows_.take(pool.y, memory);
    columns_.take(pool.x, memory);
    listed_.take(listed_entries(pool), memory);
    first_ = memory.take<int32_t>(pool.taps() + 1);
    hidden_ = memory.take<bool>(pool.taps());
    if (has_patterns_) {
      whole_.take(pool, Cell::whole, memory);
      on_grid_.take(pool, kOnGrid, memory);
    }
  }

  // Pixels first .. first+count-1 of output n; guide: image n's, or null.
  void start_tile(const View& scale, const T* guide, int64_t n, int64_t first, int64_t count) {
    T scale_y[kTile] = {}, scale_x[kTile] = {};
    load_pixels<T>(scale, n, 0, 1, pool_.x.out, first, count, scale_y, 1, 1);
    load_pixels<T>(scale, n, pool_.scale_components - 1, 1, pool_.x.out, first, count, scale_x, 1,
                   1);
    int64_t y = first / pool_.x.out, x = first % pool_.x.out;
    for (int64_t m = 0; m < count; ++m) {
      oy_[m] = y;
      ox_[m] = x;
      if (++x == pool_.x.out) ++y, x = 0;
    }
    std::fill_n(bounds_.between, kTile, T(1));
    std::fill_n(bounds_.on_grid, kTile, T(1));
    std::fill_n(bounds_.inside, kTile, T(1));
    if (sizeof(T) == 4 && narrow_) {
      fill_axes<std::conditional_t<sizeof(T) == 4, int32_t, int64_t>>(scale_y, scale_x, count);
    } else {
      fill_axes<int64_t>(scale_y, scale_x, count);
    }
    guide_ = guide;
    if (guide != nullptr) return;
    bool any_whole = false, any_on_grid = false;
    for (int64_t m = 0; m < count; ++m) {
      any_whole |= is_whole(m);
      any_on_grid |= is_on_grid(m);
    }
    if (any_whole) whole_.template fill<S>(pool_, rows_, columns_);
    if (any_on_grid) on_grid_.template fill<S>(pool_, rows_, columns_);
  }

  // Sets `corners` to those of pixel m of the tile.
  void list(int64_t m) {
    if (guide_ == nullptr) {
      if (is_whole(m)) {
        corners = whole_.corners(m);
      } else if (is_on_grid(m)) {
        corners = on_grid_.corners(m);
      } else {
        list_seen<false>(m);
      }
      return;
    }
    const T centre =
        guide_[pool_.y.centre_pixel(oy_[m]) * pool_.x.in + pool_.x.centre_pixel(ox_[m])];
    if (!(std::fabs(centre) <= std::numeric_limits<T>::max())) return list_seen<false>(m);
    centre_ = centre;
    list_seen<true>(m);
  }

  // Fetches what pixels to come will meet of the image whose corners are listed, where it starts.
  void fetch_ahead(int64_t m, const T* image, int64_t channels) const {
    constexpr int64_t bytes = sizeof(T);
    const int64_t row = rows_.offset[(pool_.y.kernel * 2 - 1) * kTile + m];
    const int64_t column = columns_.offset[pool_.x.kernel / 2 * 2 * kTile + m];
    const ImagePart part{reinterpret_cast<const char*>(image), step_y_ * bytes, step_x_ * bytes,
                         channels * bytes};
    FetchAhead(pool_.y, pool_.x, part)((row + column) * bytes);
  }

  // An average's divisor at pixel m, whose corners are listed.
  T divisor(int64_t m) const {
    if (pool_.divisor_override != 0) return static_cast<T>(pool_.divisor_override);
    if (!pool_.count_include_pad) return corners.total;
    return static_cast<T>(pool_.y.pool_window(oy_[m]) * pool_.x.pool_window(ox_[m]));
  }

  PoolCorners<T> corners{};

 private:
  static constexpr bool kSloped = S != Slopes::none;
  static constexpr Cell kOnGrid = kSloped ? Cell::edges : Cell::on_pixel;

  static bool has_patterns(const Pool& pool) {
    return listed_entries(pool) <= CornerPattern<T>::kMostEntries;
  }
  static int64_t listed_entries(const Pool& pool) { return pool.taps() * 4; }

  bool is_whole(int64_t m) const { return has_patterns_ & (bounds_.between[m] > 0); }
  bool is_on_grid(int64_t m) const {
    return has_patterns_ & (bounds_.on_grid[m] == 1) & (!kSloped | (bounds_.inside[m] == 1));
  }

  template <class Int>
  void fill_axes(const T* scale_y, const T* scale_x, int64_t count) {
    Int row[kTile] = {}, column[kTile] = {};
    for (int64_t m = 0; m < count; ++m) {
      row[m] = static_cast<Int>(pool_.y.centre_floor(oy_[m]));
      column[m] = static_cast<Int>(pool_.x.centre_floor(ox_[m]));
    }
    fill_pool_axis<E>(pool_.y, step_y_, scale_y, row, rows_, bounds_);
    fill_pool_axis<E>(pool_.x, step_x_, scale_x, column, columns_, bounds_);
  }

  template <bool Guided>
  void list_seen(int64_t m) {
    const CornerMemory<T>& to = listed_;
    int32_t n = 0;
    int64_t t = 0;
    T total = 0, hidden_slope = 0, hidden_slope_x = 0;
    int least = 4, most = 0;
    const T tolerance = static_cast<T>(pool_.guide_tolerance);
    for (int64_t ty = 0; ty < pool_.y.kernel; ++ty) {
      for (int64_t tx = 0; tx < pool_.x.kernel; ++tx, ++t) {
        const int32_t begin = first_[t] = n;
        bool hides = false;
        for (int side = 0; side < 4; ++side) {
          const int64_t at_y = (ty * 2 + side / 2) * kTile + m;
          const int64_t at_x = (tx * 2 + side % 2) * kTile + m;
          const T weight = rows_.weight[at_y] * columns_.weight[at_x];
          to.offset[n] = rows_.offset[at_y] + columns_.offset[at_x];
          to.weight[n] = weight;
          bool kept = weight != 0;
          if constexpr (kSloped) {
            const T along_y = rows_.slope[at_y] * columns_.weight[at_x];
            const T along_x = rows_.weight[at_y] * columns_.slope[at_x];
            to.slope[n] = S == Slopes::one ? along_y + along_x : along_y;
            to.slope_x[n] = along_x;
            kept |= (along_y != 0) | (along_x != 0);
          }
          total += weight;
          if constexpr (Guided) {
            const T value = guide_[rows_.pixel[at_y] * pool_.x.in + columns_.pixel[at_x]];
            if (kept && !(std::fabs(value - centre_) <= tolerance)) {
              kept = false;
              hides |= weight != 0;
              if constexpr (kSloped) hidden_slope += to.slope[n], hidden_slope_x += to.slope_x[n];
            }
          }
          n += kept;
        }
        if constexpr (Guided) hidden_[t] = hides && n == begin;
        least = std::min(least, n - begin);
        most = std::max(most, n - begin);
      }
    }
    first_[t] = n;
    const int each = least == most ? least : 0;
    corners = {to.offset,
               to.weight,
               to.slope,
               to.slope_x,
               first_,
               1,
               n,
               each,
               total,
               true,
               Guided ? hidden_ : nullptr,
               hidden_slope,
               hidden_slope_x};
  }

  const Pool& pool_;
  int64_t step_y_, step_x_;
  const bool has_patterns_, narrow_;
  PoolAxis<T> rows_, columns_;
  PoolBounds<T> bounds_;
  CornerPattern<T> whole_, on_grid_;
  CornerMemory<T> listed_;
  int32_t* first_;
  bool* hidden_;
  const T* guide_ = nullptr;
  T centre_ = 0;
  int64_t oy_[kTile], ox_[kTile];
};
