// Numbers that are the same on every processor: exponentials and logarithms in plain arithmetic, and
// sums in a fixed order. The operations of the C library differ in the last bit.

#ifndef SSRVLAD_NUMBERS_HPP
#define SSRVLAD_NUMBERS_HPP

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>

// Loops over many numbers are compiled for several processors; the loader picks the best version.
#if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__) && \
    !defined(SSRVLAD_ONE_TARGET)
#define SSRVLAD_CLONES __attribute__((target_clones("avx512f", "avx2", "default")))
#else
#define SSRVLAD_CLONES
#endif

#if defined(__GNUC__)
#define SSRVLAD_INLINE inline __attribute__((always_inline))
#else
#define SSRVLAD_INLINE inline
#endif

namespace places {

using Size = std::int64_t;

constexpr float NONE = -std::numeric_limits<float>::infinity();  // the score of what is no match
constexpr double ROUNDING = 1e-6;    // of a cosine of 480 float32 products
constexpr double MIN_SPREAD = 1e-6;
constexpr double MAX_LOG = 50;       // frames that equal their rows must not overflow

// A double that, added, leaves whole numbers alone, in its lowest bits.
constexpr double WHOLE = 6755399441055744.0;
constexpr std::uint64_t WHOLE_BITS = 0x4338000000000000;

// The logarithm of a positive normal number.
inline double log_of(double value) {
  std::uint64_t bits;
  std::memcpy(&bits, &value, 8);
  constexpr std::uint64_t ROOT = 0x3fe6a09e667f3bcd;  // sqrt(1/2): mantissas from it to sqrt(2)
  const std::uint64_t biased = (bits - ROOT + (std::uint64_t{1023} << 52)) >> 52;
  bits -= (biased - 1023) << 52;
  double mantissa, exponent;
  std::memcpy(&mantissa, &bits, 8);
  bits = WHOLE_BITS + biased;  // as a double without the conversion that old processors lack
  std::memcpy(&exponent, &bits, 8);
  exponent -= WHOLE + 1023;
  const double s = (mantissa - 1) / (mantissa + 1), q = s * s;
  double series = 1.0 / 23;
  for (int odd = 21; odd > 0; odd -= 2) series = series * q + 1.0 / odd;
  return exponent * 0.693147180369123816490 + (2 * s * series + exponent * 1.90821492927058770002e-10);
}

// The exponential of a number from -700 to 700; 0 below, and for -inf.
inline double exp_of(double value) {
  const double x = std::min(std::max(value, -701.0), 701.0);
  const double shifted = x * 1.44269504088896340736 + WHOLE;  // to the nearest integer
  const double whole = shifted - WHOLE;
  const double r = (x - whole * 0.693147180369123816490) - whole * 1.90821492927058770002e-10;
  double series = 0, factorial = 87178291200;
  for (int term = 14; term > 0; factorial /= term--) series = (series + 1 / factorial) * r;
  series += 1;
  std::uint64_t bits;
  std::memcpy(&bits, &shifted, 8);
  bits = (bits - WHOLE_BITS + 1023) << 52;
  double power;
  std::memcpy(&power, &bits, 8);
  return series * power * (value < -700 ? 0.0 : 1.0);
}

// Minus the logarithm of 1 - cosine; -inf for -inf.
inline double nearness(double score) {
  return score == -std::numeric_limits<double>::infinity()
             ? score
             : -log_of(std::max(1 - score, ROUNDING));
}

// Sums in a fixed order, in double precision.
double sum(const float *values, Size count);
double dot(const float *some, const float *others, Size count);

// Adds values times a factor to a target; multiplies a target by values; by a factor.
void add(float *target, const float *values, float factor, Size count);
void multiply(float *target, const float *values, Size count);
void scale(float *target, float factor, Size count);

// Nearness of scores, in single precision; -inf for -inf.
void nearness(const float *scores, Size count, float *near);

// Mean and standard deviation of nearness, without values of -inf; (0, MIN_SPREAD) without values.
struct Spread {
  double mean = 0, deviation = MIN_SPREAD;
  // Of equal values the deviation is MIN_SPREAD.
  static Spread of(const float *near, Size count);
};

}  // namespace places

#endif
