// Backward of kernels of one tap. A task owns a run of tiles (a slot) of some channels (a unit):
// its part of grad_input, and a partial grad_weight that is added to the others in the slots'
// order.
template <class T>
class PointwiseBackward {
 public:
  PointwiseBackward(const Conv& conv, const BackwardTensors& tensors, const Executor& executor)
      : conv_(conv),
        tensors_(tensors),
        executor_(executor),
        plan_(conv),
        planar_(tensors.input.c != 1),
        units_(make_units(blocks_of(plan_), kBlock)),
        output_(conv, plan_, tensors.grad_output),
        grad_output_(onto_itself(conv), tensors.grad_output),
        input_(conv, tensors.input),
        grad_input_(conv, tensors.grad_input),
        width_(planar_ ? round_up(plan_.outputs, 4) : output_.width()),
        zeros_(static_cast<size_t>(std::max<int64_t>(conv.in_channels, kPlaneTile) + 2 * kLanes<T>),
               T(0)) {
    for (const Unit& unit : units_) {
      offsets_.push_back({packed_, partial_});
      for (const ChannelBlock& block : unit.blocks) {
        packed_ += packed_elements(block);
        partial_ += weight_elements(block);
      }
    }
  }

  void run() {
    clear();
    if (tensors_.grad_input.data != nullptr) pack();
    const int64_t pixels = conv_.y.out * conv_.x.out, tiles = (pixels + kTile - 1) / kTile;
    const int64_t total = conv_.batch * tiles, units = static_cast<int64_t>(units_.size());
    const int64_t slots =
        std::max<int64_t>(1, std::min(std::max<int64_t>(1, kTasks / units), total / kLeastTiles));
    const int64_t elements = partial_ + conv_.out_channels;
    partials_ = Buffer<T>(slots * elements);
    clear_partials(executor_, partials_.get(), slots, elements);
    const int workers = workers_for(executor_, slots * units,
                                    conv_.batch * pixels * plan_.channels * conv_.out_channels);
    Workspace memory(workers * need());
    std::vector<Scratch> scratch;
    for (int i = 0; i < workers; ++i) scratch.push_back(take(memory));
    run_tasks(executor_, slots * units, workers, [&](int worker, int64_t task) {
      const int64_t slot = task / units, unit = task % units;
      T* partial = partials_.get() + slot * elements;
      for (int64_t t = total * slot / slots; t < total * (slot + 1) / slots; ++t) {
        const int64_t begin = t % tiles * kTile;
        tile(scratch[static_cast<size_t>(worker)], unit, partial, t / tiles, begin,
             std::min<int64_t>(kTile, pixels - begin));
      }
    });
    add_partials(executor_, partials_.get(), slots, elements);
    store();
  }

 private:
  static constexpr int64_t kTasks = 32, kLeastTiles = 32;

  struct Offsets {
    int64_t filters, weight;
  };
  struct Scratch {
    T* grad_out;  // rows: [group][kTile][width]; planes: [width][kTile]
    T* in;        // [kTile][ld_in]
    T* grad_in;   // rows: [kTile][channels]; planes: [channels][kTile]
  };

  static std::vector<ChannelBlock> blocks_of(const Plan& plan) {
    std::vector<ChannelBlock> blocks = channel_blocks(plan, kBlock);
    for (ChannelBlock& block : blocks) block.padded = block.count;
    return blocks;
  }

  // Partial grad_weight: rows: [channels, padded][width]; planes: [width][channels, padded].
  int64_t weight_elements(const ChannelBlock& block) const {
    return (planar_ ? pad_width<T>(block.count) : round_up(block.count, 4)) * width_;
  }
  // Filters packed for grad_input.
  int64_t packed_elements(const ChannelBlock& block) const {
    return (planar_ ? round_up(block.count, 4) : pad_width<T>(block.count)) * plan_.outputs;
  }
  int64_t most_channels() const { return std::min(kBlock, plan_.channels); }
  // Room for rows and panels that are padded.
  int64_t ld_in() const { return pad_width<T>(round_up(most_channels(), 4)); }
  int64_t most_groups() const {
    int64_t most = 1;
    for (const Unit& unit : units_) {
      most = std::max(most, unit.blocks.back().group - unit.blocks.front().group + 1);
    }
    return most;
  }

  int64_t need() const {
    return Workspace::need<T>(most_groups() * kTile * width_) +
           2 * Workspace::need<T>(kTile * ld_in());
  }
  Scratch take(Workspace& memory) const {
    return {memory.take<T>(most_groups() * kTile * width_), memory.take<T>(kTile * ld_in()),
            memory.take<T>(kTile * ld_in())};
  }

  // What no output pixel reads has no gradient, nor has the scale.
  void clear() {
    const auto clear_image = [&](const View& view, int64_t channels, int64_t height,
                                 int64_t width) {
      if (view.data == nullptr) return;
      const int64_t rows = conv_.batch * height;
      run_tasks(executor_, rows, workers_for(executor_, rows, rows * width * channels / 4),
                [&](int, int64_t i) {
                  store_pixels<T>(view, i / height, 0, channels, width, i % height * width, width,
                                  zeros_.data(), 0);
                });
    };
    const auto covered = [](const Axis& axis) {
      return axis.stride == 1 && axis.centre_floor(0) <= 0 &&
             axis.centre_floor(axis.out - 1) >= axis.in - 1;
    };
    if (!covered(conv_.y) || !covered(conv_.x)) {
      clear_image(tensors_.grad_input, conv_.in_channels, conv_.y.in, conv_.x.in);
    }
    clear_image(tensors_.grad_scale, conv_.scale_components, conv_.y.out, conv_.x.out);
  }

  void pack() {
    filters_ = Buffer<T>(packed_);
    for_units(packed_, [&](const Unit& unit, Offsets offsets) {
      T* to = filters_.get() + offsets.filters;
      for (const ChannelBlock& block : unit.blocks) {
        if (planar_) {
          View filters = output_pixels(tensors_.weight);
          advance(filters, block.group * plan_.outputs * filters.x);
          pack_rows(filters, block.first, block.count, plan_.outputs, to);
        } else {
          pack_backward(tensors_.weight, 1, plan_, block, 0, 1, to);
        }
        to += packed_elements(block);
      }
    });
  }

  // body(unit, where its packed filters and its grad_weight begin)
  template <class Body>
  void for_units(int64_t work, const Body& body) const {
    const int64_t units = static_cast<int64_t>(units_.size());
    run_tasks(executor_, units, workers_for(executor_, units, work), [&](int, int64_t unit) {
      body(units_[static_cast<size_t>(unit)], offsets_[static_cast<size_t>(unit)]);
    });
  }

  void tile(Scratch& scratch, int64_t index, T* partial, int64_t n, int64_t begin,
            int64_t count) const {
    const T* filters = filters_.get() + offsets_[static_cast<size_t>(index)].filters;
    T* weight = partial + offsets_[static_cast<size_t>(index)].weight;
    const Unit& unit = units_[static_cast<size_t>(index)];
    T* bias = tensors_.grad_bias.data != nullptr ? partial + partial_ : nullptr;
    if (!planar_) {
      const auto gradients =
          output_.read(unit, n, begin, static_cast<int>(count), scratch.grad_out, kTile);
      if (bias != nullptr) output_.add_bias(gradients, unit, static_cast<int>(count), bias);
      for (const ChannelBlock& block : unit.blocks) {
        rows(scratch, block, n, begin, count, gradients.of(block), gradients.ld, filters, weight);
        filters += packed_elements(block);
        weight += weight_elements(block);
      }
      return;
    }
    int64_t group = -1, ld = 0;
    const T* planes_of_group = nullptr;
    for (const ChannelBlock& block : unit.blocks) {
      if (block.group != group) {
        group = block.group;
        planes_of_group = read_planes(scratch.grad_out, group, n, begin, count, ld);
      }
      if (bias != nullptr && block.first == 0) {
        add_planes(planes_of_group, ld, count, bias + group * plan_.outputs);
      }
      planes(scratch, block, n, begin, count, planes_of_group, ld, filters, weight);
      filters += packed_elements(block);
      weight += weight_elements(block);
    }
  }

  void rows(Scratch& scratch, const ChannelBlock& block, int64_t n, int64_t begin, int64_t count,
            const T* grad, int64_t ld_grad, const T* filters, T* weight) const {
    const int64_t channel = block.group * plan_.channels + block.first;
    if (tensors_.grad_input.data != nullptr) {
      T* to = count % kRowPad == 0 && pad_width<T>(block.count) == block.count
                  ? grad_input_.rows_in_place(n, channel, begin)
                  : nullptr;
      const bool direct = to != nullptr;
      const int64_t ld = direct ? grad_input_.pixel_step() : ld_in();
      if (!direct) to = scratch.grad_in;
      gemm_packed<T>(round_up(count, kRowPad), block.count, plan_.outputs, grad, ld_grad, filters,
                     to, ld, zeros_.data());
      if (!direct) grad_input_.store_rows(n, channel, block.count, begin, count, to, ld);
    }
    if (tensors_.grad_weight.data == nullptr) return;
    // Rows of the product are channels: in place only where they need no padding.
    const T* in = block.count % 4 == 0 ? input_.rows_in_place(n, channel, begin) : nullptr;
    int64_t ld = input_.pixel_step();
    if (in == nullptr) {
      ld = ld_in();
      input_.load_rows(n, channel, block.count, begin, count, scratch.in, ld);
      in = scratch.in;
    }
    const int64_t padded = round_up(block.count, 4), whole = padded / kRowBlock * kRowBlock;
    gemm_transposed<T, kRowBlock>(whole, plan_.outputs, count, in, ld, grad, ld_grad, weight,
                                  width_);
    gemm_transposed<T, 4>(padded - whole, plan_.outputs, count, in + whole, ld, grad, ld_grad,
                          weight + whole * width_, width_);
  }

  // The gradient's planes of a group, padded to whole blocks of rows.
  const T* read_planes(T* scratch, int64_t group, int64_t n, int64_t begin, int64_t count,
                       int64_t& ld) const {
    const int64_t first = group * plan_.outputs;
    if (count == kPlaneTile && plan_.outputs == width_ &&
        reads_in_place(plan_.outputs, most_channels())) {
      ld = grad_output_.plane_step();
      if (const T* planes = grad_output_.planes_in_place(n, first, begin)) return planes;
    }
    ld = kPlaneTile;
    grad_output_.load_planes(n, first, plan_.outputs, begin, count, scratch, ld);
    std::fill(scratch + plan_.outputs * ld, scratch + width_ * ld, T(0));
    return scratch;
  }

  void add_planes(const T* planes, int64_t ld, int64_t count, T* bias) const {
    using V = Vec<T, kLanes<T>>;
    for (int64_t o = 0; o < plan_.outputs; ++o) {
      const T* plane = planes + o * ld;
      V sums{};
      int64_t p = 0;
      for (; p + kLanes<T> <= count; p += kLanes<T>) sums += load<V>(plane + p);
      T total = sum_lanes<T>(sums);
      for (; p < count; ++p) total += plane[p];
      bias[o] += total;
    }
  }

  void planes(Scratch& scratch, const ChannelBlock& block, int64_t n, int64_t begin, int64_t count,
              const T* grad, int64_t ld_grad, const T* filters, T* weight) const {
    const int64_t channel = block.group * plan_.channels + block.first;
    if (tensors_.grad_input.data != nullptr) {
      const int64_t padded = round_up(block.count, 4);
      T* to = count == kPlaneTile && padded == block.count
                  ? grad_input_.planes_in_place(n, channel, begin)
                  : nullptr;
      const bool direct = to != nullptr;
      const int64_t ld = direct ? grad_input_.plane_step() : kPlaneTile;
      if (!direct) to = scratch.grad_in;
      multiply_planes<T>(padded, count, plan_.outputs, filters, grad, ld_grad, to, ld,
                         zeros_.data());
      if (!direct) grad_input_.store_planes(n, channel, block.count, begin, count, to, ld);
    }
    if (tensors_.grad_weight.data == nullptr) return;
    const int64_t ld = ld_in(), columns = pad_width<T>(block.count);
    input_.load_rows(n, channel, block.count, begin, count, scratch.in, ld);
    for (int64_t row = 0, step; row < width_; row += step) {
      step = row_block(width_ - row);
      for_panels<T>(block.count, [&](int64_t column, int64_t panel) {
        const auto multiply = [&](auto most) {
          gemm_panel<T, false, decltype(most)::value>(
              panel, step, count, grad + row * ld_grad, ld_grad, scratch.in + column, ld,
              weight + row * columns + column, columns, nullptr);
        };
        step == 4 ? multiply(std::integral_constant<int, 4>{})
                  : multiply(std::integral_constant<int, kRowBlock>{});
      });
    }
  }

  void store() const {
    const T* const sums = partials_.get();
    if (tensors_.grad_bias.data != nullptr) {
      visit_storage<T>(tensors_.grad_bias, [&](auto* to) {
        for (int64_t o = 0; o < conv_.out_channels; ++o) {
          narrow(sums[partial_ + o], to + o * tensors_.grad_bias.c);
        }
      });
    }
    if (tensors_.grad_weight.data == nullptr) return;
    for_units(partial_, [&](const Unit& unit, Offsets offsets) {
      const T* from = sums + offsets.weight;
      for (const ChannelBlock& block : unit.blocks) {
        const int64_t first = block.group * plan_.outputs;
        if (planar_) {
          store_pixels<T>(output_pixels(tensors_.grad_weight), 0, block.first, block.count,
                          conv_.out_channels, first, plan_.outputs, from,
                          pad_width<T>(block.count));
        } else {
          store_pixels<T>(input_pixels(tensors_.grad_weight), 0, first, plan_.outputs,
                          plan_.channels, block.first, block.count, from, width_);
        }
        from += weight_elements(block);
      }
    });
  }

  const Conv& conv_;
  const BackwardTensors& tensors_;
  const Executor& executor_;
  const Plan plan_;
  const bool planar_;
  const std::vector<Unit> units_;
  std::vector<Offsets> offsets_;  // of each unit
  const OutputGradient<T> output_;
  const CentrePixels<T> grad_output_, input_, grad_input_;
  const int64_t width_;  // outputs of a group, padded
  const std::vector<T> zeros_;
  int64_t partial_ = 0, packed_ = 0;
  Buffer<T> filters_, partials_;
};
