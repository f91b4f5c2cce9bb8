// How the backward's work is cut, by shape and scale alone so that sums keep their order.
//
// A slot is a run of whole images or one band of an image's output rows. The bands of an image
// scatter into the same gradient: each writes the input rows it owns in place and the others, into
// which its taps reach, to spill rows of its own, added in band order afterwards.
struct Slot {
  int64_t first_image, images;  // within the images handled at a time
  int64_t begin, end;           // flat output pixels
  int64_t own_begin, own_end;   // input rows
  int64_t reach_begin, reach_end;
  std::vector<int64_t> row_offset;  // bytes from the gradient's image to each input row
};

// The input rows that taps of output rows [begin, end) may touch, one row to spare on each side.
template <class T>
void find_reach(const Conv& conv, const View& scale, int64_t n, int64_t begin, int64_t end,
                Slot& slot) {
  double least = 0, most = 0;  // zero-offset taps stay at the centre
  T values[kTile];
  for (int64_t first = begin * conv.x.out; first < end * conv.x.out; first += kTile) {
    const int64_t count = std::min<int64_t>(kTile, end * conv.x.out - first);
    load_pixels<T>(scale, n, 0, 1, conv.x.out, first, count, values, 1, 1);
    for (int64_t m = 0; m < count; ++m) {
      const double value = static_cast<double>(values[m]);
      if (value - value != 0) continue;
      least = std::min(least, value);
      most = std::max(most, value);
    }
  }
  const double tap = static_cast<double>(std::abs(conv.y.tap_doubled(0))) / 2;
  const double spread = std::min(std::max(most, -least) * tap + 2, static_cast<double>(conv.y.in));
  const int64_t rows = static_cast<int64_t>(spread);
  const auto clamp = [&](int64_t row) { return std::min(std::max<int64_t>(row, 0), conv.y.in); };
  slot.reach_begin = std::min(slot.own_begin, clamp(conv.y.centre_floor(begin) - rows - 1));
  slot.reach_end = std::max(slot.own_end, clamp(conv.y.centre_floor(end - 1) + rows + 3));
}

// Slots for `images` images. More than one band an image only where there are too few images for
// `wanted` tasks, and only while the spill rows stay within one more image.
template <class T>
std::vector<Slot> make_slots(const Conv& conv, const View& scale, int64_t first_image,
                             int64_t images, int64_t wanted, bool scatters) {
  constexpr int64_t kLeastPixels = 2048;
  const int64_t pixels = conv.y.out * conv.x.out;
  std::vector<Slot> slots;
  if (images >= wanted) {
    for (int64_t i = 0; i < wanted; ++i) {
      const int64_t begin = images * i / wanted, end = images * (i + 1) / wanted;
      slots.push_back({begin, end - begin, 0, pixels, 0, conv.y.in, 0, conv.y.in, {}});
    }
    return slots;
  }
  int64_t bands = std::min({(wanted + images - 1) / images, pixels / kLeastPixels + 1, conv.y.out});
  for (;; bands /= 2) {
    slots.clear();
    int64_t spill = 0;
    for (int64_t i = 0; i < images; ++i) {
      for (int64_t band = 0; band < bands; ++band) {
        const int64_t begin = conv.y.out * band / bands, end = conv.y.out * (band + 1) / bands;
        Slot slot{i,
                  1,
                  begin * conv.x.out,
                  end * conv.x.out,
                  conv.y.in * band / bands,
                  conv.y.in * (band + 1) / bands,
                  0,
                  conv.y.in,
                  {}};
        if (bands > 1 && scatters) find_reach<T>(conv, scale, first_image + i, begin, end, slot);
        spill += slot.reach_end - slot.reach_begin - (slot.own_end - slot.own_begin);
        slots.push_back(std::move(slot));
      }
    }
    if (bands == 1 || !scatters || spill <= images * conv.y.in) return slots;
  }
}
