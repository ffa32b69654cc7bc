// Arithmetic on sixteen floats at a time: masks, fused products, sums over lanes, powers of two.
#pragma once

#include "core/vector_types.hpp"

namespace {

// Lanes that are chosen, in the form that costs least.
#if defined(__AVX512F__)
typedef __mmask16 Mask;
RF_INLINE Mask at_least(Vec a, Vec b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_GE_OQ); }
RF_INLINE Mask below(Vec a, Vec b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_LT_OQ); }
RF_INLINE Vec keep(Mask mask, Vec value) { return (Vec)_mm512_maskz_mov_ps(mask, (__m512)value); }
RF_INLINE Vec choose(Mask mask, Vec yes, Vec no) { return (Vec)_mm512_mask_mov_ps((__m512)no, mask, (__m512)yes); }
RF_INLINE Mask both(Mask a, Mask b) { return a & b; }
RF_INLINE bool any(Mask mask) { return mask != 0; }
#else
typedef IntVec Mask;
RF_INLINE Mask at_least(const Vec& a, const Vec& b) { return a >= b; }
RF_INLINE Mask below(const Vec& a, const Vec& b) { return a < b; }
RF_INLINE Vec keep(const Mask& mask, const Vec& value) { return float_bits(mask & int_bits(value)); }
RF_INLINE Vec choose(const Mask& mask, const Vec& yes, const Vec& no) { return select(mask, yes, no); }
RF_INLINE Mask both(const Mask& a, const Mask& b) { return a & b; }
RF_INLINE bool any(const Mask& mask) { return bits_of(mask) != 0; }
#endif

// a b + c and c - a b, rounded once where the machine can.
#if defined(__AVX512F__)
RF_INLINE Vec mul_add(Vec a, Vec b, Vec c) { return (Vec)_mm512_fmadd_ps((__m512)a, (__m512)b, (__m512)c); }
RF_INLINE Vec mul_from(Vec a, Vec b, Vec c) { return (Vec)_mm512_fnmadd_ps((__m512)a, (__m512)b, (__m512)c); }
#elif defined(__AVX2__)
RF_INLINE Vec mul_add(Vec a, const Vec& b, const Vec& c) {
  RF_EACH_PART a.part[at] = (FloatPart)_mm256_fmadd_ps((__m256)a.part[at], (__m256)b.part[at], (__m256)c.part[at]);
  return a;
}
RF_INLINE Vec mul_from(Vec a, const Vec& b, const Vec& c) {
  RF_EACH_PART a.part[at] = (FloatPart)_mm256_fnmadd_ps((__m256)a.part[at], (__m256)b.part[at], (__m256)c.part[at]);
  return a;
}
#else
RF_INLINE Vec mul_add(const Vec& a, const Vec& b, const Vec& c) { return a * b + c; }
RF_INLINE Vec mul_from(const Vec& a, const Vec& b, const Vec& c) { return c - a * b; }
#endif

// 1 / x for x from 0.01 to 1.
#if defined(__AVX512F__)
RF_INLINE Vec reciprocal(Vec x) {
  const Vec guess = (Vec)_mm512_rcp14_ps((__m512)x);
  return mul_add(guess, mul_from(x, guess, splat_vec(1.0f)), guess);
}
#else
RF_INLINE Vec reciprocal(const Vec& x) { return 1.0f / x; }
#endif

// 1 / sqrt(x) for x that is not below the least normal float; the least there is for an infinite x.
#if defined(__AVX512F__)
RF_INLINE Vec inverse_sqrt(Vec x) {
  const Vec bounded = min_vec(x, splat_vec(3.4e38f)), guess = (Vec)_mm512_rsqrt14_ps((__m512)bounded);
  return mul_add(guess * 0.5f, mul_from(bounded * guess, guess, splat_vec(1.0f)), guess);
}
#else
RF_INLINE Vec inverse_sqrt(const Vec& x) { return 1.0f / sqrt_vec(x); }
#endif

// A vector on its way to the sum of its lanes: where it helps, its halves are added already.
#if defined(__AVX2__)
typedef __m256 Half;
#if defined(__AVX512F__)
RF_INLINE Half halves_added(Vec value) {
  return _mm512_castps512_ps256((__m512)value) + _mm512_extractf32x8_ps((__m512)value, 1);
}
#else
RF_INLINE Half halves_added(const Vec& value) { return (__m256)(value.part[0] + value.part[1]); }
#endif
#else
typedef Vec Half;
RF_INLINE Half halves_added(const Vec& value) { return value; }
#endif

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

// The sums of all lanes of each of four vectors.
RF_INLINE void four_sums(const Half* value, float* out) {
#if defined(__AVX2__)
  const __m256 a = value[0], b = value[1], c = value[2], d = value[3];
  const __m256 ab = _mm256_unpacklo_ps(a, b) + _mm256_unpackhi_ps(a, b);
  const __m256 cd = _mm256_unpacklo_ps(c, d) + _mm256_unpackhi_ps(c, d);
  const __m256 sums = _mm256_shuffle_ps(ab, cd, 0x44) + _mm256_shuffle_ps(ab, cd, 0xee);
  _mm_storeu_ps(out, _mm256_castps256_ps128(sums) + _mm256_extractf128_ps(sums, 1));
#else
  for (int at = 0; at < 4; ++at) out[at] = sum_of(value[at]);
#endif
}

// The sums of all lanes of N vectors, whole fours of them.
template <int N>
RF_INLINE void sums_of(const Vec* value, float* out) {
  static_assert(N % 4 == 0);
  for (int at = 0; at < N; at += 4) {
    const Half halves[4] = {halves_added(value[at]), halves_added(value[at + 1]), halves_added(value[at + 2]),
                            halves_added(value[at + 3])};
    four_sums(halves, out + at);
  }
}

RF_INLINE IntVec to_int(const Vec& value) {  // towards zero
#if defined(__AVX512F__)
  return __builtin_convertvector(value, IntVec);
#else
  IntVec result;
  RF_EACH_PART result.part[at] = __builtin_convertvector(value.part[at], IntPart);
  return result;
#endif
}
RF_INLINE void store_ints(int32_t* to, const IntVec& value) { std::memcpy(to, &value, sizeof(value)); }
RF_INLINE IntVec splat_int(int32_t value) { return IntVec{} + value; }

// Four floats that lie side by side.
typedef float Four __attribute__((vector_size(16)));

RF_INLINE Four load_four(const float* from) {
  Four result;
  std::memcpy(&result, from, sizeof(result));
  return result;
}
RF_INLINE void store_four(float* to, Four value) { std::memcpy(to, &value, sizeof(value)); }

// 2^x for x from -120 to 1, with a relative error near 3e-7; anything at all for smaller x.
#if defined(__AVX512F__)
// x = n + j/16 + f: the sixteenths of an octave come from a register, 2^f for |f| <= 1/32 from a parabola. The table's
// bits already lack what j adds to them when n and j are shifted into the exponent together.
RF_INLINE Vec exp2_vec(Vec x) {
  const IntVec table = {0x3f800000, 0x3f7daac3, 0x3f7b95c2, 0x3f79c3d3, 0x3f7837f0, 0x3f76f532, 0x3f75fed7,
                        0x3f75583f, 0x3f7504f3, 0x3f7508a4, 0x3f75672a, 0x3f76248c, 0x3f7744fd, 0x3f78ccdf,
                        0x3f7ac0c7, 0x3f7d257d};
  const Vec magic = splat_vec(786432.0f);  // 1.5 * 2^19: adding it rounds to sixteenths
  const Vec shifted = x + magic;
  const Vec fraction = x - (shifted - magic);
  const Vec p = mul_add(mul_add(splat_vec(0.240226507f), fraction, splat_vec(0.693187834f)), fraction, splat_vec(1.0f));
  const IntVec scale = (IntVec)_mm512_permutexvar_epi32((__m512i)shifted, (__m512i)table) + (int_bits(shifted) << 19);
  return float_bits(scale) * p;
}
#else
RF_INLINE Vec exp2_vec(const Vec& x) {
  const Vec magic = splat_vec(12582912.0f);  // 1.5 * 2^23: adding it rounds to an integer
  const Vec shifted = x + magic;
  const Vec fraction = x - (shifted - magic);
  Vec p = splat_vec(1.339887440e-3f);
  p = mul_add(p, fraction, splat_vec(9.618437357e-3f));
  p = mul_add(p, fraction, splat_vec(5.550332548e-2f));
  p = mul_add(p, fraction, splat_vec(2.402264689e-1f));
  p = mul_add(p, fraction, splat_vec(6.931472028e-1f));
  p = mul_add(p, fraction, splat_vec(1.0f));
  return float_bits(int_bits(p) + (int_bits(shifted) << 23));
}
#endif

}  // namespace
