// Register-blocked product C[rows x width] (+)= A[rows x depth] * B[depth x width].
// Accumulators are named variables: arrays of vectors spill under g++ 12.
#define SURFCONV_ROWS(X) X(0) X(1) X(2) X(3) X(4) X(5) X(6) X(7) X(8) X(9) X(10) X(11)

// A[row, k] at a[row * lda + k], or with TransposedA at a[row + k * lda].
template <class T, int ROWS, int VECTORS, bool TransposedA>
SURFCONV_INLINE void gemm_block(int64_t depth, const T* __restrict a, int64_t lda,
                                const T* __restrict b, int64_t ldb, T* __restrict c, int64_t ldc,
                                const T* initial) {
  constexpr int L = kLanes<T>;
  using V = Vec<T, L>;
  const int64_t row_step = TransposedA ? 1 : lda;
  const int64_t depth_step = TransposedA ? lda : 1;
#define SURFCONV_LOAD(R)                                        \
  V left##R{}, right##R{};                                      \
  if constexpr (R < ROWS) {                                     \
    const T* from = initial != nullptr ? initial : c + R * ldc; \
    left##R = load<V>(from);                                    \
    if constexpr (VECTORS > 1) right##R = load<V>(from + L);    \
  }
  SURFCONV_ROWS(SURFCONV_LOAD)
  for (int64_t k = 0; k < depth; ++k) {
    const V b0 = load<V>(b);
    const V b1 = VECTORS > 1 ? load<V>(b + (VECTORS > 1 ? L : 0)) : V{};
#define SURFCONV_FMA(R)                                \
  if constexpr (R < ROWS) {                            \
    const T value = a[R * row_step];                   \
    left##R += value * b0;                             \
    if constexpr (VECTORS > 1) right##R += value * b1; \
  }
    SURFCONV_ROWS(SURFCONV_FMA)
    a += depth_step;
    b += ldb;
  }
#define SURFCONV_STORE(R)                                        \
  if constexpr (R < ROWS) {                                      \
    store(c + R * ldc, left##R);                                 \
    if constexpr (VECTORS > 1) store(c + R * ldc + L, right##R); \
  }
  SURFCONV_ROWS(SURFCONV_STORE)
#undef SURFCONV_LOAD
#undef SURFCONV_FMA
#undef SURFCONV_STORE
}

// Rows of A and C are padded to it, so that there is one block shape for each width.
constexpr int64_t kRowPad = 12;
template <class T>
SURFCONV_INLINE int64_t pad_width(int64_t width) {
  return round_up(width, kLanes<T>);
}

template <class T, bool TransposedA>
void gemm_panel(bool wide, int64_t rows, int64_t depth, const T* a, int64_t lda, const T* b,
                int64_t ldb, T* c, int64_t ldc, const T* initial) {
  constexpr int R = SURFCONV_GEMM_ROWS, S = SURFCONV_GEMM_NARROW_ROWS;
  static_assert(kRowPad % R == 0 && kRowPad % S == 0, "whole blocks only");
  const int64_t row_step = TransposedA ? 1 : lda;
  if (wide) {
    for (int64_t r = 0; r < rows; r += R) {
      gemm_block<T, R, 2, TransposedA>(depth, a + r * row_step, lda, b, ldb, c + r * ldc, ldc,
                                       initial);
    }
  } else {
    for (int64_t r = 0; r < rows; r += S) {
      gemm_block<T, S, 1, TransposedA>(depth, a + r * row_step, lda, b, ldb, c + r * ldc, ldc,
                                       initial);
    }
  }
}

// The panels of a matrix of `width` columns: pairs of vectors, then a single one where it is left.
// body(first column, columns, wide)
template <class T, class Body>
SURFCONV_INLINE void for_panels(int64_t width, const Body& body) {
  constexpr int64_t L = kLanes<T>;
  int64_t column = 0;
  for (; column + L < width; column += 2 * L) body(column, 2 * L, true);
  if (column < width) body(column, L, false);
}

// B packed panel after panel, each [depth][columns of the panel]; initial: a row of start values
// for all of C's rows, or null to add to C. rows is padded to kRowPad by the caller's buffers.
template <class T>
void gemm_packed(int64_t rows, int64_t width, int64_t depth, const T* a, int64_t lda,
                 const T* packed, T* c, int64_t ldc, const T* initial) {
  for_panels<T>(width, [&](int64_t column, int64_t columns, bool wide) {
    gemm_panel<T, false>(wide, rows, depth, a, lda, packed + column * depth, columns, c + column,
                         ldc, initial != nullptr ? initial + column : nullptr);
  });
}

// C[rows x width] += A^T * B with A [depth][lda] and B [depth][ldb] as they lie.
template <class T>
void gemm_transposed(int64_t rows, int64_t width, int64_t depth, const T* a, int64_t lda,
                     const T* b, int64_t ldb, T* c, int64_t ldc) {
  for_panels<T>(width, [&](int64_t column, int64_t, bool wide) {
    gemm_panel<T, true>(wide, rows, depth, a, lda, b + column, ldb, c + column, ldc, nullptr);
  });
}
