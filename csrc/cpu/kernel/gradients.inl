// The whole backward: slots and units become tasks, then the partials are summed and stored.
template <class T>
class Backward {
 public:
  Backward(const Conv& conv, const BackwardTensors& tensors, const Executor& executor)
      : conv_(conv),
        tensors_(tensors),
        executor_(executor),
        tile_(conv, tensors),
        images_(images_at_once(conv, tile_.plan())),
        slots_wanted_(std::max<int64_t>(1, kTasks / units())),
        input_(conv, tile_.plan(), tensors.input, images_),
        guide_(conv, tensors.guide, images_) {
    const Plan& plan = tile_.plan();
    tile_.pack_weights(executor);
    for (const Unit& unit : tile_.units()) {
      weight_offset_.push_back(weight_elements_);
      weight_elements_ += tile_.weight_elements(unit);
    }
    if (scatters()) {
      const View& to = tensors_.grad_input;
      const bool same = to.dtype == kComputeDType<T>;
      in_place_ = same && to.c == 1 && plan.row == conv.in_channels;
      if (!in_place_) grad_input_.reset(new T[static_cast<size_t>(images_ * image_elements())]);
    }
    if (tensors_.grad_scale.data != nullptr) {
      grad_scale_.reset(new T[static_cast<size_t>(units() * images_ * scale_elements())]);
    }
  }

  void run() {
    std::unique_ptr<T[]> partials;  // [slot][weights, then bias]
    int64_t slots_used = 0;
    for (int64_t first = 0; first < conv_.batch; first += images_) {
      const int64_t images = std::min(images_, conv_.batch - first);
      input_.pack(conv_, tile_.plan(), tensors_.input, first, images, executor_);
      guide_.pack(conv_, tensors_.guide, first, images);
      std::vector<Slot> slots =
          make_slots<T>(conv_, tensors_.scale, first, images, slots_wanted_, scatters());
      const int64_t count = static_cast<int64_t>(slots.size());
      if (count > slots_used) {
        std::unique_ptr<T[]> grown(new T[static_cast<size_t>(count * partial_elements())]());
        if (slots_used > 0) {
          std::copy(partials.get(), partials.get() + slots_used * partial_elements(), grown.get());
        }
        partials = std::move(grown);
        slots_used = count;
      }
      prepare_gradients(first, images, slots);
      run_slots(first, slots, partials.get());
      add_spill(first, slots);
      if (scatters() && !in_place_) unpack_gradients(first, images);
      if (tensors_.grad_scale.data != nullptr) store_scale(first, images);
    }
    store_weights(partials.get(), slots_used);
  }

 private:
  static constexpr int64_t kTasks = 32;

  int64_t units() const { return static_cast<int64_t>(tile_.units().size()); }
  bool scatters() const { return tensors_.grad_input.data != nullptr; }
  int64_t in_pixels() const { return conv_.y.in * conv_.x.in; }
  int64_t out_pixels() const { return conv_.y.out * conv_.x.out; }
  int64_t image_elements() const { return in_pixels() * tile_.plan().row; }
  int64_t row_elements() const { return conv_.x.in * tile_.plan().row; }
  int64_t scale_elements() const { return conv_.scale_components * out_pixels(); }
  int64_t partial_elements() const { return weight_elements_ + tile_.bias_elements(); }

  T* gradient_image(int64_t first, int64_t n) const {
    return in_place_ ? static_cast<T*>(tensors_.grad_input.data) + n * tensors_.grad_input.n
                     : grad_input_.get() + (n - first) * image_elements();
  }

  // Zeroes the gradient of these images and lays out the slots' spill rows.
  void prepare_gradients(int64_t first, int64_t images, std::vector<Slot>& slots) {
    if (!scatters()) return;
    const int64_t rows = images * conv_.y.in;
    run_tasks(executor_, rows, workers_for(executor_, rows, images * image_elements() / 4),
              [&](int, int64_t row) {
                T* to = gradient_image(first, first + row / conv_.y.in) +
                        row % conv_.y.in * row_elements();
                std::fill(to, to + row_elements(), T(0));
              });
    int64_t spilled = 0;
    for (const Slot& slot : slots) {
      spilled += slot.reach_end - slot.reach_begin - (slot.own_end - slot.own_begin);
    }
    spill_.reset(spilled > 0 ? new T[static_cast<size_t>(spilled * row_elements())]() : nullptr);
    T* next = spill_.get();
    for (Slot& slot : slots) {
      const T* image = gradient_image(first, first + slot.first_image);
      slot.row_offset.assign(static_cast<size_t>(conv_.y.in), 0);
      for (int64_t y = slot.reach_begin; y < slot.reach_end; ++y) {
        const bool own = y >= slot.own_begin && y < slot.own_end;
        const T* row = own ? image + y * row_elements() : next;
        slot.row_offset[static_cast<size_t>(y)] = byte_distance(image, row);
        if (!own) next += row_elements();
      }
    }
  }

  void run_slots(int64_t first, const std::vector<Slot>& slots, T* partials) {
    const Plan& plan = tile_.plan();
    const int64_t tasks = static_cast<int64_t>(slots.size()) * units();
    int64_t pixels = 0;
    for (const Slot& slot : slots) pixels += slot.images * (slot.end - slot.begin);
    const int workers =
        workers_for(executor_, tasks, pixels * plan.taps * plan.channels * conv_.out_channels);
    Workspace memory(workers * tile_.need());
    std::vector<typename BackwardTile<T>::Scratch> scratch;
    scratch.reserve(static_cast<size_t>(workers));
    for (int i = 0; i < workers; ++i) scratch.push_back(tile_.take(memory));
    run_tasks(executor_, tasks, workers, [&](int worker, int64_t task) {
      const int64_t unit = task % units(), index = task / units();
      run_slot(scratch[static_cast<size_t>(worker)], first, slots[static_cast<size_t>(index)], unit,
               partials + index * partial_elements());
    });
  }

  void run_slot(typename BackwardTile<T>::Scratch& scratch, int64_t first, const Slot& slot,
                int64_t unit, T* partial) {
    constexpr int64_t bytes = sizeof(T);
    const Plan& plan = tile_.plan();
    typename BackwardTile<T>::Target target{};
    if (tensors_.grad_weight.data != nullptr) {
      target.weight = partial + weight_offset_[static_cast<size_t>(unit)];
    }
    if (tensors_.grad_bias.data != nullptr) target.bias = partial + weight_elements_;
    const AxisSteps steps_y{input_.step_y(conv_, plan, tensors_.input) * bytes, 0, conv_.x.in,
                            scatters() ? slot.row_offset.data() : nullptr};
    const AxisSteps steps_x{input_.step_x(plan, tensors_.input) * bytes, plan.row * bytes, 1};
    for (int64_t i = slot.first_image; i < slot.first_image + slot.images; ++i) {
      const int64_t n = first + i;
      target.input =
          reinterpret_cast<const char*>(input_.image(conv_, plan, tensors_.input, first, n));
      if (scatters()) target.grad_input = reinterpret_cast<char*>(gradient_image(first, n));
      if (grad_scale_) target.scale = grad_scale_.get() + (unit * images_ + i) * scale_elements();
      const T* guide = guide_.image(conv_, tensors_.guide, first, n);
      for (int64_t begin = slot.begin; begin < slot.end; begin += kTile) {
        tile_.run(scratch, tile_.units()[static_cast<size_t>(unit)], target, guide, n, begin,
                  static_cast<int>(std::min<int64_t>(kTile, slot.end - begin)), steps_y, steps_x);
      }
    }
  }

  void add_spill(int64_t first, const std::vector<Slot>& slots) {
    if (!scatters() || !spill_) return;
    run_tasks(executor_, conv_.y.in, workers_for(executor_, conv_.y.in, image_elements()),
              [&](int, int64_t y) {
                for (const Slot& slot : slots) {
                  const bool own = y >= slot.own_begin && y < slot.own_end;
                  if (own || y < slot.reach_begin || y >= slot.reach_end) continue;
                  T* image = gradient_image(first, first + slot.first_image);
                  const T* from =
                      reinterpret_cast<const T*>(reinterpret_cast<const char*>(image) +
                                                 slot.row_offset[static_cast<size_t>(y)]);
                  T* to = image + y * row_elements();
                  for (int64_t i = 0; i < row_elements(); ++i) to[i] += from[i];
                }
              });
  }

  void unpack_gradients(int64_t first, int64_t images) {
    const Plan& plan = tile_.plan();
    const int64_t strip = std::max<int64_t>(1, 4096 / plan.row + 1) * 8;
    const int64_t strips = (in_pixels() + strip - 1) / strip, tasks = images * strips;
    run_tasks(executor_, tasks, workers_for(executor_, tasks, images * image_elements()),
              [&](int, int64_t task) {
                const int64_t n = first + task / strips, begin = task % strips * strip;
                const int64_t count = std::min(strip, in_pixels() - begin);
                for (int64_t g = 0; g < plan.groups; ++g) {
                  store_pixels<T>(
                      tensors_.grad_input, n, g * plan.channels, plan.channels, conv_.x.in, begin,
                      count,
                      gradient_image(first, n) + begin * plan.row + g * to_quads(plan.channels),
                      plan.row);
                }
              });
  }

  void store_scale(int64_t first, int64_t images) {
    for (int64_t i = 0; i < images; ++i) {
      T* sum = grad_scale_.get() + i * scale_elements();
      for (int64_t unit = 1; unit < units(); ++unit) {
        const T* from = grad_scale_.get() + (unit * images_ + i) * scale_elements();
        for (int64_t p = 0; p < scale_elements(); ++p) sum[p] += from[p];
      }
      for (int64_t k = 0; k < conv_.scale_components; ++k) {
        store_pixels<T>(tensors_.grad_scale, first + i, k, 1, conv_.x.out, 0, out_pixels(),
                        sum + k * out_pixels(), 1);
      }
    }
  }

  void store_weights(T* partials, int64_t slots) {
    const int64_t elements = partial_elements();
    std::vector<T> none;
    if (slots == 0) {
      none.assign(static_cast<size_t>(elements), T(0));
      partials = none.data();
    }
    constexpr int64_t kSpan = 4096;
    const int64_t tasks = (elements + kSpan - 1) / kSpan;
    run_tasks(executor_, tasks, workers_for(executor_, tasks, slots * elements / 4),
              [&](int, int64_t task) {
                const int64_t begin = task * kSpan, end = std::min(elements, begin + kSpan);
                for (int64_t slot = 1; slot < slots; ++slot) {
                  const T* from = partials + slot * elements;
                  for (int64_t i = begin; i < end; ++i) partials[i] += from[i];
                }
              });
    if (tensors_.grad_bias.data != nullptr) {
      visit_storage<T>(tensors_.grad_bias, [&](auto* to) {
        for (int64_t o = 0; o < conv_.out_channels; ++o) {
          narrow(partials[weight_elements_ + o], to + o * tensors_.grad_bias.c);
        }
      });
    }
    if (tensors_.grad_weight.data == nullptr) return;
    for (int64_t unit = 0; unit < units(); ++unit) {
      const T* from = partials + weight_offset_[static_cast<size_t>(unit)];
      for (const ChannelBlock& block : tile_.units()[static_cast<size_t>(unit)].blocks) {
        store_block(block, from);
        from += tile_.weight_elements(block);
      }
    }
  }

  void store_block(const ChannelBlock& block, const T* from) {
    const View& to = tensors_.grad_weight;
    visit_storage<T>(to, [&](auto* data) {
      tile_.for_weights(block, [&](int64_t output, int64_t channel, int64_t tap, int64_t index) {
        narrow(from[index], data + output * to.n + channel * to.c + tap / conv_.x.kernel * to.y +
                                tap % conv_.x.kernel * to.x);
      });
    });
  }

  const Conv& conv_;
  const BackwardTensors& tensors_;
  const Executor& executor_;
  BackwardTile<T> tile_;
  const int64_t images_, slots_wanted_;
  InputRows<T> input_;
  GuideRows<T> guide_;
  bool in_place_ = false;
  std::unique_ptr<T[]> grad_input_, grad_scale_, spill_;
  std::vector<int64_t> weight_offset_;
  int64_t weight_elements_ = 0;
};

void backward(const Conv& conv, const BackwardTensors& tensors, const Executor& executor) {
  if (tensors.input.dtype == DType::f64) {
    Backward<double>(conv, tensors, executor).run();
  } else {
    Backward<float>(conv, tensors, executor).run();
  }
}
