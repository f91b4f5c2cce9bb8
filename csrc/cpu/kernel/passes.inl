// The input is handled in passes: a run of whole images, or, of an image that is large, some output
// rows and the input rows that their taps may touch. Copies that a pass makes (the input with its
// channels innermost, gradients in the compute type) are bounded however large the image is, unless
// its taps reach across all of it. By shape and scale alone, so that sums keep their order.
struct Pass {
  int64_t first_image, images;
  Range out;
  Range in;  // of successive passes over an image neither bound goes back
};

// The largest finite magnitude of the scale at `count` flat output pixels: taps of a scale that is
// not finite stay at the centre.
template <class T>
T largest_scale(const Conv& conv, const View& scale, int64_t n, int64_t first, int64_t count) {
  // Bits of magnitudes compare like the magnitudes, and whole vectors of them at a time.
  using Bits = std::conditional_t<sizeof(T) == 4, int32_t, int64_t>;
  const T infinity = std::numeric_limits<T>::infinity();
  Bits infinite, bits[kTile], most_bits = 0;
  std::memcpy(&infinite, &infinity, sizeof(T));
  for (const int64_t end = first + count; first < end; first += kTile) {
    T values[kTile] = {};
    load_pixels<T>(scale, n, 0, 1, conv.x.out, first, std::min<int64_t>(kTile, end - first), values,
                   1, 1);
    std::memcpy(bits, values, sizeof(bits));
    for (int m = 0; m < kTile; ++m) {
      const Bits magnitude = bits[m] & std::numeric_limits<Bits>::max();
      most_bits = std::max(most_bits, magnitude < infinite ? magnitude : Bits(0));
    }
  }
  T most;
  std::memcpy(&most, &most_bits, sizeof(T));
  return most;
}

// Between a sample and its centre, in whole rows rounded up; one more where it is an exact number
// of rows, which count to the next cell. Products rounded in T may become exact.
template <class T>
int64_t spread_of(const Conv& conv, T scale) {
  const double tap = static_cast<double>(std::abs(conv.y.tap_doubled(0))) / 2;
  const double most = static_cast<double>(scale) * tap;
  const double rounded = most + most * 4 * static_cast<double>(std::numeric_limits<T>::epsilon());
  return 1 + static_cast<int64_t>(std::min(rounded, static_cast<double>(conv.y.reach())));
}

// The input rows within a spread of output rows: both rows around a sample.
inline Range rows_around(const Conv& conv, Range rows, int64_t spread) {
  const auto clamp = [&](int64_t row) { return std::min(std::max<int64_t>(row, 0), conv.y.in); };
  return {clamp(conv.y.centre_floor(rows.begin) - spread),
          clamp(conv.y.centre_floor(rows.end - 1) + spread + 2)};
}

// The largest spread for which the rows around two runs of output rows, so many rows between them,
// are apart.
inline int64_t spread_apart(const Conv& conv, int64_t rows_between) {
  return (conv.y.stride * (rows_between + 1) - 2) / 2;
}

// copies: the pass copies rows, so their number should be bounded; row: elements of an input row.
template <class T>
std::vector<Pass> make_passes(const Conv& conv, const View& scale, bool copies, int64_t row) {
  constexpr int64_t kElements = int64_t{1} << 22;
  const int64_t image = std::max<int64_t>(1, conv.y.in * row);
  std::vector<Pass> passes;
  if (!copies || image <= kElements || conv.y.out * conv.x.out == 0) {
    const int64_t images = std::max<int64_t>(1, std::min(conv.batch, kElements / image));
    for (int64_t n = 0; n < conv.batch; n += images) {
      passes.push_back({n, std::min(images, conv.batch - n), {0, conv.y.out}, {0, conv.y.in}});
    }
    return passes;
  }
  std::vector<Range> reach(static_cast<size_t>(conv.y.out));
  for (int64_t n = 0; n < conv.batch; ++n) {
    // Rows that one output row needs anyway cost the others no memory: a depth that is far too near
    // must not make a pass of every row that has one.
    int64_t most = std::max<int64_t>(1, kElements / row);
    for (int64_t y = 0; y < conv.y.out; ++y) {
      const T largest = largest_scale<T>(conv, scale, n, y * conv.x.out, conv.x.out);
      reach[static_cast<size_t>(y)] = rows_around(conv, {y, y + 1}, spread_of(conv, largest));
      most = std::max(most, reach[static_cast<size_t>(y)].count());
    }
    const int64_t shares = (conv.y.in + most - 1) / most;  // a small last pass feeds few threads
    const int64_t most_out = (conv.y.out + shares - 1) / shares;
    const size_t start = passes.size();
    for (int64_t y = 0; y < conv.y.out; ++y) {
      const Range needed = reach[static_cast<size_t>(y)];
      if (passes.size() > start) {
        Pass& last = passes.back();
        const Range both{std::min(last.in.begin, needed.begin), std::max(last.in.end, needed.end)};
        if (both.count() <= most && last.out.count() < most_out) {
          last.in = both;
          last.out.end = y + 1;
          continue;
        }
      }
      passes.push_back({n, 1, {y, y + 1}, needed});
    }
    for (size_t i = start + 1; i < passes.size(); ++i) {
      passes[i].in.end = std::max(passes[i].in.end, passes[i - 1].in.end);
    }
    for (size_t i = passes.size() - 1; i-- > start;) {
      passes[i].in.begin = std::min(passes[i].in.begin, passes[i + 1].in.begin);
    }
  }
  return passes;
}

// Most rows of input that any pass holds, all its images together.
inline int64_t most_rows(const std::vector<Pass>& passes) {
  int64_t most = 0;
  for (const Pass& pass : passes) most = std::max(most, pass.images * pass.in.count());
  return most;
}

// The input as channel-innermost rows: in place where it lies so already, pixel after pixel, else
// packed.
template <class T>
class InputRows {
 public:
  InputRows(const Conv& conv, const Plan& plan, const View& input)
      : conv_(conv),
        plan_(plan),
        input_(input),
        packed_(!(input.dtype == kComputeDType<T> && plan.row == conv.in_channels && input.c == 1 &&
                  input.x == plan.row)) {}

  bool packed() const { return packed_; }
  int64_t row_elements() const { return conv_.x.in * plan_.row; }
  int64_t step_x() const { return plan_.row; }
  int64_t step_y() const { return packed_ ? row_elements() : input_.y; }

  void reserve(const std::vector<Pass>& passes) {
    if (packed_) memory_ = Buffer<T>(most_rows(passes) * row_elements());
  }

  // Where row 0 of image n would lie; only rows of the pass are there.
  const char* image(const Pass& pass, int64_t n) const {
    constexpr int64_t bytes = sizeof(T);
    if (!packed_) return static_cast<const char*>(input_.data) + n * input_.n * bytes;
    const int64_t row = (n - pass.first_image) * pass.in.count() - pass.in.begin;
    return reinterpret_cast<const char*>(reinterpret_cast<uintptr_t>(memory_.get()) +
                                         static_cast<uintptr_t>(row * row_elements() * bytes));
  }

  void pack(const Pass& pass, const Executor& executor) {
    if (!packed_) return;
    const int64_t strip = std::max<int64_t>(1, 4096 / plan_.row + 1) * 8;
    const int64_t first = pass.in.begin * conv_.x.in, pixels = pass.in.count() * conv_.x.in;
    const int64_t strips = (pixels + strip - 1) / strip, tasks = pass.images * strips;
    run_tasks(executor, tasks, workers_for(executor, tasks, pass.images * pixels * plan_.row),
              [&](int, int64_t task) {
                const int64_t n = task / strips, begin = task % strips * strip;
                const int64_t count = std::min(strip, pixels - begin);
                load_lanes<T>(input_, plan_.in, pass.first_image + n, 0, plan_.row, conv_.x.in,
                              first + begin, count,
                              memory_.get() + (n * pixels + begin) * plan_.row, plan_.row);
              });
  }

 private:
  const Conv& conv_;
  const Plan& plan_;
  const View& input_;
  const bool packed_;
  Buffer<T> memory_;
};
