// The gradient of the input while it is summed: in place where it has the compute type and its
// channels innermost, else the rows of the pass in the compute type. Rows into which the next pass
// scatters too are carried over, so that each is rounded and stored once.
template <class T>
class GradientRows {
 public:
  GradientRows(const Conv& conv, const Plan& plan, const View& gradient)
      : conv_(conv),
        plan_(plan),
        gradient_(gradient),
        in_place_(gradient.dtype == kComputeDType<T> && gradient.c == 1 &&
                  plan.row == conv.in_channels) {}

  bool needed() const { return gradient_.data != nullptr; }
  bool copies() const { return needed() && !in_place_; }
  int64_t row_elements() const { return conv_.x.in * plan_.row; }

  void reserve(const std::vector<Pass>& passes) {
    if (copies()) memory_ = Buffer<T>(most_rows(passes) * row_elements());
  }

  // Where row 0 of image n would lie; only rows of the pass are there.
  char* image(const Pass& pass, int64_t n) const {
    const int64_t before = pass.in.begin * row_elements() * static_cast<int64_t>(sizeof(T));
    return reinterpret_cast<char*>(reinterpret_cast<uintptr_t>(row(pass, n, pass.in.begin)) -
                                   static_cast<uintptr_t>(before));
  }

  // Row y of image n, a row of the pass.
  T* row(const Pass& pass, int64_t n, int64_t y) const {
    if (in_place_) {
      return static_cast<T*>(gradient_.data) + n * gradient_.n + y * row_elements();
    }
    return memory_.get() +
           ((n - pass.first_image) * pass.in.count() + y - pass.in.begin) * row_elements();
  }

  // previous: the pass before over the same image, or null.
  void begin(const Pass& pass, const Pass* previous, const Executor& executor) {
    if (!needed()) return;
    if (in_place_) return clear_in_place(pass, previous, executor);
    const Range kept{pass.in.begin, previous != nullptr ? previous->in.end : pass.in.begin};
    if (kept.count() > 0) {
      const T* from = memory_.get() + (pass.in.begin - previous->in.begin) * row_elements();
      std::memmove(memory_.get(), from,
                   static_cast<size_t>(kept.count() * row_elements()) * sizeof(T));
    }
    const int64_t fresh = pass.in.end - std::max(kept.end, pass.in.begin);
    const int64_t rows = pass.images * fresh;
    run_tasks(executor, rows, workers_for(executor, rows, rows * row_elements() / 4),
              [&](int, int64_t i) {
                T* to = row(pass, pass.first_image + i / fresh, pass.in.end - fresh + i % fresh);
                std::fill(to, to + row_elements(), T(0));
              });
  }

  // next: the pass after over the same image, or null. Rows that no pass holds are zero.
  void end(const Pass& pass, bool first, const Pass* next, const Executor& executor) {
    if (!copies()) return;
    const Range done{first ? 0 : pass.in.begin, next != nullptr ? next->in.begin : conv_.y.in};
    const std::vector<T> zeros(static_cast<size_t>(row_elements()), T(0));
    const int64_t rows = pass.images * std::max<int64_t>(done.count(), 0);
    run_tasks(executor, rows, workers_for(executor, rows, rows * row_elements()),
              [&](int, int64_t i) {
                const int64_t n = pass.first_image + i / done.count();
                const int64_t y = done.begin + i % done.count();
                const T* from = pass.in.has(y) ? row(pass, n, y) : zeros.data();
                store_lanes<T>(gradient_, plan_.in, n, conv_.x.in, y * conv_.x.in, conv_.x.in, from,
                               plan_.row);
              });
  }

 private:
  void clear_in_place(const Pass& pass, const Pass* previous, const Executor& executor) const {
    if (previous != nullptr) return;
    const int64_t rows = pass.images * conv_.y.in;
    run_tasks(executor, rows, workers_for(executor, rows, rows * row_elements() / 4),
              [&](int, int64_t i) {
                T* to = row(pass, pass.first_image + i / conv_.y.in, i % conv_.y.in);
                std::fill(to, to + row_elements(), T(0));
              });
  }

  const Conv& conv_;
  const Plan& plan_;
  const View& gradient_;
  const bool in_place_;
  Buffer<T> memory_;
};
