// Successive tiles that are gathered one after the other and multiplied at once: what no cache
// holds of the weights is read once for all of them.
template <class T>
class Tiles {
 public:
  // Up to `most`, so many that half of a worker's cache is left to the weights. row: elements of a
  // gathered pixel.
  static int at_once(const Conv& conv, int64_t taps, int64_t row, int64_t cache, int64_t most) {
    const int64_t each = Tile<T>::need(conv, taps) + Workspace::need<T>(kTile * row);
    return static_cast<int>(std::clamp<int64_t>(cache / 2 / each, 1, most));
  }
  static int64_t need(const Conv& conv, int64_t taps, int most) {
    return most * Tile<T>::need(conv, taps);
  }
  Tiles(const Conv& conv, int64_t taps, int most, Workspace& memory) {
    tiles_.reserve(static_cast<size_t>(most));
    for (int i = 0; i < most; ++i) tiles_.emplace_back(conv, taps, memory);
  }

  Tile<T>& front() { return tiles_.front(); }

  // Flat output pixels first .. first+count-1 of image n; see Tile.
  void place(const View& scale, const GuideImage<T>& guide, int64_t n, int64_t first, int count,
             AxisSteps steps_y, AxisSteps steps_x, bool derivatives) {
    count_ = count;
    for_each([&](Tile<T>& tile, int begin, int pixels) {
      tile.place(scale, guide, n, first + begin, pixels, steps_y, steps_x, derivatives);
    });
  }

  // body(tile, where its pixels begin among all of them, how many they are)
  template <class Body>
  SURFCONV_INLINE void for_each(const Body& body) {
    for (int begin = 0; begin < count_; begin += kTile) {
      body(tiles_[static_cast<size_t>(begin / kTile)], begin, std::min(kTile, count_ - begin));
    }
  }

  void find_seen(bool derivatives) {
    whole_ = true;
    for_each([&](Tile<T>& tile, int, int pixels) {
      tile.find_seen(pixels, derivatives);
      whole_ &= tile.sees_all();
    });
  }

  // As a tile's own, with the pixels counted over all tiles.
  template <class Body>
  SURFCONV_INLINE void for_seen(int64_t first_tap, int64_t taps, const Body& body) {
    if (whole_) return body(Range{0, round_up(count_, kRowPad)}, Range{0, taps});
    for_each([&](Tile<T>& tile, int begin, int) {
      tile.for_seen(first_tap, taps, [&](Range pixels, Range seen) {
        body(Range{begin + pixels.begin, begin + pixels.end}, seen);
      });
    });
  }

  template <bool Writes, Slopes S>
  void fill_taps(int64_t first_tap, int64_t taps, int64_t unseen_read, int64_t unseen_write) {
    for_each([&](Tile<T>& tile, int, int) {
      if (!tile.needs_list()) return;
      tile.template fill_taps<Writes, S>(first_tap, taps, unseen_read, unseen_write);
    });
  }

 private:
  std::vector<Tile<T>> tiles_;
  int count_ = 0;
  bool whole_ = true;  // every pixel sees something of all taps
};
