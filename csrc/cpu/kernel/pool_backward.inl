// The pools' backward. The input's gradient is shared out by channels, the scale's by pixels: no
// two workers write to one place, and no sum depends on how many there are.

// Calls body(winners of whole quads of channels); numbers: room for them.
template <class W, class Body>
SURFCONV_INLINE void with_whole_quads(const W* row, int64_t channels, uint32_t* numbers,
                                      const Body& body) {
  if (channels % kQuad == 0) return body(row);
  // The tensor ends where its last channel does.
  std::copy_n(row, channels, numbers);
  std::fill(numbers + channels, numbers + to_quads(channels), 0);
  body(static_cast<const uint32_t*>(numbers));
}

// body(sampler, room for a row of winners, pixel of the tile, flat output pixel with n, first
// channel, channels, gradient of the pixel's channels, where the image's gradient lies)
template <Edges E, class T, class Body>
void pool_grad_input(const Pool& pool, const PoolBackwardTensors& tensors, const Executor& executor,
                     const Body& body) {
  const int64_t outputs = pool.y.out * pool.x.out, inputs = pool.y.in * pool.x.in;
  const View& target = tensors.grad_input;
  const bool direct = has_whole_pixels<T>(target, pool.channels);
  // Few blocks, because each looks for all the corners anew; enough for every worker, in whole
  // cache lines.
  constexpr int64_t kLeast = 64 / sizeof(T), kMostScratch = int64_t{8} << 20;
  int64_t block = round_up(pool.channels, kLeast);
  const int64_t wanted = executor.threads == 1 ? 1 : 2 * executor.threads;
  while (block > kLeast &&
         (pool.batch * ((pool.channels + block - 1) / block) < wanted ||
          (!direct && inputs * block * static_cast<int64_t>(sizeof(T)) > kMostScratch))) {
    block = round_up(block / 2, kLeast);
  }
  const int64_t blocks = (pool.channels + block - 1) / block;
  const int64_t padded = std::min(block, to_quads(pool.channels));
  const int64_t step_x = direct ? target.x : padded;
  const int64_t step_y = direct ? target.y : pool.x.in * padded;
  const int workers = workers_for(executor, pool.batch * blocks,
                                  pool.batch * outputs * pool.channels * pool.taps());
  const int64_t image_size = direct ? 0 : inputs * padded;
  const int64_t scratch = PoolSampler<E, Slopes::none, T>::need(pool) +
                          Workspace::need<T>(kTile * padded) + Workspace::need<T>(image_size) +
                          Workspace::need<uint32_t>(padded);
  PoolImages<T> images(pool, {}, tensors.guide);
  images.for_groups(executor, [&](int64_t first_image, int64_t count) {
    run_tasks(executor, count * blocks, workers, [&](int, int64_t task) {
      Workspace memory(scratch);
      PoolSampler<E, Slopes::none, T> sampler(pool, step_y, step_x, memory);
      uint32_t* numbers = memory.take<uint32_t>(padded);
      T* grads = memory.take<T>(kTile * padded);
      T* image = memory.take<T>(image_size);
      const int64_t n = first_image + task / blocks, first_channel = task % blocks * block;
      const int64_t channels = std::min(block, pool.channels - first_channel);
      if (direct) {
        image = static_cast<T*>(target.data) + n * target.n + first_channel;
        for (int64_t y = 0; y < pool.y.in; ++y) {
          const int64_t pixels = step_x == channels ? 1 : pool.x.in;
          const int64_t run = step_x == channels ? pool.x.in * channels : channels;
          for (int64_t x = 0; x < pixels; ++x) {
            std::fill_n(image + y * step_y + x * step_x, run, T(0));
          }
        }
      } else {
        std::fill_n(image, image_size, T(0));
      }
      for (int64_t first = 0; first < outputs; first += kTile) {
        const int64_t pixels = std::min<int64_t>(kTile, outputs - first);
        sampler.start_tile(tensors.scale, images.guide(n), n, first, pixels);
        load_pixels<T>(tensors.grad_output, n, first_channel, channels, pool.x.out, first, pixels,
                       grads, padded, padded);
        for (int64_t m = 0; m < pixels; ++m) {
          sampler.list(m);
          sampler.fetch_ahead(m, image, channels);
          body(sampler, numbers, m, n * outputs + first + m, first_channel, channels,
               grads + m * padded, image);
        }
      }
      if (!direct) {
        store_pixels<T>(target, n, first_channel, channels, pool.x.in, 0, inputs, image, padded);
      }
    });
  });
}

// body(sampler, room for a row of winners, image, pixel of the tile, flat output pixel with n,
// gradient of its channels) gives the gradient of (scale_y, scale_x).
template <Edges E, Slopes S, class T, class Body>
void pool_grad_scale(const Pool& pool, const PoolBackwardTensors& tensors, const Executor& executor,
                     const Body& body) {
  const int64_t outputs = pool.y.out * pool.x.out, padded = to_quads(pool.channels);
  PoolImages<T> images(pool, tensors.input, tensors.guide);
  const int workers = workers_for(executor, pool.batch * pool_tiles(pool),
                                  pool.batch * outputs * padded * pool.taps());
  const int64_t scratch = PoolSampler<E, S, T>::need(pool) + Workspace::need<T>(kTile * padded) +
                          Workspace::need<uint32_t>(padded);
  std::vector<Workspace> memory;
  std::vector<PoolSampler<E, S, T>> samplers;
  std::vector<T*> rows;
  std::vector<uint32_t*> numbers;
  for (int worker = 0; worker < workers; ++worker) {
    memory.emplace_back(scratch);
    samplers.emplace_back(pool, images.step_y(), images.step_x(), memory.back());
    rows.push_back(memory.back().template take<T>(kTile * padded));
    numbers.push_back(memory.back().template take<uint32_t>(padded));
  }
  images.for_groups(executor, [&](int64_t first_image, int64_t count) {
    for_pool_tiles(
        pool, executor, workers, first_image, count, [&](int worker, int64_t n, int64_t tile) {
          auto& sampler = samplers[static_cast<size_t>(worker)];
          T* grads = rows[static_cast<size_t>(worker)];
          const int64_t first = tile * kTile, pixels = std::min<int64_t>(kTile, outputs - first);
          sampler.start_tile(tensors.scale, images.guide(n), n, first, pixels);
          load_pixels<T>(tensors.grad_output, n, 0, pool.channels, pool.x.out, first, pixels, grads,
                         padded, padded);
          const T* image = images.image(n);
          T along_y[kTile], along_x[kTile];
          for (int64_t m = 0; m < pixels; ++m) {
            sampler.list(m);
            sampler.fetch_ahead(m, image, pool.channels);
            const ScaleGradient<T> grad = body(sampler, numbers[static_cast<size_t>(worker)], image,
                                               m, n * outputs + first + m, grads + m * padded);
            along_y[m] = grad.y;
            along_x[m] = grad.x;
          }
          store_pixels<T>(tensors.grad_scale, n, 0, 1, pool.x.out, first, pixels, along_y, 1);
          if (S == Slopes::two) {
            store_pixels<T>(tensors.grad_scale, n, 1, 1, pool.x.out, first, pixels, along_x, 1);
          }
        });
  });
}

// Calls body(which slopes, as a constant).
template <class Body>
void with_slopes(const Pool& pool, const Body& body) {
  if (pool.scale_components == 1) return body(std::integral_constant<Slopes, Slopes::one>{});
  body(std::integral_constant<Slopes, Slopes::two>{});
}

template <class T>
void max_pool_backward_of(const Pool& pool, const PoolBackwardTensors& tensors,
                          const Executor& executor) {
  const int64_t taps = pool.taps(), padded = to_quads(pool.channels);
  visit_winners(tensors.winners, [&](const auto* winners) {
    if (tensors.grad_input.data != nullptr) {
      pool_grad_input<Edges::clamp, T>(
          pool, tensors, executor,
          [&](const auto& sampler, uint32_t* numbers, int64_t, int64_t pixel, int64_t first,
              int64_t channels, const T* grad, T* image) {
            if (sampler.corners.count == 0) return;
            with_whole_quads(
                winners + pixel * pool.channels + first, channels, numbers, [&](const auto* row) {
                  scatter_winners(sampler.corners, taps, to_quads(channels), grad, row, image);
                });
          });
    }
    if (tensors.grad_scale.data == nullptr) return;
    with_slopes(pool, [&](auto slopes) {
      constexpr Slopes S = decltype(slopes)::value;
      pool_grad_scale<Edges::clamp, S, T>(
          pool, tensors, executor,
          [&](const auto& sampler, uint32_t* numbers, const T* image, int64_t, int64_t pixel,
              const T* grad) {
            ScaleGradient<T> along;
            with_whole_quads(
                winners + pixel * pool.channels, pool.channels, numbers, [&](const auto* row) {
                  along = slopes_of_winners<S>(sampler.corners, taps, padded, grad, row, image);
                });
            return along;
          });
    });
  });
}

template <class T>
void avg_pool_backward_of(const Pool& pool, const PoolBackwardTensors& tensors,
                          const Executor& executor) {
  const int64_t padded = to_quads(pool.channels);
  if (tensors.grad_input.data != nullptr) {
    pool_grad_input<Edges::zero, T>(pool, tensors, executor,
                                    [&](const auto& sampler, const auto&, int64_t m, int64_t,
                                        int64_t, int64_t channels, const T* grad, T* image) {
                                      scatter_average(sampler.corners, sampler.divisor(m),
                                                      to_quads(channels), grad, image);
                                    });
  }
  if (tensors.grad_scale.data == nullptr) return;
  const bool weighted = pool.divisor_override == 0 && !pool.count_include_pad;
  with_slopes(pool, [&](auto slopes) {
    constexpr Slopes S = decltype(slopes)::value;
    pool_grad_scale<Edges::zero, S, T>(
        pool, tensors, executor,
        [&](const auto& sampler, uint32_t*, const T* image, int64_t m, int64_t, const T* grad) {
          return slopes_of_average<S>(sampler.corners, weighted, sampler.divisor(m), padded, grad,
                                      image);
        });
  });
}

inline void max_pool_backward(const Pool& pool, const PoolBackwardTensors& tensors,
                              const Executor& executor) {
  tensors.input.dtype == DType::f64 ? max_pool_backward_of<double>(pool, tensors, executor)
                                    : max_pool_backward_of<float>(pool, tensors, executor);
}
inline void avg_pool_backward(const Pool& pool, const PoolBackwardTensors& tensors,
                              const Executor& executor) {
  tensors.input.dtype == DType::f64 ? avg_pool_backward_of<double>(pool, tensors, executor)
                                    : avg_pool_backward_of<float>(pool, tensors, executor);
}

extern const PoolKernels pool_kernels;
const PoolKernels pool_kernels = {max_pool_forward, max_pool_backward, avg_pool_forward,
                                  avg_pool_backward};
