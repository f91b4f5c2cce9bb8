// Register-blocked product C[rows x width] (+)= A[rows x depth] * B[depth x width].
// Accumulators are named variables: arrays of vectors spill under g++ 12.
#define SURFCONV_ROWS(X) X(0) X(1) X(2) X(3) X(4) X(5) X(6) X(7) X(8) X(9) X(10) X(11)

// A[row, k] at a[row * lda + k], or with TransposedA at a[row + k * lda]. STEPS of the depth at
// once, so that where a row of A begins, which may not stay in a register, is read once for all of
// them.
template <class T, int ROWS, int VECTORS, int L, bool TransposedA, int STEPS>
SURFCONV_INLINE void gemm_block(int64_t depth, const T* __restrict a, int64_t lda,
                                const T* __restrict b, int64_t ldb, T* __restrict c, int64_t ldc,
                                const T* initial) {
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
  const auto advance = [&](auto steps) SURFCONV_INLINED {
    constexpr int N = decltype(steps)::value;
    V b0[N], b1[N];
#pragma GCC unroll 4
    for (int i = 0; i < N; ++i) {
      b0[i] = load<V>(b + i * ldb);
      if constexpr (VECTORS > 1) b1[i] = load<V>(b + i * ldb + L);
    }
#define SURFCONV_FMA(R)                                     \
  if constexpr (R < ROWS) {                                 \
    const T* row = a + R * row_step;                        \
    _Pragma("GCC unroll 4") for (int i = 0; i < N; ++i) {   \
      const T value = row[i * depth_step];                  \
      left##R += value * b0[i];                             \
      if constexpr (VECTORS > 1) right##R += value * b1[i]; \
    }                                                       \
  }
    SURFCONV_ROWS(SURFCONV_FMA)
    a += N * depth_step;
    b += N * ldb;
  };
  int64_t k = 0;
  for (; k + STEPS <= depth; k += STEPS) advance(std::integral_constant<int, STEPS>{});
  if constexpr (STEPS > 1) {
    for (; k < depth; ++k) advance(std::integral_constant<int, 1>{});
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

constexpr int kRowBlock = 12;  // rows of the largest block
static_assert(kRowPad % SURFCONV_GEMM_ROWS == 0 && kRowBlock % kRowPad == 0, "whole blocks only");

// C's columns are cut into panels of two vectors, and what is left into one of two vectors, one, or
// half a one: the narrowest that holds it.
template <class T>
constexpr int kHalfLanes = kLanes<T> >= 8 ? kLanes<T> / 2 : kLanes<T>;
template <class T>
SURFCONV_INLINE int64_t panel_width(int64_t columns_left) {
  constexpr int64_t L = kLanes<T>, H = kHalfLanes<T>;
  return columns_left > L ? 2 * L : (columns_left > H ? L : H);
}
template <class T>
SURFCONV_INLINE int64_t pad_width(int64_t width) {
  const int64_t rest = width % (2 * kLanes<T>);
  return width - rest + (rest > 0 ? panel_width<T>(rest) : 0);
}

// body(first column, columns)
template <class T, class Body>
SURFCONV_INLINE void for_panels(int64_t width, const Body& body) {
  for (int64_t column = 0; column < width;) {
    const int64_t columns = panel_width<T>(width - column);
    body(column, columns);
    column += columns;
  }
}

// MOST: rows of a block at most; `rows` is a multiple of UNIT.
template <class T, bool TransposedA, int MOST, int UNIT = MOST>
void gemm_panel(int64_t columns, int64_t rows, int64_t depth, const T* a, int64_t lda, const T* b,
                int64_t ldb, T* c, int64_t ldc, const T* initial) {
  constexpr int L = kLanes<T>, H = kHalfLanes<T>;
  constexpr int R = std::min(MOST, SURFCONV_GEMM_ROWS);
  constexpr int S = std::min(MOST, SURFCONV_GEMM_NARROW_ROWS);
  static_assert(UNIT % R == 0 && MOST % UNIT == 0 && MOST % S == 0, "whole blocks only");
  const int64_t row_step = TransposedA ? 1 : lda;
  const auto blocks = [&](auto block_rows, auto vectors, auto lanes) {
    constexpr int N = decltype(block_rows)::value, VECTORS = decltype(vectors)::value;
    constexpr int STEPS = VECTORS == 1 && !TransposedA ? SURFCONV_GEMM_NARROW_STEPS : 1;
    const auto multiply = [&](auto some, int64_t r) SURFCONV_INLINED {
      gemm_block<T, decltype(some)::value, VECTORS, decltype(lanes)::value, TransposedA, STEPS>(
          depth, a + r * row_step, lda, b, ldb, c + r * ldc, ldc, initial);
    };
    int64_t r = 0;
    for (; r + N <= rows; r += N) multiply(block_rows, r);
    if constexpr (UNIT % N != 0) {
      for (; r < rows; r += UNIT) multiply(std::integral_constant<int, UNIT>{}, r);
    }
  };
  using One = std::integral_constant<int, 1>;
  if (columns == 2 * L) {
    blocks(std::integral_constant<int, R>{}, std::integral_constant<int, 2>{},
           std::integral_constant<int, L>{});
  } else if (columns == L) {
    blocks(std::integral_constant<int, S>{}, One{}, std::integral_constant<int, L>{});
  } else {
    blocks(std::integral_constant<int, MOST>{}, One{}, std::integral_constant<int, H>{});
  }
}

// Rows of a product, a multiple of kRowPad of them, that need a part of it.
struct GemmPart {
  Range rows;
  Range depth;    // where A is not zero
  Range columns;  // that anybody reads
};

// B packed panel after panel, each [depth][columns of the panel]; initial: a row of start values
// for all of C's rows, or null to add to C.
template <class T>
void gemm_packed(const GemmPart& part, int64_t width, int64_t depth, const T* a, int64_t lda,
                 const T* packed, T* c, int64_t ldc, const T* initial) {
  a += part.rows.begin * lda + part.depth.begin;
  c += part.rows.begin * ldc;
  for_panels<T>(width, [&](int64_t column, int64_t columns) {
    if (column >= part.columns.end || column + columns <= part.columns.begin) return;
    gemm_panel<T, false, kRowBlock, kRowPad>(columns, part.rows.count(), part.depth.count(), a, lda,
                                             packed + column * depth + part.depth.begin * columns,
                                             columns, c + column, ldc,
                                             initial != nullptr ? initial + column : nullptr);
  });
}

// All of the product; rows is padded to kRowPad by the caller's buffers.
template <class T>
void gemm_packed(int64_t rows, int64_t width, int64_t depth, const T* a, int64_t lda,
                 const T* packed, T* c, int64_t ldc, const T* initial) {
  const GemmPart whole{{0, rows}, {0, depth}, {0, width}};
  gemm_packed<T>(whole, width, depth, a, lda, packed, c, ldc, initial);
}

// C[rows x width] += A^T * B with A [depth][lda] and B [depth][ldb] as they lie; MOST divides rows.
template <class T, int MOST>
void gemm_transposed(int64_t rows, int64_t width, int64_t depth, const T* a, int64_t lda,
                     const T* b, int64_t ldb, T* c, int64_t ldc) {
  for_panels<T>(width, [&](int64_t column, int64_t columns) {
    gemm_panel<T, true, MOST>(columns, rows, depth, a, lda, b + column, ldb, c + column, ldc,
                              nullptr);
  });
}
