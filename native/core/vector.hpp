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
    RF_EACH_PART result.part[at] = a.part[at] op(FloatPart{} + b); \
    return result;                                               \
  }                                                              \
  RF_INLINE Result operator op(float a, const Vec& b) {          \
    Result result;                                               \
    RF_EACH_PART result.part[at] = (FloatPart{} + a)op b.part[at]; \
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
RF_BINARY(+)
RF_BINARY(-)
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

RF_INLINE Vec splat_vec(float value) { return Vec{} + value; }

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

RF_INLINE bool any_positive(const Vec& value) {
#if defined(__AVX512F__)
  return _mm512_cmp_ps_mask((__m512)value, _mm512_setzero_ps(), _CMP_GT_OQ) != 0;
#else
  return bits_of(value > 0.0f) != 0;
#endif
}

// The sum of all lanes, always added in the same order.
RF_INLINE float sum_of(Vec value) {
  typedef float Vec8 __attribute__((vector_size(32)));
  typedef float Vec4 __attribute__((vector_size(16)));
  Vec8 low, high;
  std::memcpy(&low, &value, 32);
  std::memcpy(&high, reinterpret_cast<const char*>(&value) + 32, 32);
  const Vec8 eight = low + high;
  Vec4 a, b;
  std::memcpy(&a, &eight, 16);
  std::memcpy(&b, reinterpret_cast<const char*>(&eight) + 16, 16);
  const Vec4 four = a + b;
  return (four[0] + four[2]) + (four[1] + four[3]);
}

RF_INLINE float largest_of(const Vec& value) {
  alignas(64) float lanes[kLanes];
  store(lanes, value);
  float largest = lanes[0];
  for (int lane = 1; lane < kLanes; ++lane) largest = lanes[lane] > largest ? lanes[lane] : largest;
  return largest;
}

// The sums of all lanes of N vectors, four at a time.
template <int N>
RF_INLINE void sums_of(const Vec* value, float* out) {
  int done = 0;
#if defined(__AVX512F__)
  const __m512i firsts = _mm512_set_epi32(12, 8, 4, 0, 12, 8, 4, 0, 12, 8, 4, 0, 12, 8, 4, 0);
  for (; done + 4 <= N; done += 4) {
    const __m512 a = (__m512)value[done], b = (__m512)value[done + 1];
    const __m512 c = (__m512)value[done + 2], d = (__m512)value[done + 3];
    const __m512 ab = _mm512_shuffle_f32x4(a, b, 0x44) + _mm512_shuffle_f32x4(a, b, 0xee);
    const __m512 cd = _mm512_shuffle_f32x4(c, d, 0x44) + _mm512_shuffle_f32x4(c, d, 0xee);
    const __m512 quads = _mm512_shuffle_f32x4(ab, cd, 0x88) + _mm512_shuffle_f32x4(ab, cd, 0xdd);
    const __m512 pairs = quads + _mm512_permute_ps(quads, 0x4e);
    const __m512 sums = pairs + _mm512_permute_ps(pairs, 0xb1);
    _mm_storeu_ps(out + done, _mm512_castps512_ps128(_mm512_permutexvar_ps(firsts, sums)));
  }
#elif defined(__AVX2__)
  for (; done + 4 <= N; done += 4) {
    __m256 eight[4];
    for (int at = 0; at < 4; ++at) eight[at] = (__m256)(value[done + at].part[0] + value[done + at].part[1]);
    const __m256 sums = _mm256_hadd_ps(_mm256_hadd_ps(eight[0], eight[1]), _mm256_hadd_ps(eight[2], eight[3]));
    _mm_storeu_ps(out + done, _mm256_castps256_ps128(sums) + _mm256_extractf128_ps(sums, 1));
  }
#endif
  for (; done < N; ++done) out[done] = sum_of(value[done]);
}

// 2^x for x <= 1 with a relative error near 2e-7; 2^-125 below that.
RF_INLINE Vec exp2_vec(Vec x) {
  const Vec scaled = max_vec(x, splat_vec(-125.0f));
  const Vec magic = splat_vec(12582912.0f);  // 1.5 * 2^23: adding it rounds to an integer
  const Vec shifted = scaled + magic;
  const Vec fraction = scaled - (shifted - magic);
  Vec p = splat_vec(1.339887440e-3f);
  p = p * fraction + 9.618437357e-3f;
  p = p * fraction + 5.550332548e-2f;
  p = p * fraction + 2.402264689e-1f;
  p = p * fraction + 6.931472028e-1f;
  p = p * fraction + 1.0f;
  return float_bits(int_bits(p) + (int_bits(shifted) << 23));
}

}  // namespace
