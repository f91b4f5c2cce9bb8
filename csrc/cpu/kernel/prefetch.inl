// The pixels that tiles to come will meet first, fetched while a product is busy: the processor's
// own prefetching stops at the gaps between tiles. Neighbours are at like depths, so these are
// where the lowest taps of this tile are, some tiles further on. (The backward gained nothing by
// it.)

SURFCONV_INLINE void prefetch(uintptr_t place) {
#if defined(SURFCONV_X86)
  // Of the builtin g++ 12 thinks that it does nothing, and drops calls of functions around it.
  asm volatile("prefetcht1 (%0)" : : "r"(place));
#else
  __builtin_prefetch(reinterpret_cast<const void*>(place), 0, 2);
#endif
}

// Where channels of an image lie.
struct ImagePart {
  const char* first_pixel;
  int64_t step_y, step_x;  // bytes
  int64_t bytes;           // of a pixel's channels
};

template <class T>
SURFCONV_INLINE void prefetch_ahead(const Conv& conv, const Tile<T>& tile, int count,
                                    const ImagePart& part) {
  constexpr int64_t kTilesAhead = 2, kLine = 64;
  if (conv.y.kernel == 1) return;
  const int64_t* lowest = tile.rows().read + (conv.y.kernel * 2 - 1) * kTile;
  const int64_t* middle = tile.columns().read + conv.x.kernel / 2 * 2 * kTile;
  const int64_t advance = conv.x.stride * part.step_x, ahead = kTilesAhead * kTile * advance;
  const int64_t bytes = part.bytes + advance - part.step_x;
  const int pixels = static_cast<int>(std::max<int64_t>(1, kLine / advance));
  for (int m = 0; m < count; m += pixels) {
    const uintptr_t pixel = reinterpret_cast<uintptr_t>(part.first_pixel) +
                            static_cast<uintptr_t>(lowest[m] + middle[m] + ahead);
    for (int64_t y = 0; y < conv.y.stride; ++y) {
      const uintptr_t row = pixel - static_cast<uintptr_t>(y * part.step_y);
      for (int64_t at = 0; at < bytes; at += kLine) prefetch(row + static_cast<uintptr_t>(at));
    }
  }
}
