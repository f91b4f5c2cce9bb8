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
    int64_t centre_y[kTile] = {}, centre_x[kTile] = {};
    guide_.image = guide;
    guide_.tolerance = static_cast<T>(conv_.guide_tolerance);
    int64_t y = first / conv_.x.out, x = first % conv_.x.out;
    for (int m = 0; m < count; ++m) {
      centre_y[m] = conv_.y.centre_floor(y);
      centre_x[m] = conv_.x.centre_floor(x);
      if (guide != nullptr) {
        const T value = guide[conv_.y.centre_pixel(y) * conv_.x.in + conv_.x.centre_pixel(x)];
        guide_.centre[m] = value;
        guide_.exempt[m] = value - value == 0 ? T(0) : T(1);
      }
      if (++x == conv_.x.out) {
        x = 0;
        ++y;
      }
    }
    const auto fill = [&](auto index) {
      using Int = decltype(index);
      fill_axis<T, Int>(conv_.y, steps_y, scale_y, centre_y, rows_);
      fill_axis<T, Int>(conv_.x, steps_x, scale_x, centre_x, columns_);
    };
    if constexpr (sizeof(T) == 4) {
      if (narrow_) return fill(int32_t{});
    }
    fill(int64_t{});
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
  const Conv& conv_;
  const bool narrow_;
  AxisTable<T> rows_, columns_;
  CornerTable<T> corners_;
  GuideTile<T> guide_;
};
