// Kernels of one tap: its offset is zero, so that every output pixel reads the pixel at its centre
// whatever the scale and the guide are. What is left is a product of pixels with the filters.
SURFCONV_INLINE bool is_pointwise(const Conv& conv) {
  return conv.y.kernel == 1 && conv.x.kernel == 1 && !Plan(conv).lanewise;
}

// Outputs of an axis whose centre lies in the image.
SURFCONV_INLINE Range outputs_inside(const Axis& axis) {
  const int64_t begin = std::min((axis.padding + axis.stride - 1) / axis.stride, axis.out);
  const int64_t end = std::min((axis.in - 1 + axis.padding) / axis.stride + 1, axis.out);
  return {begin, std::max(begin, end)};
}

// The geometry under which the output's pixels meet the output itself.
SURFCONV_INLINE Conv onto_itself(Conv conv) {
  for (Axis* axis : {&conv.y, &conv.x}) *axis = {axis->out, axis->out, 1, 1, 0, 1};
  return conv;
}

// A tensor of the input's size as the output's pixels meet it. In a tile pixels come row by row
// ([pixel][channel]) where the tensor has its channels innermost, else plane by plane
// ([channel][pixel]), so that neither needs to be transposed.
template <class T>
class CentrePixels {
 public:
  CentrePixels(const Conv& conv, const View& view)
      : view_(view),
        width_(conv.x.out),
        rows_(outputs_inside(conv.y)),
        columns_(outputs_inside(conv.x)),
        whole_(rows_.count() == conv.y.out && columns_.count() == conv.x.out) {
    if (view.data == nullptr) return;
    if (rows_.count() > 0 && columns_.count() > 0) {
      advance(view_, conv.y.centre_floor(rows_.begin) * view.y +
                         conv.x.centre_floor(columns_.begin) * view.x);
    }
    view_.y *= conv.y.stride;
    view_.x *= conv.x.stride;
    flat_ = whole_ && view.dtype == kComputeDType<T> && view_.y == view_.x * width_;
  }

  // Pixels as they lie, one every pixel_step() elements, or null where they have to be loaded.
  T* rows_in_place(int64_t n, int64_t channel, int64_t begin) const {
    return flat_ && view_.c == 1 ? at(n, channel, begin) : nullptr;
  }
  int64_t pixel_step() const { return view_.x; }

  // Planes as they lie, one every plane_step() elements, or null.
  T* planes_in_place(int64_t n, int64_t channel, int64_t begin) const {
    return flat_ && view_.x == 1 ? at(n, channel, begin) : nullptr;
  }
  int64_t plane_step() const { return view_.c; }

  void load_rows(int64_t n, int64_t channel, int64_t channels, int64_t begin, int64_t count, T* to,
                 int64_t ld) const {
    if (!whole_) std::fill_n(to, count * ld, T(0));
    for_inside(begin, count, [&](int64_t done, int64_t run, int64_t first) {
      load_pixels<T>(view_, n, channel, channels, columns_.count(), first, run, to + done * ld, ld,
                     channels);
    });
  }
  void load_planes(int64_t n, int64_t channel, int64_t channels, int64_t begin, int64_t count,
                   T* to, int64_t ld) const {
    if (const T* planes = planes_in_place(n, channel, begin)) {
      for (int64_t c = 0; c < channels; ++c) {
        std::copy_n(planes + c * view_.c, count, to + c * ld);
      }
      return;
    }
    if (!whole_) std::fill_n(to, channels * ld, T(0));
    for_inside(begin, count, [&](int64_t done, int64_t run, int64_t first) {
      for (int64_t c = 0; c < channels; ++c) {
        load_pixels<T>(view_, n, channel + c, 1, columns_.count(), first, run, to + c * ld + done,
                       1, 1);
      }
    });
  }
  void store_rows(int64_t n, int64_t channel, int64_t channels, int64_t begin, int64_t count,
                  const T* from, int64_t ld) const {
    for_inside(begin, count, [&](int64_t done, int64_t run, int64_t first) {
      store_pixels<T>(view_, n, channel, channels, columns_.count(), first, run, from + done * ld,
                      ld);
    });
  }
  void store_planes(int64_t n, int64_t channel, int64_t channels, int64_t begin, int64_t count,
                    const T* from, int64_t ld) const {
    if (T* planes = planes_in_place(n, channel, begin)) {
      for (int64_t c = 0; c < channels; ++c) {
        std::copy_n(from + c * ld, count, planes + c * view_.c);
      }
      return;
    }
    for_inside(begin, count, [&](int64_t done, int64_t run, int64_t first) {
      for (int64_t c = 0; c < channels; ++c) {
        store_pixels<T>(view_, n, channel + c, 1, columns_.count(), first, run,
                        from + c * ld + done, 1);
      }
    });
  }

 private:
  T* at(int64_t n, int64_t channel, int64_t pixel) const {
    return static_cast<T*>(view_.data) + n * view_.n + channel * view_.c + pixel * view_.x;
  }

  // body(pixels already done, pixels, first of them among those inside) for the runs inside the
  // image of the flat output pixels begin .. begin+count-1
  template <class Body>
  void for_inside(int64_t begin, int64_t count, const Body& body) const {
    if (whole_) return body(0, count, begin);
    for (int64_t done = 0; done < count;) {
      const int64_t y = (begin + done) / width_, x = (begin + done) % width_;
      const int64_t run = std::min(count - done, width_ - x);
      const int64_t from = std::max(x, columns_.begin), to = std::min(x + run, columns_.end);
      if (rows_.has(y) && from < to) {
        body(done + from - x, to - from,
             (y - rows_.begin) * columns_.count() + from - columns_.begin);
      }
      done += run;
    }
  }

  View view_;
  int64_t width_;
  Range rows_, columns_;
  bool whole_;         // all centres lie in the image
  bool flat_ = false;  // and the pixels one step apart, in the compute type
};

// Whole panels of every instruction set, so that products may end at planes in place.
constexpr int64_t kPlaneTile = kTile;
static_assert(kPlaneTile % kLanes<float> == 0, "whole panels only");

// Whether a product reads planes where they lie: many of them, a power of two apart, would drive
// each other from the cache before the next block of rows comes to them.
SURFCONV_INLINE bool reads_in_place(int64_t planes, int64_t rows) {
  return planes <= 16 || rows <= kRowBlock;
}

// Rows of a product whose left factor is packed for it: blocks of twelve, then of four.
SURFCONV_INLINE int64_t row_block(int64_t rows_left) {
  return rows_left >= kRowBlock ? kRowBlock : 4;
}

// Filters of one tap as a row of pixels: an input channel's with the outputs for channels, or an
// output's with the input's.
SURFCONV_INLINE View input_pixels(View weight) {
  weight.x = weight.c;
  weight.c = weight.n;
  return weight;
}
SURFCONV_INLINE View output_pixels(View weight) {
  weight.x = weight.n;
  return weight;
}

// packed: [block of rows][depth][rows of the block], zeros up to a multiple of four rows. filters:
// rows are its channels, the depth its pixels.
template <class T>
void pack_rows(const View& filters, int64_t first, int64_t rows, int64_t depth, T* packed) {
  for (int64_t row = 0, block; row < rows; row += block) {
    block = row_block(round_up(rows, 4) - row);
    load_pixels<T>(filters, 0, first + row, std::min(block, rows - row), depth, 0, depth,
                   packed + row * depth, block, block);
  }
}

// C[rows x columns] = initial row (null: C) + packed rows * B[depth][ldb]; columns are padded to
// whole panels, of which kPlaneTile has room for.
template <class T>
void multiply_planes(int64_t rows, int64_t columns, int64_t depth, const T* packed, const T* b,
                     int64_t ldb, T* c, int64_t ldc, const T* initial) {
  for (int64_t row = 0, block; row < rows; row += block) {
    block = row_block(rows - row);
    for_panels<T>(columns, [&](int64_t column, int64_t panel) {
      const auto multiply = [&](auto most) {
        gemm_panel<T, true, decltype(most)::value>(panel, block, depth, packed + row * depth, block,
                                                   b + column, ldb, c + row * ldc + column, ldc,
                                                   initial);
      };
      block == 4 ? multiply(std::integral_constant<int, 4>{})
                 : multiply(std::integral_constant<int, kRowBlock>{});
    });
  }
}
