// The pixels that windows to come will meet first: the processor's own prefetching stops at the
// gaps between tiles, and loses its way among the rows of a pool's window. Neighbours are at like
// depths, so these are where the lowest taps are now, some tiles further on. (The convolution's
// backward gained nothing by it but for the gradients that it reads in place.)

// Where channels of an image lie.
struct ImagePart {
  const char* first_pixel;
  int64_t step_y, step_x;  // bytes
  int64_t bytes;           // of a pixel's channels
};

class FetchAhead {
 public:
  FetchAhead(const Axis& y, const Axis& x, const ImagePart& part)
      : rows_(std::min(y.stride, y.kernel)),
        bytes_(part.bytes + (std::min(x.stride, x.kernel) - 1) * part.step_x),
        step_y_(static_cast<uintptr_t>(part.step_y)),
        advance_(x.stride * part.step_x),
        start_(reinterpret_cast<uintptr_t>(part.first_pixel) +
               static_cast<uintptr_t>(kPixelsAhead * advance_)) {}

  // lowest: where an output pixel's lowest taps are, bytes from the first pixel.
  SURFCONV_INLINE void operator()(int64_t lowest) const {
    uintptr_t row = start_ + static_cast<uintptr_t>(lowest);
    for (int64_t i = 0; i < rows_; ++i, row -= step_y_) {
      fetch<false>(row, bytes_);
    }
  }

  // For the pixels of a tile: lowest and middle, where the rows and columns of those taps are.
  SURFCONV_INLINE void operator()(const int64_t* lowest, const int64_t* middle, int count) const {
    const int pixels = static_cast<int>(std::max<int64_t>(1, kLine / advance_));
    for (int m = 0; m < count; m += pixels) (*this)(lowest[m] + middle[m]);
  }

 private:
  static constexpr int64_t kPixelsAhead = 2 * kTile;

  // The pixels that the window moves on by, as far as it covers them.
  const int64_t rows_, bytes_;
  const uintptr_t step_y_;
  const int64_t advance_;
  const uintptr_t start_;
};
