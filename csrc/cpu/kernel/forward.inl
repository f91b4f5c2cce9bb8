// Forward: for each few tiles of output pixels the corners once, then for each block of taps and
// channels a gathered matrix that stays in cache and its product with the packed weights.

// Outputs of some tiles that are one task.
struct Outputs {
  Range groups;
  Range channels;  // of each group
};

template <class T>
class Forward {
 public:
  Forward(const Conv& conv, const ForwardTensors& tensors, const Executor& executor)
      : conv_(conv),
        tensors_(tensors),
        executor_(executor),
        plan_(conv),
        blocks_(channel_blocks(plan_, kBlock)),
        taps_(taps_at_once(conv, std::min(kBlock, to_quads(plan_.channels)))),
        few_(few_of<T>(plan_, taps_)),
        width_(few_             ? few_.outputs
               : plan_.lanewise ? plan_.multiplier * plan_.row
                                : pad_width<T>(plan_.outputs)),
        ld_rows_(round_up(taps_ * std::min(kBlock, to_quads(plan_.channels)), 16) + 16),
        most_tiles_(plan_.lanewise || few_
                        ? 1
                        : Tiles<T>::at_once(conv, taps_, ld_rows_, executor.cache, kMostTiles)),
        packs_panels_(!plan_.lanewise && !few_ && plan_.groups == 1 && conv.batch == 1 &&
                      conv.y.out * conv.x.out <= most_tiles_ * kTile),
        input_(conv, plan_, tensors.input),
        guide_(conv, tensors.guide),
        fused_(plan_.lanewise && plan_.mix == 1 && plan_.multiplier == 1),
        writes_rows_((fused_ ? plan_.row == conv.out_channels
                             : !plan_.lanewise && plan_.outputs == width_) &&
                     tensors.output.dtype == kComputeDType<T> && tensors.output.c == 1 &&
                     tensors.output.y == tensors.output.x * conv.x.out),
        unseen_(static_cast<size_t>(plan_.row + kLanes<T>), T(0)),
        weights_(conv, plan_, width_) {
    weights_.set_initial(tensors.bias);
    if (plan_.lanewise) {
      weights_.take(pack_lanewise<T, false>(conv, plan_, tensors.weight));
    } else if (few_) {
      weights_.take(pack_few<T>(few_, conv, plan_, tensors.weight));
    } else if (!packs_panels_) {
      weights_.pack(tensors.weight, blocks_, taps_, executor);
    }
  }

  void run() {
    const std::vector<Pass> passes =
        make_passes<T>(conv_, tensors_.scale, input_.packed(), input_.row_elements());
    input_.reserve(passes);
    const int64_t pixels = conv_.y.out * conv_.x.out;
    const int workers =
        workers_for(executor_, conv_.batch * tiles_of(pixels) * pieces(),
                    conv_.batch * pixels * plan_.taps * plan_.channels * conv_.out_channels);
    const int64_t most_pixels = most_tiles_ * kTile;
    const int64_t need =
        Tiles<T>::need(conv_, taps_, most_tiles_) + Workspace::need<T>(most_pixels * ld_rows_) +
        Workspace::need<T>(most_pixels * plan_.groups * width_) +
        Workspace::need<T>(panel_elements()) + (fused_ ? LaneScratch<T>::need(conv_) : 0);
    Workspace memory(workers * need);
    std::vector<Scratch> scratch;
    scratch.reserve(static_cast<size_t>(workers));
    for (int i = 0; i < workers; ++i) {
      scratch.push_back({Tiles<T>(conv_, taps_, most_tiles_, memory),
                         memory.take<T>(most_pixels * ld_rows_),
                         memory.take<T>(most_pixels * plan_.groups * width_),
                         memory.take<T>(panel_elements()),
                         {}});
      if (fused_) scratch.back().lanes.take(conv_, memory);
    }
    for (const Pass& pass : passes) {
      input_.pack(pass, executor_);
      guide_.pack(pass.first_image, pass.images, executor_);
      run_pass(pass, scratch, workers);
    }
  }

 private:
  static constexpr int64_t kMostTiles = 4;  // more gained nothing, however large the weights

  int64_t panel_elements() const { return packs_panels_ ? ld_rows_ * 2 * kLanes<T> : 0; }

  struct Scratch {
    Tiles<T> tiles;
    T* rows;   // gathered matrix [pixels of the tiles][ld_rows]
    T* out;    // [pixels of the tiles][groups * width]
    T* panel;  // of weights, where a product packs its own
    LaneScratch<T> lanes;
  };

  void run_pass(const Pass& pass, std::vector<Scratch>& scratch, int workers) {
    const int64_t first = pass.out.begin * conv_.x.out, pixels = pass.out.count() * conv_.x.out;
    const Shares shares(pass.images, pixels, most_tiles_, pieces(), piece(), workers,
                        packs_panels_ ? 0.5 : 1.0 / 16);
    const int64_t tiles = tiles_of(pixels), runs = shares.runs();
    run_tasks(executor_, pass.images * runs * shares.count(), workers,
              [&](int worker, int64_t task) {
                const int64_t of_all = task / shares.count(), run = of_all % runs;
                const int64_t begin = tiles * run / runs * kTile;
                const int64_t end = std::min(tiles * (run + 1) / runs * kTile, pixels);
                multiply_tiles(scratch[static_cast<size_t>(worker)], pass,
                               pass.first_image + of_all / runs, first + begin,
                               static_cast<int>(end - begin),
                               outputs_of(shares.pieces(task % shares.count())));
              });
  }

  // What the outputs of a tile may be cut into, for products: groups, or panels of the only one.
  int64_t pieces() const {
    if (plan_.lanewise || few_) return 1;
    return plan_.groups > 1 ? plan_.groups : (plan_.outputs + piece() - 1) / piece();
  }
  int64_t piece() const { return plan_.groups > 1 ? plan_.outputs : 2 * kLanes<T>; }
  Outputs outputs_of(Range pieces) const {
    if (plan_.lanewise || few_ || plan_.groups > 1) return {pieces, {0, plan_.outputs}};
    return {{0, 1}, {pieces.begin * piece(), std::min(pieces.end * piece(), plan_.outputs)}};
  }

  void multiply_tiles(Scratch& scratch, const Pass& pass, int64_t n, int64_t begin, int count,
                      const Outputs& outputs) {
    constexpr int64_t bytes = sizeof(T);
    const char* base = input_.image(pass, n);
    const int64_t unseen = byte_distance(base, unseen_.data());
    const AxisSteps steps_y{input_.step_y() * bytes, conv_.x.in};
    const AxisSteps steps_x{input_.step_x() * bytes, 1};
    Tiles<T>& tiles = scratch.tiles;
    tiles.place(tensors_.scale, guide_.image(n), n, begin, count, steps_y, steps_x, false);
    Tile<T>& only = tiles.front();  // lanewise and with few outputs
    // Straight into the output where whole blocks of the product fit there.
    const bool direct = writes_rows_ && (fused_ || few_ || count % kRowPad == 0);
    const int64_t ld_out = direct ? tensors_.output.x : plan_.groups * width_;
    T* out = direct ? static_cast<T*>(tensors_.output.data) + n * tensors_.output.n +
                          begin * tensors_.output.x
                    : scratch.out;
    const int64_t group_step = direct ? plan_.outputs : width_;
    const auto fetch_ahead = [&](const Tile<T>& tile, int pixels, int64_t channel,
                                 int64_t channels) SURFCONV_INLINED {
      if (conv_.y.kernel == 1) return;
      const ImagePart part{base + channel * bytes, steps_y.read, steps_x.read, channels * bytes};
      const FetchAhead fetch(conv_.y, conv_.x, part);
      fetch(tile.rows().read + (conv_.y.kernel * 2 - 1) * kTile,
            tile.columns().read + conv_.x.kernel / 2 * 2 * kTile, pixels);
    };
    if (fused_) {
      fetch_ahead(only, count, 0, plan_.row);
      lane_forward(conv_, plan_, only, scratch.lanes, base, steps_y.read, steps_x.read,
                   weights_.data(), weights_.initial(), out, ld_out);
    }
    if (few_) {
      tiles.template fill_taps<false, Slopes::none>(0, plan_.taps, unseen, 0);
      few_forward(few_,
                  FewTile<T>{conv_, only, base, weights_.data(), weights_.initial(), out, ld_out});
    }
    const bool gathers = !few_ && (!fused_ || (only.guided() && only.has(Place::other)));
    if (plan_.lanewise && gathers) {
      for_gathered_runs(only, count, [&](const Run& run) {
        for (int m = run.begin; m < run.end; ++m) {
          std::memcpy(out + m * ld_out, weights_.initial(), static_cast<size_t>(width_ * bytes));
        }
      });
    }
    if (gathers && !plan_.lanewise) tiles.find_seen(false);
    if (!direct && !plan_.lanewise) {
      for_stored(outputs, [&](int64_t channel, int64_t channels, int64_t) SURFCONV_INLINED {
        fetch_to_store<T>(tensors_.output, n, channel, channels, conv_.x.out, begin, count);
      });
    }
    for (int64_t first_tap = 0; gathers && first_tap < plan_.taps; first_tap += taps_) {
      const int64_t taps = std::min(taps_, plan_.taps - first_tap);
      tiles.template fill_taps<false, Slopes::none>(first_tap, taps, unseen, 0);
      for (const ChannelBlock& block : blocks_) {
        if (!outputs.groups.has(block.group)) continue;
        const int64_t channel = block.group * to_quads(plan_.channels) + block.first;
        // What pads the channels costs the product nothing.
        const int64_t step = plan_.lanewise ? block.padded : block.count;
        const bool last_taps = first_tap + taps == plan_.taps;
        tiles.for_each([&](const Tile<T>& tile, int first, int pixels) {
          gather_tile(conv_, tile, first_tap, taps, base + channel * bytes, block.padded,
                      scratch.rows + first * ld_rows_, ld_rows_, step, fused_);
          const bool last = first + pixels == count;  // for the others the processor keeps up
          if (last && last_taps) fetch_ahead(tile, pixels, channel, block.padded);
        });
        if (plan_.lanewise) {
          multiply_lanes(scratch, block, first_tap, taps, count, out, ld_out);
        } else {
          const bool first = first_tap == 0 && block.first == 0;
          T* to = out + block.group * group_step;
          const T* initial = first ? weights_.initial() + block.group * width_ : nullptr;
          const auto multiply = [&](const T* weights, int64_t column, int64_t width,
                                    Range columns) {
            tiles.for_seen(first_tap, taps, [&](Range pixels, Range seen) {
              const GemmPart part{pixels, {seen.begin * step, seen.end * step}, columns};
              gemm_packed<T>(part, width, taps * step, scratch.rows, ld_rows_, weights, to + column,
                             ld_out, first ? initial + column : nullptr);
            });
          };
          if (!packs_panels_) {
            multiply(weights_.of(block, first_tap, taps), 0, plan_.outputs, outputs.channels);
            continue;
          }
          for_panels<T>(plan_.outputs, [&](int64_t column, int64_t columns) {
            if (!outputs.channels.has(column)) return;
            pack_panel(tensors_.weight, conv_.x.kernel, plan_, block, first_tap, taps, column,
                       columns, scratch.panel);
            multiply(scratch.panel, column, columns, {0, columns});
          });
        }
      }
    }
    if (direct) return;
    if (plan_.lanewise) {
      for (int64_t j = 0; j < plan_.multiplier; ++j) {
        store_lanes<T>(multiplied(tensors_.output, plan_, j), plan_.out, n, conv_.x.out, begin,
                       count, scratch.out + j * plan_.row, ld_out);
      }
    } else {
      for_stored(outputs, [&](int64_t channel, int64_t channels, int64_t at) SURFCONV_INLINED {
        store_pixels<T>(tensors_.output, n, channel, channels, conv_.x.out, begin, count,
                        scratch.out + at, ld_out);
      });
    }
  }

  // body(first channel of the output, channels, where the product has them), group by group
  template <class Body>
  SURFCONV_INLINE void for_stored(const Outputs& outputs, const Body& body) const {
    const Range channels = outputs.channels;
    for (int64_t g = outputs.groups.begin; g < outputs.groups.end; ++g) {
      body(g * plan_.outputs + channels.begin, channels.count(), g * width_ + channels.begin);
    }
  }

  // The pixels that are gathered, lanewise.
  template <class Body>
  void for_gathered_runs(const Tile<T>& tile, int count, const Body& body) const {
    if (!fused_) return body(Run{0, count, Place::other});
    tile.for_runs([&](const Run& run) {
      if (!lane_forward_does(tile, run)) body(run);
    });
  }

  void multiply_lanes(Scratch& scratch, const ChannelBlock& block, int64_t first_tap, int64_t taps,
                      int count, T* out, int64_t ld_out) const {
    const LaneBlock part = lane_block(plan_, block, first_tap, taps);
    with_mix<T>(plan_, [&](auto mix) {
      for_gathered_runs(scratch.tiles.front(), count, [&](const Run& run) {
        lane_multiply<decltype(mix)::value>(
            part, run.end - run.begin, scratch.rows + run.begin * ld_rows_, ld_rows_,
            weights_.data(), out + run.begin * ld_out + block.first, ld_out, plan_.row);
      });
    });
  }

  const Conv& conv_;
  const ForwardTensors& tensors_;
  const Executor& executor_;
  const Plan plan_;
  const std::vector<ChannelBlock> blocks_;
  const int64_t taps_;
  const Few few_;
  const int64_t width_, ld_rows_;
  const int most_tiles_;  // at once
  // Weights that are used once are packed panel after panel, each into cache just before its use.
  const bool packs_panels_;
  InputRows<T> input_;
  GuideRows<T> guide_;
  const bool fused_;  // lanewise without a gathered matrix, but where a guide hides corners
  const bool writes_rows_;
  std::vector<T> unseen_;  // what a corner outside the image reads
  ForwardWeights<T> weights_;
};

template <class T>
void run_forward(const Conv& conv, const ForwardTensors& tensors, const Executor& executor) {
  if (is_pointwise(conv)) {
    PointwiseForward<T>(conv, tensors, executor).run();
  } else {
    Forward<T>(conv, tensors, executor).run();
  }
}

void forward(const Conv& conv, const ForwardTensors& tensors, const Executor& executor) {
  if (tensors.input.dtype == DType::f64) {
    run_forward<double>(conv, tensors, executor);
  } else {
    run_forward<float>(conv, tensors, executor);
  }
}
