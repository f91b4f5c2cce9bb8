// A pool's images with their channels innermost: the tensor itself where it is so, else a copy.
SURFCONV_INLINE int64_t pool_tiles(const Pool& pool) {
  return (pool.y.out * pool.x.out + kTile - 1) / kTile;
}

// Whether whole pixels of T can be read, or written, in vectors where they are.
template <class T>
bool has_whole_pixels(const View& view, int64_t channels) {
  return view.dtype == kComputeDType<T> && view.c == 1 && channels % kQuad == 0;
}

// Pixels and guides of the images of a call, a group of images at a time.
template <class T>
class PoolImages {
 public:
  // input without data: only guides are wanted
  PoolImages(const Pool& pool, const View& input, const View& guide)
      : pool_(pool), input_(input), guide_(guide) {
    const int64_t pixels = pool.y.in * pool.x.in;
    copied_ = input.data != nullptr && !has_whole_pixels<T>(input, pool.channels);
    guide_copied_ = guide.data != nullptr &&
                    !(guide.dtype == kComputeDType<T> && guide.x == 1 && guide.y == pool.x.in);
    step_x_ = copied_ ? to_quads(pool.channels) : input.x;
    step_y_ = copied_ ? pool.x.in * step_x_ : input.y;
    const int64_t each = pixels * ((copied_ ? step_x_ : 0) + (guide_copied_ ? 1 : 0));
    constexpr int64_t kMost = (int64_t{8} << 20) / static_cast<int64_t>(sizeof(T));
    group_ = each == 0 ? pool.batch : std::min(pool.batch, std::max<int64_t>(1, kMost / each));
    if (copied_) pixels_ = Buffer<T>(group_ * pixels * step_x_);
    if (guide_copied_) guides_ = Buffer<T>(group_ * pixels);
  }

  // Calls body(first, count) for each group of images, when they are there.
  template <class Body>
  void for_groups(const Executor& executor, const Body& body) {
    for (first_ = 0; first_ < pool_.batch; first_ += group_) {
      const int64_t count = std::min(group_, pool_.batch - first_);
      load(executor, count);
      body(first_, count);
    }
  }

  int64_t step_y() const { return step_y_; }
  int64_t step_x() const { return step_x_; }
  const T* image(int64_t n) const {
    if (copied_) return pixels_.get() + (n - first_) * pool_.y.in * step_y_;
    return static_cast<const T*>(input_.data) + n * input_.n;
  }
  const T* guide(int64_t n) const {
    if (guide_copied_) return guides_.get() + (n - first_) * pool_.y.in * pool_.x.in;
    return guide_.data == nullptr ? nullptr : static_cast<const T*>(guide_.data) + n * guide_.n;
  }

 private:
  void load(const Executor& executor, int64_t count) {
    if (!copied_ && !guide_copied_) return;
    constexpr int64_t kRun = 1024;
    const int64_t pixels = pool_.y.in * pool_.x.in, width = pool_.x.in;
    const int64_t runs = (pixels + kRun - 1) / kRun;
    const int workers = workers_for(executor, count * runs, count * pixels * step_x_);
    run_tasks(executor, count * runs, workers, [&](int, int64_t task) {
      const int64_t i = task / runs, begin = task % runs * kRun;
      const int64_t run = std::min(kRun, pixels - begin);
      if (copied_) {
        load_pixels<T>(input_, first_ + i, 0, pool_.channels, width, begin, run,
                       pixels_.get() + (i * pixels + begin) * step_x_, step_x_, step_x_);
      }
      if (guide_copied_) {
        load_pixels<T>(guide_, first_ + i, 0, 1, width, begin, run,
                       guides_.get() + i * pixels + begin, 1, 1);
      }
    });
  }

  const Pool& pool_;
  View input_, guide_;
  bool copied_, guide_copied_;
  int64_t step_y_, step_x_, group_, first_ = 0;
  Buffer<T> pixels_, guides_;
};

// Runs body(worker, n, tile) over all tiles of images first .. first+count-1.
template <class Body>
void for_pool_tiles(const Pool& pool, const Executor& executor, int workers, int64_t first,
                    int64_t count, const Body& body) {
  constexpr int64_t kTilesEach = 4;
  const int64_t tiles = pool_tiles(pool), runs = (tiles + kTilesEach - 1) / kTilesEach;
  run_tasks(executor, count * runs, workers, [&](int worker, int64_t task) {
    const int64_t begin = task % runs * kTilesEach;
    for (int64_t tile = begin; tile < std::min(begin + kTilesEach, tiles); ++tile) {
      body(worker, first + task / runs, tile);
    }
  });
}

// Calls body(pointer to the winners' numbers).
template <class Body>
SURFCONV_INLINE void visit_winners(const Winners& winners, const Body& body) {
  winners.wide ? body(static_cast<uint32_t*>(winners.data))
               : body(static_cast<uint8_t*>(winners.data));
}
