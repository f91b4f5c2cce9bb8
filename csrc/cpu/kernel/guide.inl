// How far around a pixel its guide hides nothing: pixels whose taps stay within that need no look
// at their corners. Most do, a guide hides little but at edges.
constexpr int kReaches = 3;

template <class T>
struct GuideImage {
  const T* value = nullptr;  // pixel by pixel; null: no guide
  // Of the squares that reach 1, 2 and 4 times as far as the outermost tap at scale 1, how many,
  // from the smallest, hold nothing that the pixel in their middle does not see; null: not known.
  const uint8_t* open = nullptr;
};

// Pixels to the outermost tap at scale 1, along either axis.
inline int64_t outermost_tap(const Conv& conv) {
  return (std::max(std::abs(conv.y.tap_doubled(0)), std::abs(conv.x.tap_doubled(0))) + 1) / 2;
}

// Part of an image.
struct Patch {
  int64_t y, x;  // first pixel
  int64_t rows, columns;
};

// Least and greatest values of squares around the pixels of a patch. What lies outside the image
// counts for nothing, what is not finite is less and greater than everything.
template <class T>
class Extremes {
 public:
  Extremes(int64_t rows, int64_t columns, int64_t most_reach)
      : margin_(most_reach),
        step_(columns + 2 * most_reach),
        rows_(rows + 2 * most_reach),
        memory_(4 * rows_ * step_) {
    low_ = memory_.get();
    high_ = low_ + rows_ * step_;
    other_low_ = high_ + rows_ * step_;
    other_high_ = other_low_ + rows_ * step_;
  }

  // Row of the patch, from its first column.
  const T* low(int64_t row) const { return low_ + (row + margin_) * step_ + margin_; }
  const T* high(int64_t row) const { return high_ + (row + margin_) * step_ + margin_; }

  // Squares of one pixel.
  void start(const T* image, int64_t image_rows, int64_t image_width, const Patch& patch) {
    constexpr T infinity = std::numeric_limits<T>::infinity();
    std::fill_n(low_, rows_ * step_, infinity);
    std::fill_n(high_, rows_ * step_, -infinity);
    const int64_t begin = std::max<int64_t>(patch.x - margin_, 0);
    const int64_t count = std::min(patch.x + patch.columns + margin_, image_width) - begin;
    const int64_t shift = begin - (patch.x - margin_);
    for (int64_t row = 0; row < rows_; ++row) {
      const int64_t y = patch.y - margin_ + row;
      if (y < 0 || y >= image_rows) continue;
      const T* __restrict from = image + y * image_width + begin;
      T* __restrict low = low_ + row * step_ + shift;
      T* __restrict high = high_ + row * step_ + shift;
      for (int64_t x = 0; x < count; ++x) {
        const bool finite = from[x] - from[x] == 0;
        low[x] = finite ? from[x] : -infinity;
        high[x] = finite ? from[x] : infinity;
      }
    }
    reach_ = 0;
  }

  void widen(int64_t reach) {
    while (reach_ < reach) {
      // Three squares side by side must leave no gap.
      const int64_t by = std::min(reach - reach_, 2 * reach_ + 1);
      combine(low_, other_low_, by, 1, [](T a, T b) { return a < b ? a : b; });
      combine(high_, other_high_, by, 1, [](T a, T b) { return a > b ? a : b; });
      combine(other_low_, low_, by, step_, [](T a, T b) { return a < b ? a : b; });
      combine(other_high_, high_, by, step_, [](T a, T b) { return a > b ? a : b; });
      reach_ += by;
    }
  }

 private:
  // Of each element and those `by` steps before and behind it. Elements at the ends of the memory,
  // which have none, are in the margin.
  template <class Choose>
  void combine(const T* __restrict from, T* __restrict to, int64_t by, int64_t step,
               const Choose& choose) {
    const int64_t far = by * step, size = rows_ * step_;
    for (int64_t i = far; i < size - far; ++i) {
      to[i] = choose(choose(from[i - far], from[i]), from[i + far]);
    }
    std::copy_n(from, far, to);
    std::copy_n(from + size - far, far, to + size - far);
  }

  const int64_t margin_, step_, rows_;
  int64_t reach_ = 0;
  Buffer<T> memory_;
  T *low_, *high_, *other_low_, *other_high_;
};

// The guide in the compute type, one value a pixel, whole images.
template <class T>
class GuideRows {
 public:
  GuideRows(const Conv& conv, const View& guide)
      : conv_(conv),
        guide_(guide),
        packed_(guide.data != nullptr &&
                !(guide.dtype == kComputeDType<T> && guide.x == 1 && guide.y == conv.x.in)),
        pixels_(conv.y.in * conv.x.in),
        outermost_(outermost_tap(conv)) {}

  void pack(int64_t first_image, int64_t images, const Executor& executor) {
    if (guide_.data == nullptr || (first_image_ == first_image && images_ == images)) return;
    first_image_ = first_image;
    images_ = images;
    if (packed_) memory_ = Buffer<T>(images * pixels_);
    for (int64_t n = 0; packed_ && n < images; ++n) {
      load_pixels<T>(guide_, first_image + n, 0, 1, conv_.x.in, 0, pixels_,
                     memory_.get() + n * pixels_, 1, 1);
    }
    // Of kernels that reach far, squares hide what single taps would see.
    constexpr int64_t kMostOutermost = 8;
    if (outermost_ <= kMostOutermost) find_open(executor);
  }

  GuideImage<T> image(int64_t n) const {
    if (guide_.data == nullptr) return {};
    return {values(n), open_ ? open_.get() + (n - first_image_) * pixels_ : nullptr};
  }

 private:
  const T* values(int64_t n) const {
    return packed_ ? memory_.get() + (n - first_image_) * pixels_
                   : static_cast<const T*>(guide_.data) + n * guide_.n;
  }

  void find_open(const Executor& executor) {
    open_ = Buffer<uint8_t>(images_ * pixels_);
    const int64_t height = conv_.y.in, width = conv_.x.in;
    const int64_t down = (height + kRows - 1) / kRows, across = (width + kColumns - 1) / kColumns;
    const int64_t tasks = images_ * down * across;
    const int workers = workers_for(executor, tasks, images_ * pixels_);
    std::vector<Extremes<T>> extremes;
    for (int i = 0; i < workers; ++i) {
      extremes.emplace_back(std::min(kRows, height), std::min(kColumns, width),
                            outermost_ << (kReaches - 1));
    }
    // An infinite one would let values pass that are not finite.
    const T tolerance =
        std::min(static_cast<T>(conv_.guide_tolerance), std::numeric_limits<T>::max());
    run_tasks(executor, tasks, workers, [&](int worker, int64_t task) {
      const int64_t image = task / (down * across);
      const int64_t y = task / across % down * kRows, x = task % across * kColumns;
      const Patch patch{y, x, std::min(kRows, height - y), std::min(kColumns, width - x)};
      const int64_t first = y * width + x;
      find_open_patch(extremes[static_cast<size_t>(worker)], values(first_image_ + image), patch,
                      tolerance, open_.get() + image * pixels_ + first);
    });
  }

  void find_open_patch(Extremes<T>& around, const T* image, const Patch& patch, T tolerance,
                       uint8_t* open) const {
    const int64_t width = conv_.x.in;
    around.start(image, conv_.y.in, width, patch);
    for (int i = 0; i < kReaches; ++i) {
      around.widen(outermost_ << i);
      for (int64_t row = 0; row < patch.rows; ++row) {
        const T* centre = image + (patch.y + row) * width + patch.x;
        uint8_t* __restrict to = open + row * width;
        int32_t within[kColumns];
        find_within(patch.columns, around.low(row), around.high(row), centre, tolerance, within);
        for (int64_t x = 0; x < patch.columns; ++x) {
          to[x] = static_cast<uint8_t>((i == 0 ? 0 : to[x]) + within[x]);
        }
      }
    }
  }

  static void find_within(int64_t count, const T* __restrict low, const T* __restrict high,
                          const T* __restrict centre, T tolerance, int32_t* __restrict within) {
    for (int64_t x = 0; x < count; ++x) {
      const T above = high[x] - centre[x], below = centre[x] - low[x];
      const T most = above > below ? above : below;
      within[x] = most <= tolerance ? 1 : 0;
    }
  }

  static constexpr int64_t kRows = 32, kColumns = 256;  // of a patch

  const Conv& conv_;
  const View& guide_;
  const bool packed_;
  const int64_t pixels_, outermost_;
  int64_t first_image_ = -1, images_ = 0;
  Buffer<T> memory_;
  Buffer<uint8_t> open_;
};
