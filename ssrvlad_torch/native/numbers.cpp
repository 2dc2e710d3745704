// The sums and loops of numbers.hpp.

#include "numbers.hpp"

namespace places {

namespace {
// The sum of a term of each number, in lanes that a processor takes at once.
template <typename Term>
SSRVLAD_INLINE double summed(Size count, Term term) {
  double lanes[LANES] = {};
  Size i = 0;
  for (; i + LANES <= count; i += LANES)
    for (Size lane = 0; lane < LANES; ++lane) lanes[lane] += term(i + lane);
  for (Size lane = 0; i < count; ++i, ++lane) lanes[lane] += term(i);
  return folded(lanes);
}
}  // namespace

double sum(const float *values, Size count) {
  return on_cpu([=](auto) {
    return summed(count, [=](Size i) { return static_cast<double>(values[i]); });
  });
}

double dot(const float *values, const float *others, Size count) {
  return on_cpu([=](auto) {
    return summed(count, [=](Size i) { return static_cast<double>(values[i]) * static_cast<double>(others[i]); });
  });
}

void add(float *target, const float *values, float factor, Size count) {
  on_cpu([=](auto) { for (Size i = 0; i < count; ++i) target[i] += factor * values[i]; });
}

void add_product(float *target, const float *values, const float *others, Size count) {
  on_cpu([=](auto) { for (Size i = 0; i < count; ++i) target[i] += values[i] * others[i]; });
}

void raise(float *target, float value, Size count) {
  on_cpu([=](auto) { for (Size i = 0; i < count; ++i) target[i] += value; });
}

void multiply(float *target, const float *values, float factor, Size count) {
  on_cpu([=](auto) { for (Size i = 0; i < count; ++i) target[i] *= values[i] * factor; });
}

void scale(float *target, float factor, Size count) {
  on_cpu([=](auto) { for (Size i = 0; i < count; ++i) target[i] *= factor; });
}

float highest(const float *values, Size count) {
  return on_cpu([=](auto) {
    float lanes[LANES];
    std::fill_n(lanes, LANES, NONE);
    Size i = 0;
    for (; i + LANES <= count; i += LANES)
      for (Size lane = 0; lane < LANES; ++lane)
        lanes[lane] = values[i + lane] > lanes[lane] ? values[i + lane] : lanes[lane];
    for (; i < count; ++i) lanes[0] = std::max(lanes[0], values[i]);
    return *std::max_element(lanes, lanes + LANES);
  });
}

// Values that are not finite make the sum NaN.
bool are_finite(const float *values, Size count) {
  return on_cpu([=](auto) { return summed(count, [=](Size i) { return static_cast<double>(values[i] * 0); }) == 0; });
}

void nearness(const float *scores, Size count, float *near, Limits limits) {
  on_cpu([=](auto) {
    for (Size i = 0; i < count; ++i) {
      const double far = 1 - static_cast<double>(scores[i]);
      const double none = scores[i] == NONE ? limits.none : 0;  // added: a choice would be a branch
      near[i] = static_cast<float>(none - log_of(far > limits.least ? far : limits.least));
    }
  });
}

Spread Spread::of(const float *near, Size count) {
  return on_cpu([=](auto) -> Spread {
    const auto total = [=](auto term) {
      return summed(count, [=](Size i) { return near[i] == NONE ? 0.0 : term(static_cast<double>(near[i])); });
    };
    const double number = total([](double) { return 1.0; });
    if (number == 0) return {};
    float low = -NONE;
    for (Size i = 0; i < count; ++i) low = near[i] != NONE && near[i] < low ? near[i] : low;
    if (highest(near, count) - low <= MIN_SPREAD) return {static_cast<double>(low), MIN_SPREAD};
    const double mean = total([](double value) { return value; }) / number;
    const double squares = total([=](double value) { return (value - mean) * (value - mean); });
    return {mean, std::max(MIN_SPREAD, std::sqrt(squares / number))};
  });
}

void deviations(const float *near, Size count, const Spread &spread, float *z) {
  const double mean = spread.mean, deviation = spread.deviation;
  on_cpu([=](auto) {
    for (Size i = 0; i < count; ++i)
      z[i] = near[i] == NONE ? 0.0F : static_cast<float>((static_cast<double>(near[i]) - mean) / deviation);
  });
}

}  // namespace places
