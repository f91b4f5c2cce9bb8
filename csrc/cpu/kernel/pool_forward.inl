// The pools' forward: one output pixel at a time, over all of its channels.

// Vectors at a time, so that one need not wait for the other.
constexpr int kMaxVectors = SURFCONV_VECTOR_BYTES == 64 ? 4 : 2;

// Each: corners of every tap, or 0. Later NaNs win over earlier ones, as in nn.
template <int Each, int Lanes, int Vectors, class T, class W>
SURFCONV_INLINE void max_of_taps(const T* image, const PoolCorners<T>& corners, int64_t taps,
                                 int32_t fallback, T* out, W* winners) {
  using V = Vec<T, Lanes>;
  using Mask = decltype(V{} > V{});
  using Number = std::conditional_t<sizeof(T) == 8, int64_t, int32_t>;
  V best[Vectors];
  Mask winner[Vectors];
  for (int i = 0; i < Vectors; ++i) {
    best[i] = broadcast<V>(-std::numeric_limits<T>::infinity());
    winner[i] = Mask{} + static_cast<Number>(fallback);
  }
  const int64_t step = corners.step;
  for (int64_t t = 0; t < taps; ++t) {
    const int32_t begin = Each != 0 ? static_cast<int32_t>(t) * Each : corners.first[t];
    const int32_t end = Each != 0 ? begin + Each : corners.first[t + 1];
    if (Each == 0 && !corners.has_tap(t)) continue;
    V value[Vectors] = {};
    if (Each != 0 || begin != end) {
#pragma GCC unroll 4
      for (int i = 0; i < Vectors; ++i) {
        value[i] = corners.weight[begin * step] *
                   load<V>(image + corners.offset[begin * step] + i * Lanes);
      }
    }
    for (int32_t q = begin + 1; q < end; ++q) {
#pragma GCC unroll 4
      for (int i = 0; i < Vectors; ++i) {
        value[i] +=
            corners.weight[q * step] * load<V>(image + corners.offset[q * step] + i * Lanes);
      }
    }
#pragma GCC unroll 4
    for (int i = 0; i < Vectors; ++i) {
      const Mask wins = (value[i] > best[i]) | (value[i] != value[i]);
      best[i] = wins ? value[i] : best[i];
      winner[i] = wins ? Mask{} + static_cast<Number>(t) : winner[i];
    }
  }
  for (int i = 0; i < Vectors; ++i) {
    store(out + i * Lanes, best[i]);
    store(winners + i * Lanes, __builtin_convertvector(winner[i], Vec<W, Lanes>));
  }
}

template <int Each, class T, class W>
void max_of_pixel(const T* image, const PoolCorners<T>& corners, int64_t taps, int32_t fallback,
                  int64_t channels, T* out, W* winners) {
  constexpr int lanes = kComparedLanes<T>, step = lanes * kMaxVectors;
  int64_t c = 0;
  for (; c + step <= channels; c += step) {
    max_of_taps<Each, lanes, kMaxVectors>(image + c, corners, taps, fallback, out + c, winners + c);
  }
  for (; c + lanes <= channels; c += lanes) {
    max_of_taps<Each, lanes, 1>(image + c, corners, taps, fallback, out + c, winners + c);
  }
  if constexpr (lanes > 4) {
    if (c < channels) {
      max_of_taps<Each, 4, 1>(image + c, corners, taps, fallback, out + c, winners + c);
    }
  }
}

template <int Lanes, int Vectors, class T>
SURFCONV_INLINE void sum_of_corners(const T* image, const PoolCorners<T>& corners, T divisor,
                                    T* out) {
  using V = Vec<T, Lanes>;
  V sum[Vectors] = {};
  for (int64_t q = 0; q < corners.count; ++q) {
    const T* pixel = image + corners.offset[q * corners.step];
    const T weight = corners.weight[q * corners.step];
#pragma GCC unroll 4
    for (int i = 0; i < Vectors; ++i) sum[i] += weight * load<V>(pixel + i * Lanes);
  }
#pragma GCC unroll 4
  for (int i = 0; i < Vectors; ++i) store(out + i * Lanes, V(sum[i] / divisor));
}

template <class T>
void average_of_pixel(const T* image, const PoolCorners<T>& corners, T divisor, int64_t channels,
                      T* out) {
  for_strips<T>(channels, [&](int64_t c, auto strip) SURFCONV_INLINED {
    using S = decltype(strip);
    sum_of_corners<S::lanes, S::vectors>(image + c, corners, divisor, out + c);
  });
}

// body(sampler, image, pixel of the tile, flat output pixel with n, where its channels go)
template <Edges E, class T, class Body>
void pool_forward(const Pool& pool, const PoolForwardTensors& tensors, const Executor& executor,
                  const Body& body) {
  const int64_t outputs = pool.y.out * pool.x.out, padded = to_quads(pool.channels);
  const View& output = tensors.output;
  const bool direct = has_whole_pixels<T>(output, pool.channels);
  PoolImages<T> images(pool, tensors.input, tensors.guide);
  const int workers = workers_for(executor, pool.batch * pool_tiles(pool),
                                  pool.batch * outputs * padded * pool.taps());
  const int64_t scratch =
      PoolSampler<E, Slopes::none, T>::need(pool) + Workspace::need<T>(kTile * padded);
  std::vector<Workspace> memory;
  std::vector<PoolSampler<E, Slopes::none, T>> samplers;
  std::vector<T*> stages;
  for (int worker = 0; worker < workers; ++worker) {
    memory.emplace_back(scratch);
    samplers.emplace_back(pool, images.step_y(), images.step_x(), memory.back());
    stages.push_back(memory.back().take<T>(kTile * padded));
  }
  images.for_groups(executor, [&](int64_t first_image, int64_t count) {
    for_pool_tiles(
        pool, executor, workers, first_image, count, [&](int worker, int64_t n, int64_t tile) {
          auto& sampler = samplers[static_cast<size_t>(worker)];
          const int64_t first = tile * kTile, pixels = std::min<int64_t>(kTile, outputs - first);
          sampler.start_tile(tensors.scale, images.guide(n), n, first, pixels);
          T* stage = stages[static_cast<size_t>(worker)];
          const T* image = images.image(n);
          for (int64_t m = 0; m < pixels; ++m) {
            const int64_t y = (first + m) / pool.x.out, x = (first + m) % pool.x.out;
            T* to = direct
                        ? static_cast<T*>(output.data) + n * output.n + y * output.y + x * output.x
                        : stage + m * padded;
            sampler.list(m);
            sampler.fetch_ahead(m, image, pool.channels);
            body(sampler, image, m, n * outputs + first + m, to);
          }
          if (!direct) {
            store_pixels<T>(output, n, 0, pool.channels, pool.x.out, first, pixels, stage, padded);
          }
        });
  });
}

template <class T>
void max_pool_of(const Pool& pool, const PoolForwardTensors& tensors, const Executor& executor) {
  const int64_t channels = pool.channels, padded = to_quads(channels), taps = pool.taps();
  visit_winners(tensors.winners, [&](auto* winners) {
    using W = std::remove_pointer_t<decltype(winners)>;
    pool_forward<Edges::clamp, T>(
        pool, tensors, executor,
        [&](const auto& sampler, const T* image, int64_t, int64_t pixel, T* to) {
          const PoolCorners<T>& corners = sampler.corners;
          W* row = winners + pixel * channels;
          int32_t fallback = 0;  // the first tap there is
          while (fallback < taps && !corners.has_tap(fallback)) ++fallback;
          if (fallback == taps) {
            std::fill_n(to, padded, T(0));
            std::fill_n(row, channels, static_cast<W>(taps));
            return;
          }
          const auto run = [&](W* numbers) {
            if (corners.each == 4) {
              max_of_pixel<4>(image, corners, taps, fallback, padded, to, numbers);
            } else if (corners.each == 1) {
              max_of_pixel<1>(image, corners, taps, fallback, padded, to, numbers);
            } else {
              max_of_pixel<0>(image, corners, taps, fallback, padded, to, numbers);
            }
          };
          if (padded == channels) return run(row);
          // The padding's winners have no place in the tensor.
          constexpr int64_t kMost = 1024;
          if (padded <= kMost) {
            W numbers[kMost];
            run(numbers);
            std::copy_n(numbers, channels, row);
          } else {
            std::vector<W> numbers(static_cast<size_t>(padded));
            run(numbers.data());
            std::copy_n(numbers.data(), channels, row);
          }
        });
  });
}

template <class T>
void avg_pool_of(const Pool& pool, const PoolForwardTensors& tensors, const Executor& executor) {
  const int64_t padded = to_quads(pool.channels);
  pool_forward<Edges::zero, T>(pool, tensors, executor,
                               [&](const auto& sampler, const T* image, int64_t m, int64_t, T* to) {
                                 const T divisor = sampler.divisor(m);
                                 if (divisor == 0) {
                                   std::fill_n(to, padded, T(0));
                                 } else {
                                   average_of_pixel(image, sampler.corners, divisor, padded, to);
                                 }
                               });
}

inline void max_pool_forward(const Pool& pool, const PoolForwardTensors& tensors,
                             const Executor& executor) {
  tensors.input.dtype == DType::f64 ? max_pool_of<double>(pool, tensors, executor)
                                    : max_pool_of<float>(pool, tensors, executor);
}
inline void avg_pool_forward(const Pool& pool, const PoolForwardTensors& tensors,
                             const Executor& executor) {
  tensors.input.dtype == DType::f64 ? avg_pool_of<double>(pool, tensors, executor)
                                    : avg_pool_of<float>(pool, tensors, executor);
}
