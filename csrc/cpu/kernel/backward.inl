// The whole backward: slots and units become tasks, then the partials are summed and stored.
template <class T>
class Backward {
 public:
  Backward(const Conv& conv, const BackwardTensors& tensors, const Executor& executor)
      : conv_(conv),
        tensors_(tensors),
        executor_(executor),
        tiles_(conv, tensors, executor),
        input_(conv, tiles_.plan(), tensors.input),
        guide_(conv, tensors.guide),
        grad_input_(conv, tiles_.plan(), tensors.grad_input) {
    tiles_.pack_weights(executor);
    for (const Unit& unit : tiles_.units()) {
      weight_offset_.push_back(weight_elements_);
      weight_elements_ += tiles_.weight_elements(unit);
    }
  }

  void run() {
    // In passes even where nothing is copied: partial sums of the scale are bounded with them.
    const std::vector<Pass> passes =
        make_passes<T>(conv_, tensors_.scale, true, input_.row_elements());
    input_.reserve(passes);
    grad_input_.reserve(passes);
    if (tensors_.grad_scale.data != nullptr) {
      int64_t most = 0;
      for (const Pass& pass : passes) most = std::max(most, pass.images * scale_elements(pass));
      grad_scale_ = Buffer<T>(units() * most);
    }
    std::vector<std::vector<Slot>> slots;  // of each pass
    int64_t partials = 1;
    for (const Pass& pass : passes) {
      slots.push_back(
          make_slots<T>(conv_, tensors_.scale, pass, partials_wanted(), grad_input_.needed()));
      partials = std::max(partials, slots.back().back().partial + 1);
    }
    partials_ = Buffer<T>(partials * partial_elements());
    clear_partials(executor_, partials_.get(), partials, partial_elements());
    for (size_t i = 0; i < passes.size(); ++i) {
      const Pass& pass = passes[i];
      const auto same_image = [&](size_t other) {
        return other < passes.size() && passes[other].first_image == pass.first_image
                   ? &passes[other]
                   : nullptr;
      };
      const Pass* previous = i > 0 ? same_image(i - 1) : nullptr;
      input_.pack(pass, executor_);
      guide_.pack(pass.first_image, pass.images, executor_);
      grad_input_.begin(pass, previous, executor_);
      run_slots(pass, slots[i]);
      add_far(pass, slots[i]);
      grad_input_.end(pass, previous == nullptr, same_image(i + 1), executor_);
      if (tensors_.grad_scale.data != nullptr) store_scale(pass);
    }
    store_weights(partials);
  }

 private:
  static constexpr int64_t kTasks = 32;

  int64_t units() const { return static_cast<int64_t>(tiles_.units().size()); }
  int64_t scale_elements(const Pass& pass) const {
    return conv_.scale_components * pass.out.count() * conv_.x.out;
  }
  // Enough to keep threads busy, but partials of large weights no larger than input or output.
  int64_t partials_wanted() const {
    const int64_t map = conv_.batch * std::max(conv_.y.in * input_.row_elements(),
                                               conv_.y.out * conv_.x.out * conv_.out_channels);
    return std::max<int64_t>(
        1, std::min(kTasks / units(), map / std::max<int64_t>(1, weight_elements_)));
  }
  int64_t partial_elements() const { return weight_elements_ + tiles_.bias_elements(); }

  void run_slots(const Pass& pass, const std::vector<Slot>& slots) {
    const Plan& plan = tiles_.plan();
    const int64_t pixels = pass.images * pass.out.count() * conv_.x.out;
    const int workers = workers_for(executor_, static_cast<int64_t>(slots.size()) * units(),
                                    pixels * plan.taps * plan.channels * conv_.out_channels);
    Workspace memory(workers * tiles_.need());
    std::vector<typename BackwardTiles<T>::Scratch> scratch;
    scratch.reserve(static_cast<size_t>(workers));
    for (int i = 0; i < workers; ++i) scratch.push_back(tiles_.take(memory));
    for (int phase = 0; phase < kPhases; ++phase) {
      std::vector<const Slot*> chosen;
      for (const Slot& slot : slots) {
        if (slot.phase == phase) chosen.push_back(&slot);
      }
      if (chosen.empty()) break;
      const int64_t tasks = static_cast<int64_t>(chosen.size()) * units();
      run_tasks(executor_, tasks, workers, [&](int worker, int64_t task) {
        const Slot& slot = *chosen[static_cast<size_t>(task / units())];
        run_slot(scratch[static_cast<size_t>(worker)], pass, slot, task % units());
      });
    }
  }

  void run_slot(typename BackwardTiles<T>::Scratch& scratch, const Pass& pass, const Slot& slot,
                int64_t unit) {
    typename BackwardTiles<T>::Target target{};
    T* const partial = partials_.get() + slot.partial * partial_elements();
    if (tensors_.grad_weight.data != nullptr) {
      target.weight = partial + weight_offset_[static_cast<size_t>(unit)];
    }
    if (tensors_.grad_bias.data != nullptr) target.bias = partial + weight_elements_;
    target.first_pixel = pass.out.begin * conv_.x.out;
    target.pixels = pass.out.count() * conv_.x.out;
    for (int64_t i = slot.first_image; i < slot.first_image + slot.images; ++i) {
      if (grad_scale_) {
        target.scale = grad_scale_.get() + (unit * pass.images + i) * scale_elements(pass);
      }
      run_tiles(scratch, pass, slot, i, unit, target, false);
    }
  }

  // All tiles of an image of the pass; or only those that reach further than their slot.
  void run_tiles(typename BackwardTiles<T>::Scratch& scratch, const Pass& pass, const Slot& slot,
                 int64_t image, int64_t unit, typename BackwardTiles<T>::Target target,
                 bool only_further) {
    constexpr int64_t bytes = sizeof(T);
    const int64_t n = pass.first_image + image, end = slot.out.end * conv_.x.out;
    target.input = input_.image(pass, n);
    RowPlaces places;
    if (grad_input_.needed()) {
      target.grad_input = grad_input_.image(pass, n);
      places = {slot.reach.begin,
                slot.reach.end,
                grad_input_.row_elements() * bytes,
                byte_distance(target.grad_input, scratch.discard),
                only_further,
                slot.far};
    }
    const AxisSteps steps_y{input_.step_y() * bytes, conv_.x.in,
                            grad_input_.needed() ? &places : nullptr};
    const AxisSteps steps_x{input_.step_x() * bytes, 1};
    const int64_t most = only_further ? kTile : tiles_.most_pixels();
    for (int64_t begin = slot.out.begin * conv_.x.out; begin < end; begin += most) {
      const int64_t count = std::min(most, end - begin);
      if (only_further && !is_far(slot, n, begin, count)) continue;
      tiles_.run(scratch, tiles_.units()[static_cast<size_t>(unit)], target, guide_.image(n), n,
                 begin, static_cast<int>(count), steps_y, steps_x);
    }
  }

  bool is_far(const Slot& slot, int64_t n, int64_t first, int64_t count) const {
    const T largest = largest_scale<T>(conv_, tensors_.scale, n, first, count);
    const Range out{first / conv_.x.out, (first + count - 1) / conv_.x.out + 1};
    const Range rows = rows_around(conv_, out, spread_of(conv_, largest));
    return rows.begin < slot.reach.begin || rows.end > slot.reach.end;
  }

  // What tiles send beyond the reach of their slot: one slot after the other, by units in parallel.
  void add_far(const Pass& pass, const std::vector<Slot>& slots) {
    const auto far = [](const Slot& slot) { return slot.far; };
    if (!grad_input_.needed() || std::none_of(slots.begin(), slots.end(), far)) return;
    const int workers =
        workers_for(executor_, units(), units() * pass.out.count() * conv_.x.out * kBlock);
    Workspace memory(workers * tiles_.need());
    std::vector<typename BackwardTiles<T>::Scratch> scratch;
    for (int i = 0; i < workers; ++i) scratch.push_back(tiles_.take(memory));
    run_tasks(executor_, units(), workers, [&](int worker, int64_t unit) {
      for (const Slot& slot : slots) {
        if (!slot.far) continue;
        run_tiles(scratch[static_cast<size_t>(worker)], pass, slot, slot.first_image, unit, {},
                  true);
      }
    });
  }

  void store_scale(const Pass& pass) {
    const int64_t elements = scale_elements(pass), pixels = pass.out.count() * conv_.x.out;
    for (int64_t i = 0; i < pass.images; ++i) {
      T* sum = grad_scale_.get() + i * elements;
      for (int64_t unit = 1; unit < units(); ++unit) {
        const T* from = grad_scale_.get() + (unit * pass.images + i) * elements;
        for (int64_t p = 0; p < elements; ++p) sum[p] += from[p];
      }
      for (int64_t k = 0; k < conv_.scale_components; ++k) {
        store_pixels<T>(tensors_.grad_scale, pass.first_image + i, k, 1, conv_.x.out,
                        pass.out.begin * conv_.x.out, pixels, sum + k * pixels, 1);
      }
    }
  }

  void store_weights(int64_t count) {
    const T* const partials = partials_.get();
    add_partials(executor_, partials_.get(), count, partial_elements());
    if (tensors_.grad_bias.data != nullptr) {
      visit_storage<T>(tensors_.grad_bias, [&](auto* to) {
        for (int64_t o = 0; o < conv_.out_channels; ++o) {
          narrow(partials[weight_elements_ + o], to + o * tensors_.grad_bias.c);
        }
      });
    }
    if (tensors_.grad_weight.data == nullptr) return;
    run_tasks(executor_, units(), workers_for(executor_, units(), weight_elements_),
              [&](int, int64_t unit) {
                const T* from = partials + weight_offset_[static_cast<size_t>(unit)];
                for (const ChannelBlock& block : tiles_.units()[static_cast<size_t>(unit)].blocks) {
                  tiles_.store_weights(block, from, tensors_.grad_weight);
                  from += tiles_.weight_elements(block);
                }
              });
  }

  const Conv& conv_;
  const BackwardTensors& tensors_;
  const Executor& executor_;
  BackwardTiles<T> tiles_;
  InputRows<T> input_;
  GuideRows<T> guide_;
  GradientRows<T> grad_input_;
  Buffer<T> grad_scale_;
  Buffer<T> partials_;  // [partial][weights, then bias]
  std::vector<int64_t> weight_offset_;
  int64_t weight_elements_ = 0;
};

template <class T>
void run_backward(const Conv& conv, const BackwardTensors& tensors, const Executor& executor) {
  if (is_pointwise(conv)) {
    PointwiseBackward<T>(conv, tensors, executor).run();
  } else {
    Backward<T>(conv, tensors, executor).run();
  }
}
