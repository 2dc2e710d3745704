// Numbers that are the same on every processor: exponentials and logarithms in plain arithmetic, and
// sums in a fixed order. The operations of the C library differ in the last bit.

#ifndef SSRVLAD_NUMBERS_HPP
#define SSRVLAD_NUMBERS_HPP

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <deque>
#include <limits>
#include <memory>
#include <vector>

#include "cpu.hpp"
#include "model.hpp"

namespace places {

using Size = std::int64_t;

constexpr float NONE = -std::numeric_limits<float>::infinity();  // the score of what is no match
constexpr Size MOST_NUMBERS = Size{1} << 31;  // of a descriptor from all anchors, and its signs
constexpr double ROUNDING = 1e-6;    // of a cosine of 480 float32 products
constexpr double MIN_SPREAD = 1e-6;

SSRVLAD_INLINE std::uint64_t bits_of(double value) {
  std::uint64_t bits;
  std::memcpy(&bits, &value, 8);
  return bits;
}

SSRVLAD_INLINE double of_bits(std::uint64_t bits) {
  double value;
  std::memcpy(&value, &bits, 8);
  return value;
}

// The logarithm of a positive normal number, by a series of odd powers: to 13 it is exact in single precision. Like
// `exp_of` it takes only steps of which compilers make vectors.
template <int ODD = 23>
SSRVLAD_INLINE double log_of(double value) {
  constexpr std::uint64_t ROOT = 0x3fe6a09e667f3bcd;  // sqrt(1/2): mantissas from it to sqrt(2)
  const std::uint64_t bits = bits_of(value), power = (bits - ROOT + (1024ULL << 52)) >> 52;
  const double exponent = of_bits(power | 0x4330000000000000) - (4503599627370496.0 + 1024);
  const double mantissa = of_bits(bits - (power << 52) + (1024ULL << 52));
  const double s = (mantissa - 1) / (mantissa + 1), q = s * s;
  double series = 1.0 / ODD;
  for (int odd = ODD - 2; odd > 0; odd -= 2) series = series * q + 1.0 / odd;
  return exponent * 0.693147180369123816490 +
         (2 * s * series + exponent * 1.90821492927058770002e-10);
}

// The exponential of a number of at most 700; 0 below -700, and for -inf. Ten terms are exact in single precision.
template <int TERMS = 14>
SSRVLAD_INLINE double exp_of(double value) {
  const double shifted = value * 1.44269504088896340736 + 6755399441055744.0;  // to a whole number
  const double whole = shifted - 6755399441055744.0;
  const double r = (value - whole * 0.693147180369123816490) - whole * 1.90821492927058770002e-10;
  double series = 1;
  for (int term = TERMS; term > 0; --term) series = series * (r * (1.0 / term)) + 1;
  const double found = series * of_bits((bits_of(shifted) + 1023) << 52);
  return of_bits(bits_of(found) & ((bits_of(value + 700) >> 63) - 1));
}

// Memory that is not set before it is written.
template <typename Number>
struct Unset : std::allocator<Number> {
  template <typename Other>
  struct rebind {
    using other = Unset<Other>;
  };
  template <typename Other, typename... Values>
  void construct(Other *number, Values &&...values) {
    if constexpr (sizeof...(Values) == 0)
      ::new (static_cast<void *>(number)) Other;
    else
      ::new (static_cast<void *>(number)) Other(std::forward<Values>(values)...);
  }
};
using Floats = std::vector<float, Unset<float>>;

constexpr Size LANES = 16;  // numbers that are taken at once; a processor of fewer makes several of them

// The sum of all lanes.
template <typename Number>
SSRVLAD_INLINE Number folded(Number *lanes) {
  for (Size width = LANES / 2; width; width /= 2)
    for (Size lane = 0; lane < width; ++lane) lanes[lane] += lanes[lane + width];
  return lanes[0];
}

// Minus the logarithm of 1 - cosine; -inf for -inf.
inline double nearness(double score) {
  return score == -std::numeric_limits<double>::infinity()
             ? score
             : -log_of(std::max(1 - score, ROUNDING));
}

// Appends to the last values, of which so many are kept.
template <typename Number>
void push(std::deque<Number> &values, Number value, Size most) {
  values.push_back(value);
  if (static_cast<Size>(values.size()) > most) values.pop_front();
}

// The middle of values, or the mean of the two in the middle; 0 without values.
template <typename Number>
double median(std::vector<Number> values) {
  if (values.empty()) return 0;
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  const double upper = static_cast<double>(*middle);
  if (values.size() % 2) return upper;
  return (static_cast<double>(*std::max_element(values.begin(), middle)) + upper) / 2;
}

// Sums in a fixed order, in double precision; the quick one adds some hundred values in single precision first.
double sum(const float *values, Size count);
double quick_sum(const float *values, Size count);
double dot(const float *values, const float *others, Size count);
double dot(const double *values, const double *others, Size count);

// Adds to a target values times a factor; one value. Multiplies a target by values, and returns its sum as of
// `quick_sum`; by a factor.
void add(float *target, const float *values, float factor, Size count);
void raise(float *target, float value, Size count);
double multiply(float *target, const float *values, Size count);
void scale(float *target, float factor, Size count);
// Makes a target of values, at least so high, NONE where there is no score.
void scored(float *target, const float *values, float least, const float *scores, Size count);

// The highest of values; NONE without values.
float highest(const float *values, Size count);

bool are_finite(const float *values, Size count);

// Limits of a loop that are no constants to the compiler: else it makes branches of them, no vectors.
struct Limits {
  double least = ROUNDING, most = MODEL.most_log, none = static_cast<double>(NONE);
};

// Nearness of scores, in single precision; -inf for -inf.
void nearness(const float *scores, Size count, float *near, Limits limits = {});

// Mean and standard deviation of nearness, without values of -inf; (0, MIN_SPREAD) without values.
struct Spread {
  double mean = 0, deviation = MIN_SPREAD;
  // Of equal values the deviation is MIN_SPREAD.
  static Spread of(const float *near, Size count);
  double z(float value) const { return (static_cast<double>(value) - mean) / deviation; }
};

// By how many deviations values differ from the mean; 0 for -inf.
void deviations(const float *near, Size count, const Spread &spread, float *z);

}  // namespace places

#endif
