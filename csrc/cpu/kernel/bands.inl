// How a pass of the backward is cut into slots: runs of whole images, or bands of output rows. The
// bands of an image scatter into the same gradient: each writes the input rows it owns in place and
// the others, into which its taps reach, to spill rows of its own, added in band order afterwards.
struct Slot {
  int64_t first_image, images;  // within the pass
  Rows out;
  Rows own, reach;   // input rows; reach holds own
  RowPlaces places;  // of the rows of reach in the gradient

  int64_t spilled() const { return reach.count() - own.count(); }
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
      slots.push_back({begin, end - begin, pass.out, pass.in, pass.in, {}});
    }
    return slots;
  }
  const int64_t rows = pass.out.count(), pixels = rows * conv.x.out;
  const int64_t most =
      std::min({(wanted + pass.images - 1) / pass.images, pixels / kLeastPixels + 1, rows});
  int64_t bands = 1;  // a power of two, which two, four or eight threads share evenly
  while (bands * 2 <= most) bands *= 2;
  for (;; bands /= 2) {
    slots.clear();
    int64_t spill = 0;
    for (int64_t i = 0; i < pass.images; ++i) {
      for (int64_t band = 0; band < bands; ++band) {
        const auto share = [&](Rows all, int64_t k) { return all.begin + all.count() * k / bands; };
        Slot slot{i,
                  1,
                  {share(pass.out, band), share(pass.out, band + 1)},
                  {share(pass.in, band), share(pass.in, band + 1)},
                  pass.in,
                  {}};
        if (bands > 1 && scatters) {
          const Rows reach = find_reach<T>(conv, scale, pass.first_image + i, slot.out);
          slot.reach = {std::min(slot.own.begin, reach.begin), std::max(slot.own.end, reach.end)};
        }
        spill += slot.spilled();
        slots.push_back(std::move(slot));
      }
    }
    if (bands == 1 || !scatters || 2 * spill <= pass.images * pass.in.count()) return slots;
  }
}
