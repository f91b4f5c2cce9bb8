// Weights of dense products, between a tensor and rows (tap, channel) of outputs. They are moved by
// the loads and stores of pixels, the kernel's taps being the pixels of a small image.

// Pixels first .. first+count-1 of a view, `width` of them in a row, that have a layer's outputs
// for channels; of a block's rows (tap, channel) the first of theirs, and how far apart they are.
struct WeightRun {
  View view;
  int64_t width, first, count;
  int64_t row, step;
};

// body(run) for the weights of a block at `taps` taps.
template <class Body>
SURFCONV_INLINE void for_weight_runs(const View& weight, int64_t kernel_x,
                                     const ChannelBlock& block, int64_t first_tap, int64_t taps,
                                     int64_t rows_of_tap, const Body& body) {
  View view = weight;
  view.c = weight.n;
  if (weight.c == 1) {
    view.x = 1;
    view.y = block.count;
    for (int64_t t = 0; t < taps; ++t) {
      const int64_t tap = first_tap + t;
      View channels = view;
      advance(channels, tap / kernel_x * weight.y + tap % kernel_x * weight.x + block.first);
      body(WeightRun{channels, block.count, 0, block.count, t * rows_of_tap, 1});
    }
    return;
  }
  for (int64_t c = 0; c < block.count; ++c) {
    View filter = view;
    advance(filter, (block.first + c) * weight.c);
    body(WeightRun{filter, kernel_x, first_tap, taps, c, rows_of_tap});
  }
}

// Filters with tap after tap and channel after channel, as nn.Conv2d has them, are moved as one run
// of both and put in order on the way: runs of a few taps each would be slow, and so would rows a
// power of two apart.
template <class T>
class WholeFilters {
 public:
  WholeFilters(const View& weight, int64_t kernel_x, const ChannelBlock& block, int64_t first_tap,
               int64_t taps)
      : view_(weight),
        block_(block),
        taps_(taps),
        are_(first_tap == 0 && taps <= kRows && weight.c == taps && weight.x == 1 &&
             weight.y == kernel_x) {
    view_.c = weight.n;
  }
  explicit operator bool() const { return are_; }

  // Of the outputs first .. first+outputs-1; rows of `columns` elements, all of them a panel's.
  void load(int64_t first, int64_t outputs, T* to, int64_t columns) const {
    for_parts([&](const View& view, int64_t channel, int64_t channels, T* stage) {
      const int64_t count = channels * taps_;
      load_pixels<T>(view, 0, first, outputs, count, 0, count, stage, columns, columns);
      for (int64_t t = 0; t < taps_; ++t) {
        copy_rows(stage + t * columns, taps_ * columns, columns, channels,
                  to + (t * block_.count + channel) * columns, columns);
      }
    });
  }
  void store(const T* from, int64_t ld, int64_t columns, int64_t first, int64_t outputs) const {
    for_parts([&](const View& view, int64_t channel, int64_t channels, T* stage) {
      const int64_t count = channels * taps_;
      for (int64_t t = 0; t < taps_; ++t) {
        copy_rows(from + (t * block_.padded + channel) * ld, ld, columns, channels,
                  stage + t * columns, taps_ * columns);
      }
      store_pixels<T>(view, 0, first, outputs, count, 0, count, stage, columns);
    });
  }

 private:
  static constexpr int64_t kRows = 288;  // of a panel, in half of the first-level cache

  // body(view of the part's weights as pixels, its first channel, its channels, room for them)
  template <class Body>
  void for_parts(const Body& body) const {
    alignas(64) T stage[kRows * 2 * kLanes<T>];
    const int64_t most = kRows / taps_;
    for (int64_t channel = 0; channel < block_.count; channel += most) {
      const int64_t channels = std::min(most, block_.count - channel);
      View view = view_;
      view.y = channels * taps_;
      advance(view, (block_.first + channel) * taps_);
      body(view, channel, channels, stage);
    }
  }
  static void copy_rows(const T* from, int64_t from_step, int64_t columns, int64_t rows, T* to,
                        int64_t to_step) {
    if (columns >= kQuad) return copy_pixels(from, from_step, columns, rows, to, to_step);
    for (int64_t i = 0; i < rows; ++i) std::copy_n(from + i * from_step, columns, to + i * to_step);
  }

  View view_;
  const ChannelBlock& block_;
  const int64_t taps_;
  const bool are_;
};

// Rows (tap, channel) of a block against a panel of its group's outputs.
template <class T>
void pack_panel(const View& weight, int64_t kernel_x, const Plan& plan, const ChannelBlock& block,
                int64_t first_tap, int64_t taps, int64_t column, int64_t columns, T* panel) {
  const int64_t used = std::min(columns, plan.outputs - column);
  const int64_t first = block.group * plan.outputs + column;
  if (const WholeFilters<T> whole(weight, kernel_x, block, first_tap, taps); whole) {
    return whole.load(first, used, panel, columns);
  }
  const auto load_run = [&](const WeightRun& run) {
    load_pixels<T>(run.view, 0, first, used, run.width, run.first, run.count,
                   panel + run.row * columns, run.step * columns, columns);
  };
  for_weight_runs(weight, kernel_x, block, first_tap, taps, block.count, load_run);
}

// All panels: the forward's B.
template <class T>
void pack_forward(const View& weight, int64_t kernel_x, const Plan& plan, const ChannelBlock& block,
                  int64_t first_tap, int64_t taps, T* packed) {
  for_panels<T>(plan.outputs, [&](int64_t column, int64_t columns) {
    pack_panel(weight, kernel_x, plan, block, first_tap, taps, column, columns,
               packed + column * taps * block.count);
  });
}

// Rows of outputs against (tap, channel), in panels: the B of the gradient of the gathered matrix.
// Some rows at a time: those of a panel lie side by side, panels a power of two apart.
template <class T>
void pack_backward(const View& weight, int64_t kernel_x, const Plan& plan,
                   const ChannelBlock& block, int64_t first_tap, int64_t taps, T* packed) {
  constexpr int64_t kRows = 8;
  const int64_t width = taps * block.padded, ld = pad_width<T>(width);
  std::vector<T> rows(static_cast<size_t>(kRows * ld), T(0));
  for (int64_t o = 0; o < plan.outputs; o += kRows) {
    const int64_t count = std::min(kRows, plan.outputs - o);
    for (int64_t i = 0; i < count; ++i) {
      load_pixels<T>(weight, block.group * plan.outputs + o + i, block.first, block.count, kernel_x,
                     first_tap, taps, rows.data() + i * ld, block.padded, block.padded);
    }
    for_panels<T>(width, [&](int64_t column, int64_t columns) {
      T* to = packed + column * plan.outputs + o * columns;
      for (int64_t i = 0; i < count; ++i) {
        std::copy_n(rows.data() + i * ld + column, columns, to + i * columns);
      }
    });
  }
}

// All taps of a block's gradient, in rows of `width` outputs.
template <class T>
void store_weight_rows(const T* from, int64_t width, int64_t kernel_x, const Plan& plan,
                       const ChannelBlock& block, const View& weight) {
  const int64_t first = block.group * plan.outputs;
  if (const WholeFilters<T> whole(weight, kernel_x, block, 0, plan.taps); whole) {
    return for_panels<T>(plan.outputs, [&](int64_t column, int64_t columns) {
      whole.store(from + column, width, columns, first + column,
                  std::min(columns, plan.outputs - column));
    });
  }
  const auto store_run = [&](const WeightRun& run) {
    store_pixels<T>(run.view, 0, first, plan.outputs, run.width, run.first, run.count,
                    from + run.row * width, run.step * width);
  };
  for_weight_runs(weight, kernel_x, block, 0, plan.taps, block.padded, store_run);
}
