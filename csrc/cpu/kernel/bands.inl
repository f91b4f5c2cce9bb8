// How a pass of the backward is cut into slots: runs of whole images, or bands of output rows. The
// bands of an image scatter into the same gradient: each writes the input rows it owns in place and
// the others, into which its taps reach, to spill rows of its own, added in band order afterwards.
// A few tiles may reach further than their band has spill rows for: they are done again, for that
// alone, when all bands are done.
struct Slot {
  int64_t first_image, images;  // within the pass
  Rows out;
  Rows own, reach;   // input rows; reach holds own
  bool far;          // some tiles reach beyond it
  RowPlaces places;  // of the rows of reach in the gradient

  int64_t spilled() const { return reach.count() - own.count(); }
};

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
    const Rows around = rows_around(conv_, slot.out, most);
    slot.reach = {std::min(slot.own.begin, around.begin), std::max(slot.own.end, around.end)};
  }

 private:
  const Conv& conv_;
  const Pass& pass_;
  const int64_t of_row_;
  std::vector<int64_t> spreads_;
};

// More than one band an image only where there are too few images for `wanted` tasks, and only
// while the spill rows are at most half as many as the pass has.
template <class T>
std::vector<Slot> make_slots(const Conv& conv, const View& scale, const Pass& pass, int64_t wanted,
                             bool scatters) {
  constexpr int64_t kLeastPixels = 2048;
  std::vector<Slot> slots;
  if (pass.images >= wanted) {
    for (int64_t i = 0; i < wanted; ++i) {
      const int64_t begin = pass.images * i / wanted, end = pass.images * (i + 1) / wanted;
      slots.push_back({begin, end - begin, pass.out, pass.in, pass.in, false, {}});
    }
    return slots;
  }
  const int64_t rows = pass.out.count(), pixels = rows * conv.x.out;
  const int64_t most =
      std::min({(wanted + pass.images - 1) / pass.images, pixels / kLeastPixels + 1, rows});
  int64_t bands = 1;  // a power of two, which two, four or eight threads share evenly
  while (bands * 2 <= most) bands *= 2;
  std::optional<Spreads<T>> spreads;
  if (bands > 1 && scatters) spreads.emplace(conv, scale, pass);
  for (;; bands /= 2) {
    slots.clear();
    const bool spills = bands > 1 && scatters;
    const int64_t limit = pass.in.count() / (4 * bands);
    if (spills && !spreads->few_beyond(limit)) continue;
    int64_t spill = 0;
    for (int64_t i = 0; i < pass.images; ++i) {
      for (int64_t band = 0; band < bands; ++band) {
        const auto share = [&](Rows all, int64_t k) { return all.begin + all.count() * k / bands; };
        Slot slot{i,
                  1,
                  {share(pass.out, band), share(pass.out, band + 1)},
                  {share(pass.in, band), share(pass.in, band + 1)},
                  pass.in,
                  false,
                  {}};
        if (spills) spreads->reach(limit, slot);
        spill += slot.spilled();
        slots.push_back(std::move(slot));
      }
    }
    if (!spills || 2 * spill <= pass.images * pass.in.count()) return slots;
  }
}
