// How a pass of the backward is cut into slots: runs of whole images, or bands of output rows. The
// bands of an image scatter into the same gradient: first every other one, whose taps do not meet,
// then those between them. A few tiles may reach further than their band may: they are done again,
// for that alone, when all bands are done.
struct Slot {
  int64_t first_image, images;  // within the pass
  int phase;                    // slots of a phase scatter to different rows
  int64_t partial;              // of weights and bias: slots of different phases share it
  Range out;
  Range reach;  // input rows
  bool far;     // some tiles reach beyond it
};
constexpr int kPhases = 2;

// The spread of taps in each stretch of up to kTile pixels of the rows of a pass.
template <class T>
class Spreads {
 public:
  Spreads(const Conv& conv, const View& scale, const Pass& pass)
      : conv_(conv), pass_(pass), of_row_((conv.x.out + kTile - 1) / kTile) {
    for (int64_t i = 0; i < pass.images; ++i) {
      for (int64_t y = pass.out.begin; y < pass.out.end; ++y) {
        for (int64_t x = 0; x < conv.x.out; x += kTile) {
          const T largest = largest_scale<T>(conv, scale, pass.first_image + i, y * conv.x.out + x,
                                             std::min<int64_t>(kTile, conv.x.out - x));
          spreads_.push_back(spread_of(conv, largest));
        }
      }
    }
  }

  // Stretches that spread beyond a limit are few enough to be done twice.
  bool few_beyond(int64_t limit) const {
    constexpr int64_t kFew = 32;
    int64_t beyond = 0;
    for (const int64_t spread : spreads_) beyond += spread > limit;
    return beyond * kFew <= static_cast<int64_t>(spreads_.size());
  }

  // The reach of rows of an image, of stretches within the limit; others make the slot far.
  void reach(int64_t limit, Slot& slot) const {
    int64_t most = 0;
    const int64_t first = slot.first_image * pass_.out.count() - pass_.out.begin;
    for (int64_t i = (first + slot.out.begin) * of_row_; i < (first + slot.out.end) * of_row_;
         ++i) {
      const int64_t spread = spreads_[static_cast<size_t>(i)];
      slot.far |= spread > limit;
      if (spread <= limit) most = std::max(most, spread);
    }
    slot.reach = rows_around(conv_, slot.out, most);
  }

 private:
  const Conv& conv_;
  const Pass& pass_;
  const int64_t of_row_;
  std::vector<int64_t> spreads_;
};

// More than one band an image only where there are too few images for `wanted` partials.
template <class T>
std::vector<Slot> make_slots(const Conv& conv, const View& scale, const Pass& pass, int64_t wanted,
                             bool scatters) {
  constexpr int64_t kLeastPixels = 2048;
  std::vector<Slot> slots;
  if (pass.images >= wanted) {
    for (int64_t i = 0; i < wanted; ++i) {
      const int64_t begin = pass.images * i / wanted, end = pass.images * (i + 1) / wanted;
      slots.push_back({begin, end - begin, 0, i, pass.out, pass.in, false});
    }
    return slots;
  }
  const int64_t rows = pass.out.count(), pixels = rows * conv.x.out;
  const int64_t most =
      std::min({(wanted + pass.images - 1) / pass.images, pixels / kLeastPixels + 1, rows});
  int64_t shares = 1;  // a power of two, which two, four or eight threads share evenly
  while (shares * 2 <= most) shares *= 2;
  int64_t limit = 0;
  std::optional<Spreads<T>> spreads;
  if (shares > 1 && scatters) {
    spreads.emplace(conv, scale, pass);
    for (; shares > 1; shares /= 2) {
      limit = spread_apart(conv, rows / (shares * kPhases));
      if (spreads->few_beyond(limit)) break;
    }
  }
  const int phases = shares > 1 && scatters ? kPhases : 1;
  const int64_t bands = shares * phases;
  for (int64_t band = 0; band < pass.images * bands; ++band) {
    const int64_t k = band % bands;
    const Range out{pass.out.begin + rows * k / bands, pass.out.begin + rows * (k + 1) / bands};
    slots.push_back(
        {band / bands, 1, static_cast<int>(k % phases), band / phases, out, pass.in, false});
    if (phases > 1) spreads->reach(limit, slots.back());
  }
  return slots;
}
