// The contraction where each group has one input channel: element by element over channels. `rows`
// is the gathered matrix of a tile, [kTile][ld] with the taps of a pixel one after the other;
// weights are packed [tap][multiplier][row].
struct DepthwiseBlock {
  int64_t multiplier;
  int64_t channels;      // of the block, whole quads
  int64_t taps;          // gathered in rows
  int64_t weight_row;    // channels in a row of packed weights
  int64_t weight_start;  // of the block's first tap and channel
};

// out[m][j][c] += rows[m][t][c] * weight[t][j][c]; out_row apart for j, ld_out for m.
template <class T>
void depthwise_multiply(const DepthwiseBlock& block, int count, const T* rows, int64_t ld,
                        const T* weights, T* out, int64_t ld_out, int64_t out_row) {
  for (int m = 0; m < count; ++m) {
    for (int64_t t = 0; t < block.taps; ++t) {
      const T* row = rows + m * ld + t * block.channels;
      for (int64_t j = 0; j < block.multiplier; ++j) {
        const T* weight =
            weights + block.weight_start + (t * block.multiplier + j) * block.weight_row;
        T* to = out + m * ld_out + j * out_row;
        for_channels<T>(block.channels, [&](int64_t c, auto lanes) SURFCONV_INLINED {
          using V = Vec<T, decltype(lanes)::lanes>;
          store(to + c, V(load<V>(to + c) + load<V>(row + c) * load<V>(weight + c)));
        });
      }
    }
  }
}

// rows[m][t][c] = sum over j of gradient[m][j][c] * weight[t][j][c]
template <class T>
void depthwise_matrix_gradient(const DepthwiseBlock& block, int count, const T* gradient,
                               int64_t ld_gradient, int64_t gradient_row, const T* weights, T* rows,
                               int64_t ld) {
  for (int m = 0; m < count; ++m) {
    for (int64_t t = 0; t < block.taps; ++t) {
      const T* weight = weights + block.weight_start + t * block.multiplier * block.weight_row;
      const T* from = gradient + m * ld_gradient;
      T* row = rows + m * ld + t * block.channels;
      for_channels<T>(block.channels, [&](int64_t c, auto lanes) SURFCONV_INLINED {
        using V = Vec<T, decltype(lanes)::lanes>;
        V sum{};
        for (int64_t j = 0; j < block.multiplier; ++j) {
          sum += load<V>(from + j * gradient_row + c) * load<V>(weight + j * block.weight_row + c);
        }
        store(row + c, sum);
      });
    }
  }
}

// partial[t][j][c] += sum over m of rows[m][t][c] * gradient[m][j][c]
template <class T>
void depthwise_weight_gradient(const DepthwiseBlock& block, int count, const T* rows, int64_t ld,
                               const T* gradient, int64_t ld_gradient, int64_t gradient_row,
                               T* partial) {
  for (int m = 0; m < count; ++m) {
    for (int64_t t = 0; t < block.taps; ++t) {
      const T* row = rows + m * ld + t * block.channels;
      for (int64_t j = 0; j < block.multiplier; ++j) {
        const T* from = gradient + m * ld_gradient + j * gradient_row;
        T* to = partial + (t * block.multiplier + j) * block.channels;
        for_channels<T>(block.channels, [&](int64_t c, auto lanes) SURFCONV_INLINED {
          using V = Vec<T, decltype(lanes)::lanes>;
          store(to + c, V(load<V>(to + c) + load<V>(row + c) * load<V>(from + c)));
        });
      }
    }
  }
}
