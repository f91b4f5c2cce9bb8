// Backward. A task owns a run of channels (a unit) of one slot: nobody else writes its part of
// grad_input, its partial grad_weight or its partial grad_scale; partials are summed in a fixed
// order. For each few tiles: the gradient of the gathered matrix by one product, a pass that
// scatters it, takes its dot product with the sample's slope and puts the gathered matrix in its
// place, and the transposed product of that into grad_weight.
template <class T>
class BackwardTiles {
 public:
  struct Scratch {
    Tiles<T> tiles;
    T* grad_out;  // [groups of the unit][most pixels][width]
    T* rows;      // [most pixels][ld_rows]: gradient of the gathered matrix, then the matrix
    T* copies;    // of both for their product
    T* dot;       // [2][most pixels][lanes]
    T* discard;   // [row of the image]: what corners that are not seen write
  };
  // What a task adds to.
  struct Target {
    const char* input;  // image, as bytes
    char* grad_input;   // image, as bytes; null: not needed
    T* weight;          // partials of the unit's blocks, one after the other
    T* bias;            // partial of all outputs, each added by its group's first block
    T* scale;           // partial of the pass' pixels of the image, [components][pixels]
    int64_t first_pixel, pixels;
  };

  BackwardTiles(const Conv& conv, const BackwardTensors& tensors, const Executor& executor)
      : conv_(conv),
        tensors_(tensors),
        plan_(conv),
        blocks_(channel_blocks(plan_, kBlock)),
        units_(make_units(blocks_, kBlock)),
        taps_(taps_at_once(conv, std::min(kBlock, to_quads(plan_.channels)))),
        swapped_(!plan_.lanewise &&
                 (plan_.outputs <= kSwappedRows ||
                  round_up(plan_.outputs, kSwappedRows) < pad_width<T>(plan_.outputs))),
        output_(conv, plan_, tensors.grad_output),
        width_(output_.width()),
        ld_rows_(
            pad_width<T>(round_up(taps_ * std::min(kBlock, to_quads(plan_.channels)), kRowBlock)) +
            16),
        most_tiles_(plan_.lanewise || taps_ < plan_.taps
                        ? 1
                        : Tiles<T>::at_once(conv, taps_, ld_rows_, executor.cache, kMostTiles)),
        copies_(!plan_.lanewise && !swapped_ && worth_copying(width_)),
        needs_matrix_(tensors.grad_input.data != nullptr || tensors.grad_scale.data != nullptr),
        zeros_(static_cast<size_t>(std::max(plan_.row, ld_rows_) + 2 * kLanes<T>), T(0)) {}

  const Plan& plan() const { return plan_; }
  // Of pixels that are handled at once.
  int64_t most_pixels() const { return most_tiles_ * kTile; }
  const std::vector<Unit>& units() const { return units_; }

  // Elements of the partial grad_weight of a block: rows (tap, channel), padded.
  int64_t weight_elements(const ChannelBlock& block) const {
    if (plan_.lanewise) return plan_.taps * plan_.weights_of_tap() * block.padded;
    if (swapped_) return round_up(plan_.outputs, kSwappedRows) * weight_row(block);
    // Each block of taps is padded by itself.
    return (plan_.taps * block.padded + kRowBlock) * width_;
  }
  int64_t weight_elements(const Unit& unit) const {
    int64_t total = 0;
    for (const ChannelBlock& block : unit.blocks) total += weight_elements(block);
    return total;
  }
  int64_t bias_elements() const { return conv_.out_channels; }

  // The sum of the partials of a block, where it belongs in the gradient of the weights.
  void store_weights(const ChannelBlock& block, const T* from, const View& to) const {
    if (plan_.lanewise) return store_lane_weights(block, from, to);
    const int64_t first = block.group * plan_.outputs;
    if (swapped_) {
      for (int64_t o = 0; o < plan_.outputs; ++o) {
        store_pixels<T>(to, first + o, block.first, block.count, conv_.x.kernel, 0, plan_.taps,
                        from + o * weight_row(block), block.padded);
      }
      return;
    }
    store_weight_rows(from, width_, conv_.x.kernel, plan_, block, to);
  }

  void pack_weights(const Executor& executor) {
    if (!needs_matrix_) return;
    if (plan_.lanewise) {
      weights_ = pack_lanewise<T, true>(conv_, plan_, tensors_.weight);
      return;
    }
    const int64_t tap_blocks = (plan_.taps + taps_ - 1) / taps_;
    const int64_t tasks = tap_blocks * static_cast<int64_t>(blocks_.size());
    stride_ = pad_width<T>(taps_ * std::min(kBlock, to_quads(plan_.channels))) * plan_.outputs;
    weights_ = Buffer<T>(tasks * stride_);
    run_tasks(
        executor, tasks, workers_for(executor, tasks, tasks * stride_), [&](int, int64_t task) {
          const int64_t first_tap = task % tap_blocks * taps_;
          pack_backward(tensors_.weight, conv_.x.kernel, plan_,
                        blocks_[static_cast<size_t>(task / tap_blocks)], first_tap,
                        std::min(taps_, plan_.taps - first_tap), weights_.get() + task * stride_);
        });
  }

  int64_t need() const {
    return Tiles<T>::need(conv_, taps_, most_tiles_) +
           Workspace::need<T>(most_groups() * most_pixels() * width_) +
           Workspace::need<T>(most_pixels() * ld_rows_) + Workspace::need<T>(copied()) +
           Workspace::need<T>(2 * most_pixels() * kLanes<T>) + Workspace::need<T>(discarded());
  }
  Scratch take(Workspace& memory) const {
    return {Tiles<T>(conv_, taps_, most_tiles_, memory),
            memory.take<T>(most_groups() * most_pixels() * width_),
            memory.take<T>(most_pixels() * ld_rows_),
            memory.take<T>(copied()),
            memory.take<T>(2 * most_pixels() * kLanes<T>),
            memory.take<T>(discarded())};
  }

  void run(Scratch& scratch, const Unit& unit, const Target& target, const GuideImage<T>& guide,
           int64_t n, int64_t begin, int count, const AxisSteps& steps_y,
           const AxisSteps& steps_x) const {
    Tiles<T>& tiles = scratch.tiles;
    tiles.place(tensors_.scale, guide, n, begin, count, steps_y, steps_x, true);
    if (!plan_.lanewise) tiles.find_seen(true);
    const Gradients gradients =
        output_.read(unit, n, begin, count, scratch.grad_out, most_pixels());
    if (target.bias != nullptr) output_.add_bias(gradients, unit, count, target.bias);
    T* const dot_x = scratch.dot + most_pixels() * kLanes<T>;
    std::fill(scratch.dot, scratch.dot + 2 * most_pixels() * kLanes<T>, T(0));
    const int64_t unseen_read = byte_distance(target.input, zeros_.data());
    const int64_t unseen_write = byte_distance(target.grad_input, scratch.discard);
    for (int64_t first_tap = 0; first_tap < plan_.taps; first_tap += taps_) {
      const int64_t taps = std::min(taps_, plan_.taps - first_tap);
      with_needs(target, [&](auto writes, auto slopes) {
        constexpr bool Writes = decltype(writes)::value;
        constexpr Slopes S = decltype(slopes)::value;
        tiles.template fill_taps<Writes, S>(first_tap, taps, unseen_read, unseen_write);
        T* weight = target.weight;
        for (const ChannelBlock& block : unit.blocks) {
          const int64_t channel = block.group * to_quads(plan_.channels) + block.first;
          if (needs_matrix_)
            matrix_gradient(scratch, gradients, unit, block, first_tap, taps, count);
          const char* read = target.input + channel * static_cast<int64_t>(sizeof(T));
          char* write = nullptr;
          if constexpr (Writes) {
            write = target.grad_input + channel * static_cast<int64_t>(sizeof(T));
          }
          tiles.for_each([&](const Tile<T>& tile, int first, int) {
            T* const rows = scratch.rows + first * ld_rows_;
            if constexpr (Writes || S != Slopes::none) {
              const ScatterTarget<T> to{read,
                                        write,
                                        scratch.dot + first * kLanes<T>,
                                        dot_x + first * kLanes<T>,
                                        zeros_.data(),
                                        scratch.discard};
              scatter_tile<Writes, S>(conv_, tile, first_tap, taps, to, block.padded, rows,
                                      ld_rows_);
            } else {
              gather_tile(conv_, tile, first_tap, taps, read, block.padded, rows, ld_rows_,
                          block.padded);
            }
          });
          if (weight != nullptr) {
            weight_gradient(scratch, gradients, block, first_tap, taps, count, weight);
            weight += weight_elements(block);
          }
        }
      });
    }
    if (target.scale != nullptr) {
      for (int64_t k = 0; k < conv_.scale_components; ++k) {
        for (int m = 0; m < count; ++m) {
          target.scale[k * target.pixels + begin - target.first_pixel + m] = sum_lanes<T>(
              load<Vec<T, kLanes<T>>>(scratch.dot + (k * most_pixels() + m) * kLanes<T>));
        }
      }
    }
  }

 private:
  using Gradients = typename OutputGradient<T>::Part;
  static constexpr int kSwappedRows = 4;
  // Only where all taps are gathered at a time: else how many there are would change the order in
  // which the gradient of the input is added to. Four were slower.
  static constexpr int64_t kMostTiles = 2;

  int64_t copied() const { return copies_ ? copied_elements(most_pixels(), width_) : 0; }

  int64_t discarded() const { return conv_.x.in * plan_.row + kLanes<T>; }

  int64_t weight_row(const ChannelBlock& block) const {
    return plan_.taps * block.padded + 2 * kLanes<T>;
  }

  void store_lane_weights(const ChannelBlock& block, const T* from, const View& to) const {
    visit_storage<T>(to, [&](auto* data) {
      for_lane_weights<false>(conv_, plan_, [&](int64_t o, int64_t c, int64_t k, int64_t lane) {
        const int64_t at = lane - block.first;
        if (at < 0 || at >= block.padded) return;
        auto* filter = data + o * to.n + c * to.c;
        for (int64_t t = 0; t < plan_.taps; ++t) {
          narrow(from[(t * plan_.weights_of_tap() + k) * block.padded + at],
                 filter + t / conv_.x.kernel * to.y + t % conv_.x.kernel * to.x);
        }
      });
    });
  }

  int64_t most_groups() const {
    int64_t most = 1;
    for (const Unit& unit : units_) {
      most = std::max(most, unit.blocks.back().group - unit.blocks.front().group + 1);
    }
    return most;
  }

  template <class Body>
  void with_needs(const Target& target, const Body& body) const {
    const auto by_slopes = [&](auto writes) {
      if (target.scale == nullptr) {
        body(writes, std::integral_constant<Slopes, Slopes::none>{});
      } else if (conv_.scale_components == 1) {
        body(writes, std::integral_constant<Slopes, Slopes::one>{});
      } else {
        body(writes, std::integral_constant<Slopes, Slopes::two>{});
      }
    };
    target.grad_input != nullptr ? by_slopes(std::true_type{}) : by_slopes(std::false_type{});
  }

  void matrix_gradient(Scratch& scratch, const Gradients& gradients, const Unit& unit,
                       const ChannelBlock& block, int64_t first_tap, int64_t taps,
                       int count) const {
    const T* from = gradients.of(block);
    const int64_t ld = gradients.ld;
    if (!plan_.lanewise) {
      const int64_t tap_blocks = (plan_.taps + taps_ - 1) / taps_;
      const int64_t index = (&block - unit.blocks.data()) + block_index(unit);
      const T* weights = weights_.get() + (index * tap_blocks + first_tap / taps_) * stride_;
      scratch.tiles.for_seen(first_tap, taps, [&](Range pixels, Range seen) {
        const GemmPart part{
            pixels, {0, plan_.outputs}, {seen.begin * block.padded, seen.end * block.padded}};
        gemm_packed<T>(part, taps * block.padded, plan_.outputs, from, ld, weights, scratch.rows,
                       ld_rows_, zeros_.data());
      });
      return;
    }
    with_mix<T>(plan_, [&](auto mix) {
      lane_matrix_gradient<decltype(mix)::value>(lane_block(plan_, block, first_tap, taps), count,
                                                 from, ld, kBlock, weights_.get(), scratch.rows,
                                                 ld_rows_);
    });
  }

  void weight_gradient(Scratch& scratch, const Gradients& gradients, const ChannelBlock& block,
                       int64_t first_tap, int64_t taps, int count, T* weight) const {
    const T* from = gradients.of(block);
    const int64_t ld = gradients.ld;
    if (!plan_.lanewise) {
      // What pads the matrix would else add whatever lies there.
      using Quad = Vec<T, kQuad>;
      const int64_t used = taps * block.padded;
      const int64_t padded = swapped_ ? pad_width<T>(used) : round_up(used, kRowBlock);
      for (int64_t column = used; column < padded; column += kQuad) {
        for (int m = 0; m < count; ++m) store(scratch.rows + m * ld_rows_ + column, Quad{});
      }
      if (swapped_) {
        gemm_transposed<T, kSwappedRows>(round_up(plan_.outputs, kSwappedRows), used, count, from,
                                         ld, scratch.rows, ld_rows_,
                                         weight + first_tap * block.padded, weight_row(block));
      } else {
        T* to = weight + first_tap * block.padded * width_;
        scratch.tiles.for_seen(first_tap, taps, [&](Range pixels, Range seen) {
          const int64_t row = seen.begin * block.padded / kRowBlock * kRowBlock;
          const int64_t end = round_up(seen.end * block.padded, kRowBlock), m = pixels.begin;
          if (seen.count() == 0) return;
          const int64_t depth = std::min<int64_t>(pixels.end, count) - m;
          const T* matrix = scratch.rows + m * ld_rows_ + row;
          if (copies_) {
            gemm_transposed_copied<T>(end - row, plan_.outputs, depth, matrix, ld_rows_,
                                      from + m * ld, ld, to + row * width_, width_, scratch.copies);
          } else {
            gemm_transposed<T, kRowBlock>(end - row, plan_.outputs, depth, matrix, ld_rows_,
                                          from + m * ld, ld, to + row * width_, width_);
          }
        });
      }
      return;
    }
    with_mix<T>(plan_, [&](auto mix) {
      lane_weight_gradient<decltype(mix)::value>(
          lane_block(plan_, block, first_tap, taps), count, scratch.rows, ld_rows_, from, ld,
          kBlock, weight + first_tap * plan_.weights_of_tap() * block.padded);
    });
  }

  int64_t block_index(const Unit& unit) const {
    int64_t index = 0;
    for (const Unit& earlier : units_) {
      if (&earlier == &unit) break;
      index += static_cast<int64_t>(earlier.blocks.size());
    }
    return index;
  }

  const Conv& conv_;
  const BackwardTensors& tensors_;
  const Plan plan_;
  const std::vector<ChannelBlock> blocks_;
  const std::vector<Unit> units_;
  const int64_t taps_;
  // Partial grad_weight as [output][tap, channel]: vectors full at few outputs.
  const bool swapped_;
  const OutputGradient<T> output_;
  const int64_t width_, ld_rows_;
  const int most_tiles_;  // at once
  const bool copies_;
  const bool needs_matrix_;
  const std::vector<T> zeros_;
  Buffer<T> weights_;
  int64_t stride_ = 0;
};
