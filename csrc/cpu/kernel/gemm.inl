// Register-blocked product C[rows x width] (+)= A[rows x depth] * B[depth x width].
// Accumulators are named variables: arrays of vectors spill under g++ 12.
#define SURFCONV_ROWS(X) X(0) X(1) X(2) X(3) X(4) X(5) X(6) X(7) X(8) X(9) X(10) X(11)

// Where the rows of a block are. Six pointers stay in registers; of twelve some would not, and g++
// makes them of any sum it can see through.
template <class T, int ROWS>
class BlockRows {
 public:
  BlockRows(T* first, int64_t ld)
      : fours_{first, first + 4 * ld, first + 8 * ld}, step_(ld), three_(3 * ld) {
#if defined(SURFCONV_X86)
    if (!kPlain) asm("" : "+r"(fours_[1]), "+r"(fours_[2]), "+r"(three_));
#endif
  }
  template <int R>
  SURFCONV_INLINE T* at() const {
    if (kPlain) return fours_[0] + R * step_;
    return fours_[R / 4] + (R % 4 == 3 ? three_ : R % 4 * step_);
  }
  SURFCONV_INLINE void advance(int64_t elements) {
    for (T*& four : fours_) four += elements;
  }

 private:
  static constexpr bool kPlain = ROWS <= 6;

  T* fours_[3];
  const int64_t step_;
  int64_t three_;
};
// Those of a matrix that lies transposed.
template <class T>
class BlockColumns {
 public:
  BlockColumns(T* first, int64_t) : first_(first) {}
  template <int R>
  SURFCONV_INLINE T* at() const {
    return first_ + R;
  }
  SURFCONV_INLINE void advance(int64_t elements) { first_ += elements; }

 private:
  T* first_;
};

// A[row, k] at a[row * lda + k], or with TransposedA at a[row + k * lda]; depth is not 0. FETCHED:
// bytes that each step of the depth fetches of what lies at `ahead`.
template <class T, int ROWS, int VECTORS, int L, bool TransposedA, int FETCHED>
SURFCONV_INLINE void gemm_block(int64_t depth, const T* __restrict a, int64_t lda,
                                const T* __restrict b, int64_t ldb, T* __restrict c, int64_t ldc,
                                const T* initial, uintptr_t ahead) {
  using V = Vec<T, L>;
  const int64_t depth_step = TransposedA ? lda : 1;
  std::conditional_t<TransposedA, BlockColumns<const T>, BlockRows<const T, ROWS>> rows(a, lda);
  const BlockRows<T, ROWS> out(c, ldc);
#define SURFCONV_LOAD(R)                                                 \
  V left##R{}, right##R{};                                               \
  if constexpr (R < ROWS) {                                              \
    const T* from = initial != nullptr ? initial : out.template at<R>(); \
    left##R = load<V>(from);                                             \
    if constexpr (VECTORS > 1) right##R = load<V>(from + L);             \
  }
  SURFCONV_ROWS(SURFCONV_LOAD)
  do {  // a loop that may be passed over has g++ move all sums where it ends
    const V b0 = load<V>(b), b1 = VECTORS > 1 ? load<V>(b + (VECTORS - 1) * L) : V{};
    if constexpr (FETCHED > 0) {
      prefetch(ahead);
      ahead += FETCHED;
    }
#define SURFCONV_FMA(R)                                \
  if constexpr (R < ROWS) {                            \
    const T value = *rows.template at<R>();            \
    left##R += value * b0;                             \
    if constexpr (VECTORS > 1) right##R += value * b1; \
  }
    SURFCONV_ROWS(SURFCONV_FMA)
    rows.advance(depth_step);
    b += ldb;
  } while (--depth > 0);
#define SURFCONV_STORE(R)                               \
  if constexpr (R < ROWS) {                             \
    T* to = out.template at<R>();                       \
    store(to, left##R);                                 \
    if constexpr (VECTORS > 1) store(to + L, right##R); \
  }
  SURFCONV_ROWS(SURFCONV_STORE)
#undef SURFCONV_LOAD
#undef SURFCONV_FMA
#undef SURFCONV_STORE
}

constexpr int kRowBlock = 12;  // rows of the largest block
static_assert(kRowBlock % SURFCONV_GEMM_ROWS == 0 && kRowBlock % kRowPad == 0, "whole blocks only");

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

// The product of nothing.
template <class T>
void fill_rows(int64_t columns, int64_t rows, T* c, int64_t ldc, const T* initial) {
  for (int64_t r = 0; initial != nullptr && r < rows; ++r) {
    std::copy_n(initial, columns, c + r * ldc);
  }
}

// MOST: rows of a block at most; `rows` is a multiple of UNIT. Fetches: each block of a tile brings
// its part of the panel `next` into the second-level cache, step by step: all of it at its start
// would hold it up.
template <class T, bool TransposedA, int MOST, int UNIT = MOST, bool Fetches = false>
void gemm_panel(int64_t columns, int64_t rows, int64_t depth, const T* a, int64_t lda, const T* b,
                int64_t ldb, T* c, int64_t ldc, const T* initial, const T* next = nullptr) {
  if (depth == 0) return fill_rows(columns, rows, c, ldc, initial);
  constexpr int L = kLanes<T>, H = kHalfLanes<T>;
  constexpr int R = std::min(MOST, SURFCONV_GEMM_ROWS);
  static_assert(MOST % UNIT == 0 && MOST % R == 0, "whole blocks only");
  const int64_t row_step = TransposedA ? 1 : lda;
  const auto blocks = [&](auto block_rows, auto vectors, auto lanes) {
    constexpr int N = decltype(block_rows)::value, VECTORS = decltype(vectors)::value;
    constexpr int64_t row_bytes = VECTORS * decltype(lanes)::value * sizeof(T);
    constexpr int FETCHED = Fetches && VECTORS > 1 ? row_bytes * N / kTile : 0;
    const auto multiply = [&](auto some, int64_t r) SURFCONV_INLINED {
      gemm_block<T, decltype(some)::value, VECTORS, decltype(lanes)::value, TransposedA, FETCHED>(
          depth, a + r * row_step, lda, b, ldb, c + r * ldc, ldc, initial,
          reinterpret_cast<uintptr_t>(next) + depth * (r % kTile / N * FETCHED));
    };
    int64_t r = 0;
    for (; r + N <= rows; r += N) multiply(block_rows, r);
    if constexpr (UNIT % N != 0) {
      for (; r < rows; r += UNIT) multiply(std::integral_constant<int, UNIT>{}, r);
    }
  };
  if (columns == 2 * L) {
    blocks(std::integral_constant<int, R>{}, Two{}, std::integral_constant<int, L>{});
  } else if (columns == L) {
    blocks(std::integral_constant<int, MOST>{}, One{}, std::integral_constant<int, L>{});
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
    const T* panel = packed + column * depth + part.depth.begin * columns;
    const bool last = column + columns >= width;
    gemm_panel<T, false, kRowBlock, kRowPad, SURFCONV_GEMM_FETCHES>(
        columns, part.rows.count(), part.depth.count(), a, lda, panel, columns, c + column, ldc,
        initial != nullptr ? initial + column : nullptr, last ? panel : panel + depth * columns);
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

// The same by way of copies whose rows lie side by side: rows a power of two apart share few sets
// of the first-level cache, and on an Intel Xeon long steps were slower whatever the distance.
constexpr int64_t kCopiedRows = 48;
static_assert(kCopiedRows % kRowBlock == 0, "whole blocks only");

// Elements of the copies.
inline int64_t copied_elements(int64_t depth, int64_t width) {
  return depth * (kCopiedRows + width);
}
// Whether a product of this width is worth them.
inline bool worth_copying(int64_t width) { return width >= 128; }

// width: of whole panels.
template <class T>
void gemm_transposed_copied(int64_t rows, int64_t width, int64_t depth, const T* a, int64_t lda,
                            const T* b, int64_t ldb, T* c, int64_t ldc, T* copies) {
  const auto copy = [&](const T* from, int64_t ld, int64_t columns, T* to, auto lanes) {
    using V = Vec<T, decltype(lanes)::value>;
    for (int64_t k = 0; k < depth; ++k, from += ld, to += columns) {
      for (int64_t i = 0; i < columns; i += decltype(lanes)::value) {
        store(to + i, load<V>(from + i));
      }
    }
  };
  constexpr std::integral_constant<int, kHalfLanes<T>> half{};
  T* const panels = copies + depth * kCopiedRows;
  for_panels<T>(width, [&](int64_t column, int64_t columns) {
    copy(b + column, ldb, columns, panels + column * depth, half);
  });
  for (int64_t r = 0; r < rows; r += kCopiedRows) {
    const int64_t count = std::min(kCopiedRows, rows - r);
    copy(a + r, lda, count, copies, std::integral_constant<int, 4>{});
    for_panels<T>(width, [&](int64_t column, int64_t columns) {
      gemm_panel<T, true, kRowBlock>(columns, count, depth, copies, count, panels + column * depth,
                                     columns, c + r * ldc + column, ldc, nullptr);
    });
  }
}
