// Successive pixels of a tile that are alike.
enum class Place : int8_t {
  interior,  // every tap strictly between pixels of the image: weights are products of the axes'
  on_grid,   // every tap on a pixel of the image, as at scale 1: one corner
  other      // needs its corners listed: at the border, or not all of them are visible
};
struct Run {
  int begin, end;
  Place place;
};

// Successive pixels of a tile, whole blocks of a product, that see something of the same taps.
struct SeenTaps {
  Range pixels;  // may end beyond the tile's
  Range taps;    // whole rows of the kernel
};

// One worker's view of the tile it is at: the geometry of up to kTile flat output pixels.
template <class T>
class Tile {
 public:
  static int64_t need(const Conv& conv, int64_t taps) {
    return AxisTable<T>::need(conv.y) + AxisTable<T>::need(conv.x) + CornerTable<T>::need(taps);
  }
  Tile(const Conv& conv, int64_t taps, Workspace& memory)
      : conv_(conv), narrow_(has_narrow_reach(conv.y, conv.x)) {
    rows_.take(conv.y, memory);
    columns_.take(conv.x, memory);
    corners_.take(taps, memory);
  }

  const TapCorners<T>& tap(int64_t index) const {
    return corners_.taps[static_cast<size_t>(index)];
  }

  const AxisTable<T>& rows() const { return rows_; }
  const AxisTable<T>& columns() const { return columns_; }

  bool guided() const { return guide_.image != nullptr; }

  // Whether some pixels are walked by their listed corners: a guide hides corners one by one.
  bool needs_list() const { return has(Place::other) && (guided() || !has_whole_rows(conv_)); }

  template <class Body>
  SURFCONV_INLINE void for_runs(const Body& body) const {
    for (int i = 0; i < run_count_; ++i) body(runs_[i]);
  }
  bool has(Place place) const {
    for (int i = 0; i < run_count_; ++i) {
      if (runs_[i].place == place) return true;
    }
    return false;
  }

  // Flat output pixels first .. first+count-1 of image n. Derivatives need to know what is inside
  // the image, as the guide does.
  void place(const View& scale, const GuideImage<T>& guide, int64_t n, int64_t first, int count,
             AxisSteps steps_y, AxisSteps steps_x, bool derivatives) {
    if (guide.value == nullptr) steps_y.pixel = steps_x.pixel = 0;
    T scale_y[kTile], scale_x_own[kTile];
    const auto load_scale = [&](int64_t component, T* to) {
      load_pixels<T>(scale, n, component, 1, conv_.x.out, first, count, to, 1, 1);
      std::fill(to + count, to + kTile, T(0));
    };
    load_scale(0, scale_y);
    const T* scale_x = scale_y;
    if (conv_.scale_components == 2) {
      load_scale(1, scale_x_own);
      scale_x = scale_x_own;
    }
    guide_.image = guide.value;
    guide_.tolerance = static_cast<T>(conv_.guide_tolerance);
    if (guide.value != nullptr) read_guide(guide, scale_y, scale_x, first, count);
    WeightBounds<T> bounds;
    std::fill_n(bounds.lowest, kTile, T(1));
    std::fill_n(bounds.nearest, kTile, T(1));
    const auto fill = [&](auto index) {
      using Int = decltype(index);
      Int centre_y[kTile], centre_x[kTile];
      find_centres(first, count, centre_y, centre_x);
      const auto fill_axes = [&](auto presence) {
        constexpr bool Presence = decltype(presence)::value;
        fill_axis<Presence>(conv_.y, steps_y, scale_y, centre_y, rows_, bounds);
        fill_axis<Presence>(conv_.x, steps_x, scale_x, centre_x, columns_, bounds);
      };
      derivatives || guide.value != nullptr ? fill_axes(std::true_type{})
                                            : fill_axes(std::false_type{});
    };
    if (sizeof(T) == 4 && narrow_) {
      fill(std::conditional_t<sizeof(T) == 4, int32_t, int64_t>{});
    } else {
      fill(int64_t{});
    }
    find_runs(bounds, count);
  }

  // What for_seen goes by, of the tile's `count` pixels. Of listed corners nothing is left out.
  void find_seen(int count, bool derivatives) {
    const T* present = derivatives ? rows_.inside : rows_.weight;
    const int64_t padded = round_up(count, kRowPad);
    seen_[0] = {{0, padded}, {0, conv_.y.kernel * conv_.x.kernel}};
    seen_count_ = 1;
    if (!has(Place::other) || needs_list() || see_rows_between(present)) return;
    seen_count_ = 0;
    for (int64_t begin = 0; begin < padded; begin += kRowPad) {
      const int64_t end = begin + kRowPad, behind = std::min<int64_t>(end, count);
      Range rows{0, 0};
      for (int64_t t = 0; t < conv_.y.kernel; ++t) {
        const T* lower = present + 2 * t * kTile;
        const T* upper = conv_.y.fixed(t) ? lower : lower + kTile;
        bool some = false;
        for (int64_t m = begin; m < behind; ++m) some |= (lower[m] != 0) | (upper[m] != 0);
        if (some) rows = {rows.count() == 0 ? t : rows.begin, t + 1};
      }
      const Range taps{rows.begin * conv_.x.kernel, rows.end * conv_.x.kernel};
      SeenTaps* last = seen_count_ == 0 ? nullptr : &seen_[seen_count_ - 1];
      if (last != nullptr && last->taps.begin == taps.begin && last->taps.end == taps.end) {
        last->pixels.end = end;
      } else {
        seen_[seen_count_++] = {{begin, end}, taps};
      }
    }
  }

  // body(pixels, those of the `taps` from first_tap on of which they see something, counted from
  // it). The others bring zeros, which a product need not meet.
  template <class Body>
  SURFCONV_INLINE void for_seen(int64_t first_tap, int64_t taps, const Body& body) const {
    for (int i = 0; i < seen_count_; ++i) {
      const Range seen = seen_[i].taps;
      const int64_t begin = std::clamp(seen.begin - first_tap, int64_t{0}, taps);
      body(seen_[i].pixels, Range{begin, std::clamp(seen.end - first_tap, begin, taps)});
    }
  }

  bool sees_all() const {
    return seen_count_ == 1 && seen_[0].taps.count() == conv_.y.kernel * conv_.x.kernel;
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

  void read_guide(const GuideImage<T>& guide, const T* scale_y, const T* scale_x, int64_t first,
                  int count) {
    int32_t open[kTile] = {};
    for_rows(first, count, [&](int done, int run, int64_t y, int64_t x) {
      const int64_t row = conv_.y.centre_pixel(y) * conv_.x.in;
      for (int m = 0; m < run; ++m) {
        const int64_t pixel = row + conv_.x.centre_pixel(x + m);
        const T value = guide.value[pixel];
        guide_.centre[done + m] = value;
        guide_.exempt[done + m] = value - value == 0 ? T(0) : T(1);
        if (guide.open != nullptr) open[done + m] = guide.open[pixel];
      }
    });
    // With some to spare for what rounding makes of a position.
    const T spare = T(1) + T(1e-5), outermost = static_cast<T>(outermost_tap(conv_));
    const T tap_y = static_cast<T>(std::abs(conv_.y.tap_doubled(0))) / 2 * spare;
    const T tap_x = static_cast<T>(std::abs(conv_.x.tap_doubled(0))) / 2 * spare;
    const T half_y = conv_.y.centre_is_half() ? T(0.5) : T(0);
    const T half_x = conv_.x.centre_is_half() ? T(0.5) : T(0);
    for (int m = 0; m < kTile; ++m) {
      const T reach_y = std::fabs(scale_y[m]) * tap_y + half_y;
      const T reach_x = std::fabs(scale_x[m]) * tap_x + half_x;
      int32_t beyond = 0;
      for (int i = 0; i < kReaches; ++i) {
        const T limit = outermost * static_cast<T>(1 << i);
        beyond += (reach_y >= limit) | (reach_x >= limit);
      }
      guide_.all_seen[m] = (guide_.exempt[m] != 0) | (open[m] > beyond);
    }
  }

  void find_runs(const WeightBounds<T>& bounds, int count) {
    static_assert(kTile < 64, "a bit for each pixel and the end");
    const bool possible = has_whole_rows(conv_), guided = guide_.image != nullptr;
    const auto unseen = [&](int m) { return guided ? guide_.all_seen[m] == 0 : false; };
    if (possible) {
      int inside = 0;
      for (int m = 0; m < kTile; ++m) inside += (bounds.lowest[m] > 0) & !unseen(m);
      if (inside == kTile) {
        runs_[0] = {0, count, Place::interior};
        run_count_ = 1;
        return;
      }
    }
    int32_t place[kTile];
    for (int m = 0; m < kTile; ++m) {
      const int32_t apart = bounds.lowest[m] <= 0, off_grid = bounds.nearest[m] < 1;
      place[m] = (apart + (apart & off_grid)) | (static_cast<int32_t>(unseen(m)) << 1);
    }
    uint64_t changes = uint64_t{1} << count;
    for (int m = 1; m < count; ++m) changes |= static_cast<uint64_t>(place[m] != place[m - 1]) << m;
    run_count_ = 0;
    for (int begin = 0; begin < count;) {
      const int end = __builtin_ctzll(changes);
      const int32_t kind = possible ? std::min(place[begin], 2) : 2;
      runs_[run_count_++] = {begin, end, static_cast<Place>(kind)};
      changes &= changes - 1;
      begin = end;
    }
  }

  // Whether all pixels see something of the outermost rows of taps, and so of those between.
  bool see_rows_between(const T* present) const {
    const T* first = present;
    const T* last = present + 2 * (conv_.y.kernel - 1) * kTile;
    const int64_t upper = conv_.y.fixed(0) ? 0 : kTile;
    int unseen = 0;
    for (int m = 0; m < kTile; ++m) {
      unseen |=
          ((first[m] == 0) & (first[m + upper] == 0)) | ((last[m] == 0) & (last[m + upper] == 0));
    }
    return unseen == 0;
  }

  const Conv& conv_;
  const bool narrow_;
  Run runs_[kTile];
  int run_count_ = 0;
  SeenTaps seen_[kTile / kRowPad];
  int seen_count_ = 0;
  AxisTable<T> rows_, columns_;
  CornerTable<T> corners_;
  GuideTile<T> guide_;
};
