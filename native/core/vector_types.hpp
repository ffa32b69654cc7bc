// Sixteen floats at a time with the compiler's vector extension: one AVX-512 register, two of AVX2, four of SSE or NEON.
//
// Included by the kernel files only, each compiled for one instruction set; everything here has internal linkage so that
// code of one instruction set is never linked into another.
#pragma once

#include <cstdint>
#include <cstring>

#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace {

#define RF_INLINE inline __attribute__((always_inline))

constexpr int kLanes = 16;

#if defined(__AVX512F__)

typedef float Vec __attribute__((vector_size(64)));
typedef int32_t IntVec __attribute__((vector_size(64)));

RF_INLINE Vec select(IntVec mask, Vec yes, Vec no) { return mask ? yes : no; }
RF_INLINE IntVec int_bits(Vec value) { return (IntVec)value; }
RF_INLINE Vec float_bits(IntVec value) { return (Vec)value; }
RF_INLINE Vec to_float(IntVec value) { return __builtin_convertvector(value, Vec); }

#else

// The compiler takes vectors wider than a register apart lane by lane in comparisons, so parts of one register are kept.
#if defined(__AVX2__)
constexpr int kParts = 2;
#else
constexpr int kParts = 4;
#endif
typedef float FloatPart __attribute__((vector_size(64 / kParts)));
typedef int32_t IntPart __attribute__((vector_size(64 / kParts)));

struct Vec {
  FloatPart part[kParts];
  RF_INLINE float operator[](int lane) const { return part[lane / (kLanes / kParts)][lane % (kLanes / kParts)]; }
};

struct IntVec {
  IntPart part[kParts];
};

#define RF_EACH_PART for (int at = 0; at < kParts; ++at)
#define RF_BINARY(Result, op)                                    \
  RF_INLINE Result operator op(const Vec& a, const Vec& b) {     \
    Result result;                                               \
    RF_EACH_PART result.part[at] = a.part[at] op b.part[at];     \
    return result;                                               \
  }                                                              \
  RF_INLINE Result operator op(const Vec& a, float b) {          \
    Result result;                                               \
    RF_EACH_PART result.part[at] = a.part[at] op(b - FloatPart{}); \
    return result;                                               \
  }                                                              \
  RF_INLINE Result operator op(float a, const Vec& b) {          \
    Result result;                                               \
    RF_EACH_PART result.part[at] = (a - FloatPart{})op b.part[at]; \
    return result;                                               \
  }
RF_BINARY(Vec, +)
RF_BINARY(Vec, -)
RF_BINARY(Vec, *)
RF_BINARY(Vec, /)
RF_BINARY(IntVec, <)
RF_BINARY(IntVec, >)
RF_BINARY(IntVec, <=)
RF_BINARY(IntVec, >=)
#undef RF_BINARY

RF_INLINE Vec operator-(const Vec& a) { return 0.0f - a; }
RF_INLINE Vec& operator+=(Vec& a, const Vec& b) { return a = a + b; }
RF_INLINE Vec& operator-=(Vec& a, const Vec& b) { return a = a - b; }
RF_INLINE Vec& operator*=(Vec& a, const Vec& b) { return a = a * b; }

#define RF_BINARY(op)                                              \
  RF_INLINE IntVec operator op(const IntVec& a, const IntVec& b) { \
    IntVec result;                                                 \
    RF_EACH_PART result.part[at] = a.part[at] op b.part[at];       \
    return result;                                                 \
  }
RF_BINARY(&)
RF_BINARY(|)
RF_BINARY(+)
RF_BINARY(-)
RF_BINARY(<<)
RF_BINARY(<)
RF_BINARY(<=)
#undef RF_BINARY

RF_INLINE IntVec& operator&=(IntVec& a, const IntVec& b) { return a = a & b; }
RF_INLINE IntVec operator&(const IntVec& a, int32_t b) {
  IntVec result;
  RF_EACH_PART result.part[at] = a.part[at] & b;
  return result;
}
RF_INLINE IntVec operator+(const IntVec& a, int32_t b) {
  IntVec result;
  RF_EACH_PART result.part[at] = a.part[at] + b;
  return result;
}
RF_INLINE IntVec operator!=(const IntVec& a, int32_t b) {
  IntVec result;
  RF_EACH_PART result.part[at] = a.part[at] != b;
  return result;
}
RF_INLINE IntVec operator<<(const IntVec& a, int b) {
  IntVec result;
  RF_EACH_PART result.part[at] = a.part[at] << b;
  return result;
}
RF_INLINE IntVec operator>>(const IntVec& a, int b) {
  IntVec result;
  RF_EACH_PART result.part[at] = a.part[at] >> b;
  return result;
}

RF_INLINE Vec select(const IntVec& mask, const Vec& yes, const Vec& no) {
  Vec result;
  RF_EACH_PART result.part[at] = mask.part[at] ? yes.part[at] : no.part[at];
  return result;
}
RF_INLINE IntVec int_bits(const Vec& value) {
  IntVec result;
  RF_EACH_PART result.part[at] = (IntPart)value.part[at];
  return result;
}
RF_INLINE Vec to_float(const IntVec& value) {
  Vec result;
  RF_EACH_PART result.part[at] = __builtin_convertvector(value.part[at], FloatPart);
  return result;
}
RF_INLINE Vec float_bits(const IntVec& value) {
  Vec result;
  RF_EACH_PART result.part[at] = (FloatPart)value.part[at];
  return result;
}

#endif

// Taking zero away leaves every value as it is, so that nothing is left of this but a broadcast.
RF_INLINE Vec splat_vec(float value) { return value - Vec{}; }

#if defined(__AVX512F__)

RF_INLINE Vec load(const float* from) {
  Vec result;
  std::memcpy(&result, from, sizeof(result));
  return result;
}
RF_INLINE void store(float* to, const Vec& value) { std::memcpy(to, &value, sizeof(value)); }

#else

// A copy of several registers at once would go through memory.
RF_INLINE Vec load(const float* from) {
  Vec result;
  RF_EACH_PART std::memcpy(&result.part[at], from + at * (kLanes / kParts), sizeof(FloatPart));
  return result;
}
RF_INLINE void store(float* to, const Vec& value) {
  RF_EACH_PART std::memcpy(to + at * (kLanes / kParts), &value.part[at], sizeof(FloatPart));
}

#endif

// The second where one of them is NaN.
#if defined(__AVX512F__)
RF_INLINE Vec min_vec(Vec a, Vec b) { return (Vec)_mm512_min_ps((__m512)a, (__m512)b); }
RF_INLINE Vec max_vec(Vec a, Vec b) { return (Vec)_mm512_max_ps((__m512)a, (__m512)b); }
#elif defined(__AVX2__)
RF_INLINE Vec min_vec(Vec a, Vec b) {
  RF_EACH_PART a.part[at] = (FloatPart)_mm256_min_ps((__m256)a.part[at], (__m256)b.part[at]);
  return a;
}
RF_INLINE Vec max_vec(Vec a, Vec b) {
  RF_EACH_PART a.part[at] = (FloatPart)_mm256_max_ps((__m256)a.part[at], (__m256)b.part[at]);
  return a;
}
#else
RF_INLINE Vec min_vec(Vec a, Vec b) { return select(a < b, a, b); }
RF_INLINE Vec max_vec(Vec a, Vec b) { return select(a > b, a, b); }
#endif
// The first `lanes` floats; the others repeat the last of them.
RF_INLINE Vec load_some(const float* from, int lanes) {
  if (lanes == kLanes) return load(from);
  alignas(64) float of[kLanes];
  for (int lane = 0; lane < kLanes; ++lane) of[lane] = from[lane < lanes ? lane : lanes - 1];
  return load(of);
}

// The first `count` floats, zeros behind them; and only these written.
RF_INLINE Vec load_first(const float* from, int count) {
  if (count == kLanes) return load(from);
#if defined(__AVX512F__)
  return (Vec)_mm512_maskz_loadu_ps(static_cast<__mmask16>((1u << count) - 1u), from);
#else
  alignas(64) float of[kLanes] = {};
  for (int lane = 0; lane < count; ++lane) of[lane] = from[lane];
  return load(of);
#endif
}
RF_INLINE void store_first(float* to, const Vec& value, int count) {
  if (count == kLanes) return store(to, value);
#if defined(__AVX512F__)
  _mm512_mask_storeu_ps(to, static_cast<__mmask16>((1u << count) - 1u), (__m512)value);
#else
  alignas(64) float of[kLanes];
  store(of, value);
  for (int lane = 0; lane < count; ++lane) to[lane] = of[lane];
#endif
}

#if defined(__AVX512F__)
// Sixteen of the thirty-two floats of `low` and `high`, from the `by`-th on.
template <int by>
RF_INLINE Vec shifted(Vec low, Vec high) {
  return (Vec)_mm512_alignr_epi32((__m512i)high, (__m512i)low, by);
}
#endif

// Of floats that are not negative, whose bits order as they do; the units that compare integers are less in demand.
RF_INLINE Vec min_of_positive(const Vec& a, const Vec& b) {
#if defined(__AVX512F__)
  return (Vec)_mm512_min_epi32((__m512i)a, (__m512i)b);
#else
  return min_vec(a, b);
#endif
}
RF_INLINE Vec clamp_vec(Vec value, Vec low, Vec high) { return min_vec(max_vec(value, low), high); }

RF_INLINE Vec sqrt_vec(Vec value) {
#if defined(__AVX512F__)
  return (Vec)_mm512_sqrt_ps((__m512)value);
#else
  alignas(64) float lanes[kLanes];
  store(lanes, value);
  for (int lane = 0; lane < kLanes; ++lane) lanes[lane] = __builtin_sqrtf(lanes[lane]);
  return load(lanes);
#endif
}

// The bits of a comparison's lanes.
RF_INLINE uint32_t bits_of(IntVec mask) {
#if defined(__AVX512F__)
  return _mm512_movepi32_mask((__m512i)mask);
#elif defined(__AVX2__)
  __m256 half[2];
  std::memcpy(half, &mask, sizeof(mask));
  return static_cast<uint32_t>(_mm256_movemask_ps(half[0])) | (static_cast<uint32_t>(_mm256_movemask_ps(half[1])) << 8);
#else
  uint32_t bits = 0;
  int32_t lanes[kLanes];
  std::memcpy(lanes, &mask, sizeof(mask));
  for (int lane = 0; lane < kLanes; ++lane) bits |= (static_cast<uint32_t>(lanes[lane]) & 1u) << lane;
  return bits;
#endif
}

}  // namespace
