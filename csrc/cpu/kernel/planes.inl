// Channels that lie in planes: transposed into pixels and back, and fetched ahead, since there are
// more planes than streams that the processor follows to fetch them by itself.
#if defined(__clang__)
#define SURFCONV_SHUFFLE(T, N, a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
#define SURFCONV_SHUFFLE(T, N, a, b, ...) \
  __builtin_shuffle(a, b, Vec<std::conditional_t<sizeof(T) == 8, int64_t, int32_t>, N>{__VA_ARGS__})
#endif

template <class T>
SURFCONV_INLINE void transpose_4x4(const T* from, int64_t from_row, T* to, int64_t to_row) {
  using V = Vec<T, 4>;
  const V a = load<V>(from), b = load<V>(from + from_row);
  const V c = load<V>(from + 2 * from_row), d = load<V>(from + 3 * from_row);
  const V ab_lo = SURFCONV_SHUFFLE(T, 4, a, b, 0, 4, 1, 5);
  const V ab_hi = SURFCONV_SHUFFLE(T, 4, a, b, 2, 6, 3, 7);
  const V cd_lo = SURFCONV_SHUFFLE(T, 4, c, d, 0, 4, 1, 5);
  const V cd_hi = SURFCONV_SHUFFLE(T, 4, c, d, 2, 6, 3, 7);
  store(to, SURFCONV_SHUFFLE(T, 4, ab_lo, cd_lo, 0, 1, 4, 5));
  store(to + to_row, SURFCONV_SHUFFLE(T, 4, ab_lo, cd_lo, 2, 3, 6, 7));
  store(to + 2 * to_row, SURFCONV_SHUFFLE(T, 4, ab_hi, cd_hi, 0, 1, 4, 5));
  store(to + 3 * to_row, SURFCONV_SHUFFLE(T, 4, ab_hi, cd_hi, 2, 3, 6, 7));
}

SURFCONV_INLINE void transpose_8x8(const float* from, int64_t from_row, float* to, int64_t to_row) {
  using V = Vec<float, 8>;
  V r[8], s[8];
#pragma GCC unroll 8
  for (int i = 0; i < 8; ++i) r[i] = load<V>(from + i * from_row);
#pragma GCC unroll 4
  for (int i = 0; i < 8; i += 2) {
    s[i] = SURFCONV_SHUFFLE(float, 8, r[i], r[i + 1], 0, 8, 1, 9, 4, 12, 5, 13);
    s[i + 1] = SURFCONV_SHUFFLE(float, 8, r[i], r[i + 1], 2, 10, 3, 11, 6, 14, 7, 15);
  }
#pragma GCC unroll 2
  for (int i = 0; i < 8; i += 4) {
    r[i] = SURFCONV_SHUFFLE(float, 8, s[i], s[i + 2], 0, 1, 8, 9, 4, 5, 12, 13);
    r[i + 1] = SURFCONV_SHUFFLE(float, 8, s[i], s[i + 2], 2, 3, 10, 11, 6, 7, 14, 15);
    r[i + 2] = SURFCONV_SHUFFLE(float, 8, s[i + 1], s[i + 3], 0, 1, 8, 9, 4, 5, 12, 13);
    r[i + 3] = SURFCONV_SHUFFLE(float, 8, s[i + 1], s[i + 3], 2, 3, 10, 11, 6, 7, 14, 15);
  }
#pragma GCC unroll 4
  for (int i = 0; i < 4; ++i) {
    store(to + i * to_row, SURFCONV_SHUFFLE(float, 8, r[i], r[i + 4], 0, 1, 2, 3, 8, 9, 10, 11));
    store(to + (i + 4) * to_row,
          SURFCONV_SHUFFLE(float, 8, r[i], r[i + 4], 4, 5, 6, 7, 12, 13, 14, 15));
  }
}

// to[column * to_row + row] = from[row * from_row + column] in whole blocks of SIZE x SIZE from
// (row, column) on; returns where the blocks end.
template <int SIZE, class T>
int64_t transpose_blocks(const T* from, int64_t from_row, int64_t row, int64_t rows, int64_t column,
                         int64_t columns, T* to, int64_t to_row) {
  const int64_t end = row + (rows - row) / SIZE * SIZE;
  for (; column + SIZE <= columns; column += SIZE) {
    for (int64_t r = row; r < end; r += SIZE) {
      const T* block = from + r * from_row + column;
      if constexpr (SIZE == 8) {
        transpose_8x8(block, from_row, to + column * to_row + r, to_row);
      } else {
        transpose_4x4(block, from_row, to + column * to_row + r, to_row);
      }
    }
  }
  return end;
}

template <class T>
void transpose(const T* from, int64_t from_row, int64_t rows, int64_t columns, T* to,
               int64_t to_row) {
  int64_t row = 0;
  if constexpr (sizeof(T) == 4 && kLanes<T> >= 8) {
    row = transpose_blocks<8>(from, from_row, 0, rows, 0, columns, to, to_row);
    if (columns % 8 >= 4) {
      transpose_blocks<4>(from, from_row, 0, row, columns / 8 * 8, columns, to, to_row);
    }
  }
  row = transpose_blocks<4>(from, from_row, row, rows, 0, columns, to, to_row);
  const int64_t column = columns / 4 * 4;
  for (int64_t r = 0; r < rows; ++r) {
    for (int64_t c = r < row ? column : 0; c < columns; ++c) {
      to[c * to_row + r] = from[r * from_row + c];
    }
  }
}

constexpr int64_t kLine = 64;  // bytes of a cache line

SURFCONV_INLINE void prefetch(uintptr_t place) {
#if defined(SURFCONV_X86)
  // Of the builtin g++ 12 thinks that it does nothing, and drops calls of functions around it.
  asm volatile("prefetcht1 (%0)" : : "r"(place));
#else
  __builtin_prefetch(reinterpret_cast<const void*>(place), 0, 2);
#endif
}
SURFCONV_INLINE void prefetch_to_write(uintptr_t place) {
#if defined(SURFCONV_X86)
  // Processors that do not know it take it for no operation.
  asm volatile("prefetchw (%0)" : : "r"(place));
#else
  __builtin_prefetch(reinterpret_cast<const void*>(place), 1, 2);
#endif
}

// So many bytes from there on.
template <bool Writes>
SURFCONV_INLINE void fetch(uintptr_t place, int64_t bytes) {
  for (int64_t at = 0; at < bytes; at += kLine) {
    const uintptr_t line = place + static_cast<uintptr_t>(at);
    Writes ? prefetch_to_write(line) : prefetch(line);
  }
}

// So many pixels of each plane, `ahead` pixels on. Planes of few pixels need none of it.
template <bool Writes, class S>
SURFCONV_INLINE void fetch_planes(const S* first, int64_t ahead, int64_t plane, int64_t planes,
                                  int64_t pixels) {
  constexpr int64_t bytes = sizeof(S), kFew = 512;
  if (std::abs(plane) < kFew) return;
  uintptr_t place = reinterpret_cast<uintptr_t>(first) + static_cast<uintptr_t>(ahead * bytes);
  for (int64_t c = 0; c < planes; ++c, place += static_cast<uintptr_t>(plane * bytes)) {
    fetch<Writes>(place, pixels * bytes);
  }
}
