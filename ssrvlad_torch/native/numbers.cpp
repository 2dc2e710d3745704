// The sums and loops of numbers.hpp.

#include "numbers.hpp"

namespace places {

namespace {
// The sum of a term of each number, in lanes that a processor takes at once.
template <typename Number = double, typename Term>
SSRVLAD_INLINE Number summed(Size count, Term term) {
  Number lanes[LANES] = {};
  Size i = 0;
  for (; i + LANES <= count; i += LANES)
    for (Size lane = 0; lane < LANES; ++lane) lanes[lane] += term(i + lane);
  for (Size lane = 0; i < count; ++i, ++lane) lanes[lane] += term(i);
  return folded(lanes);
}
// A float as an integer of the same order, and back: of these compilers make vectors of a search for the highest.
SSRVLAD_INLINE std::int32_t ordered(std::int32_t bits) { return bits ^ ((bits >> 31) & 0x7fffffff); }

SSRVLAD_INLINE std::int32_t ordered(float value) {
  std::int32_t bits;
  std::memcpy(&bits, &value, sizeof bits);
  return ordered(bits);
}

float of_ordered(std::int32_t number) {
  const std::int32_t bits = ordered(number);
  float value;
  std::memcpy(&value, &bits, sizeof value);
  return value;
}
}  // namespace

double sum(const float *values, Size count) {
  return on_cpu([=](auto) {
    return summed(count, [=](Size i) { return static_cast<double>(values[i]); });
  });
}

double quick_sum(const float *values, Size count) {
  constexpr Size BLOCK = 512;
  return on_cpu([=](auto) {
    double total = 0;
    Size first = 0;
    for (; first + 2 * BLOCK <= count; first += 2 * BLOCK) {  // two at once: a sum waits for the one before
      float lanes[2][LANES] = {};
      for (Size i = first; i < first + BLOCK; i += LANES)
        for (Size lane = 0; lane < LANES; ++lane) {
          lanes[0][lane] += values[i + lane];
          lanes[1][lane] += values[BLOCK + i + lane];
        }
      for (float *sums : lanes) total += static_cast<double>(folded(sums));
    }
    for (; first < count; first += BLOCK)
      total += static_cast<double>(
          summed<float>(std::min(BLOCK, count - first), [=](Size i) { return values[first + i]; }));
    return total;
  });
}

double dot(const float *values, const float *others, Size count) {
  return on_cpu([=](auto) {
    return summed(count, [=](Size i) { return static_cast<double>(values[i]) * static_cast<double>(others[i]); });
  });
}

double dot(const double *values, const double *others, Size count) {
  return on_cpu([=](auto) { return summed(count, [=](Size i) { return values[i] * others[i]; }); });
}

void add(float *target, const float *values, float factor, Size count) {
  on_cpu([=](auto) { for (Size i = 0; i < count; ++i) target[i] += factor * values[i]; });
}

void raise(float *target, float value, Size count) {
  on_cpu([=](auto) { for (Size i = 0; i < count; ++i) target[i] += value; });
}

double multiply(float *target, const float *values, Size count) {
  on_cpu([=](auto) { for (Size i = 0; i < count; ++i) target[i] *= values[i]; });
  return quick_sum(target, count);
}

void scored(float *target, const float *values, float least, const float *scores, Size count) {
  on_cpu([=](auto) {
    for (Size i = 0; i < count; ++i) {
      const float none = scores[i] == NONE ? NONE : 0;  // added: a choice would be a branch
      target[i] = (values[i] > least ? values[i] : least) + none;
    }
  });
}

void scale(float *target, float factor, Size count) {
  on_cpu([=](auto) { for (Size i = 0; i < count; ++i) target[i] *= factor; });
}

float highest(const float *values, Size count) {
  return of_ordered(on_cpu([=](auto) {
    std::int32_t high = ordered(NONE);
    for (Size i = 0; i < count; ++i) high = std::max(high, ordered(values[i]));
    return high;
  }));
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
      near[i] = static_cast<float>(none - log_of<13>(far > limits.least ? far : limits.least));
    }
  });
}

Spread Spread::of(const float *near, Size count) {
  if (std::find(near, near + count, NONE) != near + count) {
    Floats others(static_cast<std::size_t>(count));
    const auto end = std::remove_copy(near, near + count, others.begin(), NONE);
    return of(others.data(), end - others.begin());
  }
  if (count == 0) return {};
  return on_cpu([=](auto) -> Spread {
    std::int32_t low = ordered(-NONE), high = ordered(NONE);
    for (Size i = 0; i < count; ++i) low = std::min(low, ordered(near[i])), high = std::max(high, ordered(near[i]));
    if (of_ordered(high) - of_ordered(low) <= MIN_SPREAD) return {static_cast<double>(of_ordered(low)), MIN_SPREAD};
    const auto number = static_cast<double>(count);
    const double mean = summed(count, [=](Size i) { return static_cast<double>(near[i]); }) / number;
    const double squares = summed(count, [=](Size i) {
      const double away = static_cast<double>(near[i]) - mean;
      return away * away;
    });
    return {mean, std::max(MIN_SPREAD, std::sqrt(squares / number))};
  });
}

void deviations(const float *near, Size count, const Spread &spread, float *z) {
  const double mean = spread.mean, factor = 1 / spread.deviation;
  on_cpu([=](auto) {
    for (Size i = 0; i < count; ++i)
      z[i] = near[i] == NONE ? 0.0F : static_cast<float>((static_cast<double>(near[i]) - mean) * factor);
  });
}

}  // namespace places
