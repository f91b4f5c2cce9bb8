// Successive pixels of a tile. Interior: every tap falls strictly between pixels of the image and
// there is no guide, so that corners need no checks and their weights are products of the axes'.
struct Run {
  int begin, end;
  bool interior;
};

// One worker's view of the tile it is at: the geometry of up to kTile flat output pixels.
template <class T>
class Tile {
 public:
  static int64_t need(const Conv& conv, int64_t taps) {
    return AxisTable<T>::need(conv.y) + AxisTable<T>::need(conv.x) + CornerTable<T>::need(taps);
  }
  Tile(const Conv& conv, int64_t taps, Workspace& memory)
      : conv_(conv), narrow_(std::max(conv.y.reach(), conv.x.reach()) < (int64_t{1} << 28)) {
    rows_.take(conv.y, memory);
    columns_.take(conv.x, memory);
    corners_.take(taps, memory);
  }

  const TapCorners<T>& tap(int64_t index) const {
    return corners_.taps[static_cast<size_t>(index)];
  }

  const AxisTable<T>& rows() const { return rows_; }
  const AxisTable<T>& columns() const { return columns_; }

  template <class Body>
  SURFCONV_INLINE void for_runs(const Body& body) const {
    for (int i = 0; i < run_count_; ++i) body(runs_[i]);
  }
  bool interior() const { return run_count_ == 1 && runs_[0].interior; }

  // Flat output pixels first .. first+count-1 of image n.
  void place(const View& scale, const T* guide, int64_t n, int64_t first, int count,
             AxisSteps steps_y, AxisSteps steps_x) {
    if (guide == nullptr) steps_y.pixel = steps_x.pixel = 0;
    T scale_y[kTile] = {}, scale_x_own[kTile] = {};
    load_pixels<T>(scale, n, 0, 1, conv_.x.out, first, count, scale_y, 1, 1);
    const T* scale_x = scale_y;
    if (conv_.scale_components == 2) {
      load_pixels<T>(scale, n, 1, 1, conv_.x.out, first, count, scale_x_own, 1, 1);
      scale_x = scale_x_own;
    }
    guide_.image = guide;
    guide_.tolerance = static_cast<T>(conv_.guide_tolerance);
    if (guide != nullptr) read_guide(guide, first, count);
    T lowest[kTile];
    std::fill_n(lowest, kTile, T(1));
    const auto fill = [&](auto index) {
      using Int = decltype(index);
      Int centre_y[kTile], centre_x[kTile];
      find_centres(first, count, centre_y, centre_x);
      fill_axis<T, Int>(conv_.y, steps_y, scale_y, centre_y, rows_, lowest);
      fill_axis<T, Int>(conv_.x, steps_x, scale_x, centre_x, columns_, lowest);
    };
    if (sizeof(T) == 4 && narrow_) {
      fill(std::conditional_t<sizeof(T) == 4, int32_t, int64_t>{});
    } else {
      fill(int64_t{});
    }
    find_runs(lowest, count, guide == nullptr && has_whole_rows(conv_));
  }

  template <bool Writes, Slopes S>
  void fill_taps(int64_t first_tap, int64_t taps, int64_t unseen_read, int64_t unseen_write) {
    for (int64_t t = 0; t < taps; ++t) {
      const int64_t ty = (first_tap + t) / conv_.x.kernel, tx = (first_tap + t) % conv_.x.kernel;
      TapCorners<T>& corners = corners_.taps[static_cast<size_t>(t)];
      if (guide_.image != nullptr) {
        fill_corners<T, true, Writes, S>(conv_, ty, tx, rows_, columns_, guide_, unseen_read,
                                         unseen_write, corners);
      } else {
        fill_corners<T, false, Writes, S>(conv_, ty, tx, rows_, columns_, guide_, unseen_read,
                                          unseen_write, corners);
      }
    }
  }

 private:
  // body(pixels already done, pixels of the run, output row, first output column)
  template <class Body>
  SURFCONV_INLINE void for_rows(int64_t first, int count, const Body& body) const {
    int64_t y = first / conv_.x.out, x = first % conv_.x.out;
    for (int done = 0; done < count; ++y, x = 0) {
      const int run = static_cast<int>(std::min<int64_t>(count - done, conv_.x.out - x));
      body(done, run, y, x);
      done += run;
    }
  }

  template <class Int>
  void find_centres(int64_t first, int count, Int* centre_y, Int* centre_x) const {
    for_rows(first, count, [&](int done, int run, int64_t y, int64_t x) {
      const Int row = static_cast<Int>(conv_.y.centre_floor(y));
      const Int column = static_cast<Int>(conv_.x.centre_floor(x));
      const Int step = static_cast<Int>(conv_.x.centre_floor(x + 1)) - column;
      Int* __restrict to_y = centre_y + done;
      Int* __restrict to_x = centre_x + done;
      for (int m = 0; m < run; ++m) {
        to_y[m] = row;
        to_x[m] = column + static_cast<Int>(m) * step;
      }
    });
    std::fill(centre_y + count, centre_y + kTile, Int(0));
    std::fill(centre_x + count, centre_x + kTile, Int(0));
  }

  void read_guide(const T* guide, int64_t first, int count) {
    for_rows(first, count, [&](int done, int run, int64_t y, int64_t x) {
      const T* row = guide + conv_.y.centre_pixel(y) * conv_.x.in;
      for (int m = 0; m < run; ++m) {
        const T value = row[conv_.x.centre_pixel(x + m)];
        guide_.centre[done + m] = value;
        guide_.exempt[done + m] = value - value == 0 ? T(0) : T(1);
      }
    });
  }

  void find_runs(const T* lowest, int count, bool possible) {
    int interior = 0;
    for (int m = 0; m < kTile; ++m) interior += lowest[m] > 0;
    if (!possible || interior == 0 || interior == kTile) {
      runs_[0] = {0, count, possible && interior != 0};
      run_count_ = 1;
      return;
    }
    run_count_ = 0;
    for (int m = 0; m < count; ++m) {
      const bool inside = lowest[m] > 0;
      if (run_count_ == 0 || runs_[run_count_ - 1].interior != inside) {
        runs_[run_count_++] = {m, m, inside};
      }
      runs_[run_count_ - 1].end = m + 1;
    }
  }

  const Conv& conv_;
  const bool narrow_;
  Run runs_[kTile];
  int run_count_ = 0;
  AxisTable<T> rows_, columns_;
  CornerTable<T> corners_;
  GuideTile<T> guide_;
};
