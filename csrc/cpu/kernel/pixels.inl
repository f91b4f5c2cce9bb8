// Moves runs of pixels between tensors of any strides and dtype and channel-innermost buffers of
// the compute type.
struct BFloat16 {
  uint16_t bits;
};
struct Float16 {
  uint16_t bits;
};

SURFCONV_INLINE uint32_t bits_of(float value) {
  uint32_t bits;
  __builtin_memcpy(&bits, &value, 4);
  return bits;
}
SURFCONV_INLINE float float_of(uint32_t bits) {
  float value;
  __builtin_memcpy(&value, &bits, 4);
  return value;
}

SURFCONV_INLINE float widen(float value) { return value; }
SURFCONV_INLINE double widen(double value) { return value; }
SURFCONV_INLINE float widen(BFloat16 value) { return float_of(uint32_t{value.bits} << 16); }
SURFCONV_INLINE float widen(Float16 value) {
  const uint32_t magnitude = value.bits & 0x7fffu;
  const float finite = float_of(magnitude << 13) * float_of(0x77800000u);  // 2^112 rebiases
  const uint32_t special = magnitude >= 0x7c00u ? 0x7f800000u : 0u;
  return float_of(bits_of(finite) | special | (uint32_t{value.bits} & 0x8000u) << 16);
}

SURFCONV_INLINE void narrow(float value, float* to) { *to = value; }
SURFCONV_INLINE void narrow(double value, double* to) { *to = value; }
SURFCONV_INLINE void narrow(double value, float* to) { *to = static_cast<float>(value); }
SURFCONV_INLINE void narrow(float value, BFloat16* to) {
  const uint32_t u = bits_of(value);
  const uint32_t rounded = (u + 0x7fffu + ((u >> 16) & 1u)) >> 16;
  const bool nan = (u & 0x7fffffffu) > 0x7f800000u;
  to->bits = static_cast<uint16_t>(nan ? 0x7fc0u : rounded);
}
SURFCONV_INLINE void narrow(float value, Float16* to) {
  const uint32_t sign = bits_of(value) & 0x80000000u;
  const uint32_t u = bits_of(value) ^ sign;
  const uint32_t special = u > 0x7f800000u ? 0x7e00u : 0x7c00u;
  // Adding 0.5 lets the adder round a subnormal result in the last bits of the sum.
  const uint32_t small = bits_of(float_of(u) + 0.5f) - 0x3f000000u;
  const uint32_t normal = (u + 0xc8000fffu + ((u >> 13) & 1u)) >> 13;
  const uint32_t magnitude = u >= 0x47800000u ? special : (u < 0x38800000u ? small : normal);
  to->bits = static_cast<uint16_t>(magnitude | sign >> 16);
}

template <class T>
constexpr DType kComputeDType = sizeof(T) == 8 ? DType::f64 : DType::f32;

// body(pointer of the storage type); float16 types never meet double arithmetic.
template <class T, class Body>
SURFCONV_INLINE void visit_storage(const View& view, const Body& body) {
  switch (view.dtype) {
    case DType::f32:
      return body(static_cast<float*>(view.data));
    case DType::f64:
      if constexpr (sizeof(T) == 8) return body(static_cast<double*>(view.data));
      break;
    case DType::bf16:
      if constexpr (sizeof(T) == 4) return body(static_cast<BFloat16*>(view.data));
      break;
    case DType::f16:
      if constexpr (sizeof(T) == 4) return body(static_cast<Float16*>(view.data));
      break;
  }
}

// Flat pixels first .. first+count-1 of an image as runs of constant stride.
// body(pixels already done, pixels of the run, element offset of its first)
template <class Body>
SURFCONV_INLINE void for_runs(const View& view, int64_t width, int64_t first, int64_t count,
                              const Body& body) {
  if (view.y == view.x * width) return body(0, count, first * view.x);
  for (int64_t done = 0; done < count;) {
    const int64_t y = (first + done) / width, x = (first + done) % width;
    const int64_t run = std::min(count - done, width - x);
    body(done, run, y * view.y + x * view.x);
    done += run;
  }
}

constexpr int64_t kStage = 64;  // pixels converted at a time between half types and transposes

// Pixels whose channels, a quad or more, lie side by side on both ends.
template <class T>
void copy_pixels(const T* from, int64_t from_step, int64_t channels, int64_t count, T* to,
                 int64_t to_step) {
  if (channels % kQuad != 0) {
    using Quad = Vec<T, kQuad>;
    const int64_t last = channels - kQuad;  // overlaps the quad before it
    for (int64_t p = 0; p < count; ++p, from += from_step, to += to_step) {
      for (int64_t c = 0; c < last; c += kQuad) store(to + c, load<Quad>(from + c));
      store(to + last, load<Quad>(from + last));
    }
    return;
  }
  with_channels<T>(channels, [&](auto known) {
    for (int64_t p = 0; p < count; ++p) {
      for_channels<T>(known, [&](int64_t c, auto width) SURFCONV_INLINED {
        using V = Vec<T, decltype(width)::lanes>;
        store(to + p * to_step + c, load<V>(from + p * from_step + c));
      });
    }
  });
}

// to[pixel * ld + channel]; channels up to `padded` become zero.
template <class T>
void load_pixels(const View& view, int64_t n, int64_t first_channel, int64_t channels,
                 int64_t width, int64_t first, int64_t count, T* to, int64_t ld, int64_t padded) {
  visit_storage<T>(view, [&](auto* data) {
    using S = std::remove_pointer_t<decltype(data)>;
    const S* origin = data + n * view.n + first_channel * view.c;
    for_runs(view, width, first, count, [&](int64_t done, int64_t run, int64_t offset) {
      const S* from = origin + offset;
      T* rows = to + done * ld;
      if constexpr (std::is_same_v<S, T>) {
        if (view.c == 1 && channels >= kQuad) {
          return copy_pixels(from, view.x, channels, run, rows, ld);
        }
      }
      if (channels == 1 && ld == 1) {
        for (int64_t p = 0; p < run; ++p) rows[p] = widen(from[p * view.x]);
      } else if (view.c != 1 && view.x == 1) {
        if constexpr (std::is_same_v<S, T>) {
          for (int64_t p = 0; p < run; p += kStage) {
            fetch_planes<false>(from + p, kStage, view.c, channels, kStage);
            transpose(from + p, view.c, channels, std::min(kStage, run - p), rows + p * ld, ld);
          }
        } else {
          T stage[8 * kStage];
          for (int64_t p = 0; p < run; p += kStage) {
            const int64_t pixels = std::min(kStage, run - p);
            for (int64_t c = 0; c < channels; c += 8) {
              const int64_t planes = std::min<int64_t>(8, channels - c);
              for (int64_t i = 0; i < planes; ++i) {
                const S* plane = from + (c + i) * view.c + p;
                for (int64_t j = 0; j < pixels; ++j) stage[i * kStage + j] = widen(plane[j]);
              }
              transpose(stage, kStage, planes, pixels, rows + p * ld + c, ld);
            }
          }
        }
      } else if (view.c == 1) {
        for (int64_t p = 0; p < run; ++p) {
          const S* pixel = from + p * view.x;
          T* row = rows + p * ld;
          for (int64_t c = 0; c < channels; ++c) row[c] = widen(pixel[c]);
        }
      } else {
        for (int64_t p = 0; p < run; ++p) {
          const S* pixel = from + p * view.x;
          for (int64_t c = 0; c < channels; ++c) rows[p * ld + c] = widen(pixel[c * view.c]);
        }
      }
    });
  });
  // Channel by channel: the few of a pixel would be a call of memset each.
  for (int64_t c = channels; c < padded; ++c) {
    for (int64_t p = 0; p < count; ++p) to[p * ld + c] = 0;
  }
}

template <class T>
void store_pixels(const View& view, int64_t n, int64_t first_channel, int64_t channels,
                  int64_t width, int64_t first, int64_t count, const T* from, int64_t ld) {
  visit_storage<T>(view, [&](auto* data) {
    using S = std::remove_pointer_t<decltype(data)>;
    S* origin = data + n * view.n + first_channel * view.c;
    for_runs(view, width, first, count, [&](int64_t done, int64_t run, int64_t offset) {
      S* to = origin + offset;
      const T* rows = from + done * ld;
      if constexpr (std::is_same_v<S, T>) {
        if (view.c == 1 && channels >= kQuad) {
          return copy_pixels(rows, ld, channels, run, to, view.x);
        }
      }
      if (view.c != 1 && view.x == 1) {
        if constexpr (std::is_same_v<S, T>) {
          for (int64_t p = 0; p < run; p += kStage) {
            const int64_t pixels = std::min(kStage, run - p);
            if (p + kStage < run) fetch_planes<true>(to + p, kStage, view.c, channels, kStage);
            transpose(rows + p * ld, ld, pixels, channels, to + p, view.c);
          }
        } else {
          T stage[8 * kStage];
          for (int64_t p = 0; p < run; p += kStage) {
            const int64_t pixels = std::min(kStage, run - p);
            for (int64_t c = 0; c < channels; c += 8) {
              const int64_t planes = std::min<int64_t>(8, channels - c);
              transpose(rows + p * ld + c, ld, pixels, planes, stage, kStage);
              for (int64_t i = 0; i < planes; ++i) {
                S* plane = to + (c + i) * view.c + p;
                for (int64_t j = 0; j < pixels; ++j) narrow(stage[i * kStage + j], plane + j);
              }
            }
          }
        }
      } else {
        for (int64_t p = 0; p < run; ++p) {
          S* pixel = to + p * view.x;
          const T* row = rows + p * ld;
          if (view.c == 1) {
            for (int64_t c = 0; c < channels; ++c) narrow(row[c], pixel + c);
          } else {
            for (int64_t c = 0; c < channels; ++c) narrow(row[c], pixel + c * view.c);
          }
        }
      }
    });
  });
}

// What store_pixels will write, where it lies in planes: fetched while it is computed.
template <class T>
void fetch_to_store(const View& view, int64_t n, int64_t first_channel, int64_t channels,
                    int64_t width, int64_t first, int64_t count) {
  if (view.c == 1 || view.x != 1) return;
  visit_storage<T>(view, [&](auto* data) {
    auto* origin = data + n * view.n + first_channel * view.c;
    for_runs(view, width, first, count, [&](int64_t, int64_t run, int64_t offset) {
      fetch_planes<true>(origin + offset, 0, view.c, channels, run);
    });
  });
}

inline void advance(View& view, int64_t elements) {
  const int64_t sizes[] = {4, 8, 2, 2};
  view.data = static_cast<char*>(view.data) + elements * sizes[static_cast<int>(view.dtype)];
}
