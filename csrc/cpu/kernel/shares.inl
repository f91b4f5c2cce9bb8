// Tasks of tiles. Which share of its tile an output is in changes no result.

// How many tiles an image is worth: its last one may be next to nothing.
SURFCONV_INLINE int64_t whole_tiles(int64_t pixels, int64_t tile) {
  return std::max<int64_t>(1, (pixels + tile / 2) / tile);
}

// The outputs of a tile cut into shares, which are tasks of their own, where there are too few
// tiles to keep the workers busy: small maps of many channels. Each share gathers its tile again.
class Shares {
 public:
  // pieces: what the outputs may be cut into, of so many channels each.
  Shares(int64_t tiles, int64_t pieces, int64_t channels, int workers) : pieces_(pieces) {
    constexpr int64_t kGather = 8;  // channels that cost what gathering does
    int64_t least = std::numeric_limits<int64_t>::max();
    for (int64_t count = 1; count <= pieces; ++count) {
      const int64_t rounds = (tiles * count + workers - 1) / workers;
      const int64_t cost = rounds * ((pieces + count - 1) / count * channels + kGather);
      if (cost < least) least = cost, count_ = count;
    }
  }
  int64_t count() const { return count_; }
  Range pieces(int64_t share) const {
    return {pieces_ * share / count_, pieces_ * (share + 1) / count_};
  }

 private:
  int64_t pieces_, count_ = 1;
};
