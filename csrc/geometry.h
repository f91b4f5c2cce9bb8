// The one relation of the operator, per axis (Chu et al., CVPR 2018, Eq. 7 in pixel form):
//
//   centre(o)   = stride * o - padding + dilation * (kernel - 1) / 2
//   tap(t)      = dilation * (t - (kernel - 1) / 2)
//   sample(o,t) = centre(o) + scale(o) * tap(t)
//
// Nothing else in the compiled code derives a position. centre and tap are multiples of 1/2, so
// they are kept doubled as integers; offsets are floored relative to the centre's integer part, so
// that precision does not depend on where in the image a tap lies.
#pragma once

#include <algorithm>
#include <cstdint>

namespace surfconv {

struct Axis {
  int64_t in;
  int64_t out;
  int64_t kernel;
  int64_t stride;
  int64_t padding;  // before the first pixel; the output size is given, so the far side is implied
  int64_t dilation;

  int64_t tap_doubled(int64_t t) const { return dilation * (2 * t - (kernel - 1)); }

  // Of all centres at once: stride and padding are whole pixels.
  bool centre_is_half() const { return (dilation * (kernel - 1)) % 2 != 0; }

  int64_t centre_floor(int64_t o) const {
    return stride * o - padding + (dilation * (kernel - 1)) / 2;
  }

  // The input pixel nearest to centre(o), a half rounding down, clamped into the image: the pixel
  // whose depth and guide stand for the output pixel.
  int64_t centre_pixel(int64_t o) const {
    return std::min(std::max<int64_t>(centre_floor(o), 0), in - 1);
  }

  // The tap of zero offset, -1 where there is none. It stays on its pixel whatever the scale: one
  // corner, no derivative.
  int64_t fixed_tap() const { return kernel % 2 != 0 ? kernel / 2 : -1; }
  bool fixed(int64_t t) const { return t == fixed_tap(); }

  // Pixels under window o of a pool, padding included, what a window reaches beyond it not.
  int64_t pool_window(int64_t o) const {
    const int64_t start = stride * o - padding;
    return std::min(start + kernel, in + padding) - start;
  }

  // Largest magnitude a centre or an image border takes: decides the width of index arithmetic.
  int64_t reach() const {
    return std::max(in, stride * std::max<int64_t>(out, 1) + padding + dilation * kernel);
  }
};

// Where samples fall: between pixel `lo` and `lo + 1`, counted from centre_floor, `fraction` of the
// way. All members are vectors of as many lanes; masks hold 0 or -1.
template <class Real, class Integer>
struct Position {
  Integer lo;
  Real fraction;
  Integer reachable;  // 0: not finite, or so far away that no image reaches it
};

// Real and Integer are vectors of floating-point numbers and integers; half is 0.5 where centres
// lie between pixels, else 0. limit bounds the offset so that it fits in a lane of Integer together
// with centre_floor.
// A sample exactly on a pixel counts to the cell it moves into as the scale grows: then the
// derivatives of all taps are the same one-sided derivative. Descending: the tap is negative.
template <bool Descending, class Real, class Integer, class T>
inline __attribute__((always_inline)) Position<Real, Integer> locate(T half, T tap, Real scale,
                                                                     T limit) {
  Real offset = half + scale * tap;
  const auto near = (offset < limit) & (offset > -limit);  // NaN compares false
  offset = near ? offset : Real{};
  Integer whole = __builtin_convertvector(offset, Integer);
  const Real truncated = __builtin_convertvector(whole, Real);
  const auto above = Descending ? truncated >= offset : truncated > offset;
  whole += __builtin_convertvector(above, Integer);
  return {whole, offset - __builtin_convertvector(whole, Real),
          __builtin_convertvector(near, Integer)};
}

// The opposite tap, of a centre on a pixel.
template <class Real, class Integer>
inline __attribute__((always_inline)) Position<Real, Integer> opposite(
    const Position<Real, Integer>& position) {
  return {-1 - position.lo, 1 - position.fraction, position.reachable};
}

}  // namespace surfconv
