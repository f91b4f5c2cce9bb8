#define SURFCONV_INLINE inline __attribute__((always_inline))
// After the parameters of a lambda: in a hot loop g++ sometimes calls it instead.
#define SURFCONV_INLINED __attribute__((always_inline))

template <class T, int N>
struct VecOf {
  typedef T type __attribute__((vector_size(N * sizeof(T))));
};
template <class T, int N>
using Vec = typename VecOf<T, N>::type;

template <class T>
constexpr int kLanes = SURFCONV_VECTOR_BYTES / static_cast<int>(sizeof(T));

// Lanes of vectors that are compared: g++ 12 takes comparisons of longer ones apart, lane by lane.
constexpr int kComparedBytes = std::min(SURFCONV_VECTOR_BYTES, 32);
template <class T>
constexpr int kComparedLanes = kComparedBytes / static_cast<int>(sizeof(T));

using One = std::integral_constant<int, 1>;
using Two = std::integral_constant<int, 2>;

// Channels are stored in multiples of a quad, the narrowest vector of every instruction set in
// float, so that no loop over channels needs a scalar tail.
constexpr int64_t kQuad = 4;

SURFCONV_INLINE int64_t round_up(int64_t value, int64_t multiple) {
  return (value + multiple - 1) / multiple * multiple;
}
SURFCONV_INLINE int64_t to_quads(int64_t channels) { return round_up(channels, kQuad); }

template <class V, class T>
SURFCONV_INLINE V load(const T* p) {
  V v;
  __builtin_memcpy(&v, p, sizeof(V));
  return v;
}
template <class V, class T>
SURFCONV_INLINE void store(T* p, V v) {
  __builtin_memcpy(p, &v, sizeof(V));
}
template <class V, class T>
SURFCONV_INLINE V broadcast(T value) {
  return value - V{};
}

// g++ reads a vector that is used twice from memory twice, where memory is what there is least of.
template <class V>
SURFCONV_INLINE void keep_in_register(V& v) {
#if defined(SURFCONV_X86)
  asm("" : "+v"(v));
#else
  static_cast<void>(v);
#endif
}

// Runs body(channel, Width<lanes>) over `channels`, a multiple of kQuad, widest vectors first.
// channels is an int64_t, or a Fixed<N>: then the loop is unrolled.
template <int N>
struct Width {
  static constexpr int lanes = N;
};
template <int64_t N>
struct Fixed {
  static constexpr int64_t value = N;
};
template <class T, int64_t N, class Body>
SURFCONV_INLINE void for_channels(Fixed<N>, const Body& body) {
  constexpr int lanes = N < kLanes<T> ? static_cast<int>(N) : kLanes<T>;
#pragma GCC unroll 16
  for (int64_t c = 0; c < N; c += lanes) body(c, Width<lanes>{});
}

template <int64_t N>
constexpr int64_t count_of(Fixed<N>) {
  return N;
}
constexpr int64_t count_of(int64_t channels) { return channels; }
template <class T, int64_t N>
constexpr bool is_one_vector(Fixed<N>) {
  return N <= kLanes<T>;
}
template <class T>
constexpr bool is_one_vector(int64_t) {
  return false;
}

// Lanes of the vectors that most of the channels are walked in.
template <class T, int64_t N>
constexpr int widest_lanes(Fixed<N>) {
  return static_cast<int>(std::min<int64_t>(N, kLanes<T>));
}
template <class T>
constexpr int widest_lanes(int64_t) {
  return kLanes<T>;
}

// Calls body with the count as a Fixed where it is one that nets have in float32.
template <class T, class Body>
SURFCONV_INLINE void with_channels(int64_t channels, const Body& body) {
  if constexpr (sizeof(T) == 4) {
    if (channels == 64) return body(Fixed<64>{});
    if (channels == 32) return body(Fixed<32>{});
    if (channels == 16) return body(Fixed<16>{});
    if (channels == 8) return body(Fixed<8>{});
    if (channels == 4) return body(Fixed<4>{});
  }
  body(channels);
}

template <class T, class Body>
SURFCONV_INLINE void for_channels(int64_t channels, const Body& body) {
  constexpr int full = kLanes<T>;
  int64_t c = 0;
  for (; c + full <= channels; c += full) body(c, Width<full>{});
  if constexpr (full > 8) {
    if (c + 8 <= channels) {
      body(c, Width<8>{});
      c += 8;
    }
  }
  if constexpr (full > 4) {
    if (c < channels) body(c, Width<4>{});
  }
}

// Channels, a multiple of kQuad, in strips of up to four vectors, which share what is read for all
// of them and need not wait for each other: body(first channel, strip)
template <int Lanes, int Vectors>
struct Strip {
  static constexpr int lanes = Lanes, vectors = Vectors;
};
template <class T, class Body>
SURFCONV_INLINE void for_strips(int64_t channels, const Body& body) {
  constexpr int lanes = kLanes<T>;
  int64_t c = 0;
  for (; c + 4 * lanes <= channels; c += 4 * lanes) body(c, Strip<lanes, 4>{});
  if (c + 2 * lanes <= channels) {
    body(c, Strip<lanes, 2>{});
    c += 2 * lanes;
  }
  for_channels<T>(channels - c, [&](int64_t rest, auto width) SURFCONV_INLINED {
    body(c + rest, Strip<decltype(width)::lanes, 1>{});
  });
}

// The sum of a vector's parts, each as long as V.
template <class V, class T, class Whole>
SURFCONV_INLINE V fold(Whole v) {
  if constexpr (sizeof(Whole) == sizeof(V)) {
    return v;
  } else {
    using Half = Vec<T, static_cast<int>(sizeof(Whole) / sizeof(T)) / 2>;
    Half lower, upper;
    __builtin_memcpy(&lower, &v, sizeof(Half));
    __builtin_memcpy(&upper, reinterpret_cast<const char*>(&v) + sizeof(Half), sizeof(Half));
    return fold<V, T>(Half(lower + upper));
  }
}
// Halves by halves: lane by lane each addition would wait for the one before it.
template <class T, class V>
SURFCONV_INLINE T sum_lanes(V v) {
  return fold<Vec<T, 1>, T>(v)[0];
}
