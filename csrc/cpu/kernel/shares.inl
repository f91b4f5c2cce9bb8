// Tasks of tiles. Which tiles are multiplied at once, and which share of them an output is in,
// changes no result.

SURFCONV_INLINE int64_t tiles_of(int64_t pixels) { return (pixels + kTile - 1) / kTile; }

// The tiles of each image cut into runs that are multiplied at once; and their outputs into shares,
// which are tasks of their own, where there are too few tiles to keep the workers busy: small maps
// of many channels. Each share gathers its tiles again.
class Shares {
 public:
  // most: tiles that may be a run; pieces: what the outputs may be cut into, of so many channels;
  // weights: what having a run's costs, in products of a tile.
  Shares(int64_t images, int64_t pixels, int64_t most, int64_t pieces, int64_t channels,
         int workers, double weights)
      : pieces_(pieces) {
    if (pixels == 0) return;
    constexpr double kGather = 8;  // channels that cost a tile what gathering it does
    const double tiles = static_cast<double>(pixels) / kTile;
    double least = std::numeric_limits<double>::max();
    for (int64_t run = 1; run <= most; ++run) {
      const int64_t runs = (tiles_of(pixels) + run - 1) / run;
      const double largest =
          std::min(tiles, static_cast<double>((tiles_of(pixels) + runs - 1) / runs));
      for (int64_t count = 1; count <= pieces; ++count) {
        const double of_each = static_cast<double>((pieces + count - 1) / count * channels);
        const double rounds = static_cast<double>((images * runs * count + workers - 1) / workers);
        const double cost =
            ((rounds - 1) * tiles / static_cast<double>(runs) + largest) * (of_each + kGather) +
            rounds * of_each * weights;
        if (cost < least) least = cost, runs_ = runs, count_ = count;
      }
    }
  }
  int64_t runs() const { return runs_; }  // of an image
  int64_t count() const { return count_; }
  Range pieces(int64_t share) const {
    return {pieces_ * share / count_, pieces_ * (share + 1) / count_};
  }

 private:
  int64_t pieces_, runs_ = 0, count_ = 1;
};
