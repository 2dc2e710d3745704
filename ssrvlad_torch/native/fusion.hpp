// What scores of several channels have in common when they become one: of a drive, of a sweep, of a stream.

#ifndef SSRVLAD_FUSION_HPP
#define SSRVLAD_FUSION_HPP

#include <numeric>
#include <utility>
#include <vector>

#include "filter.hpp"

namespace places {

// Mean and deviation of nearness, also of values that are nearly equal; 0 without values.
inline Spread plain_spread(const float *near, Size count) {
  double total = 0, squares = 0;
  Size known = 0;
  for (Size i = 0; i < count; ++i)
    if (near[i] != NONE) total += static_cast<double>(near[i]), ++known;
  const double mean = total / static_cast<double>(std::max<Size>(1, known));
  for (Size i = 0; i < count; ++i)
    if (near[i] != NONE) squares += (static_cast<double>(near[i]) - mean) * (static_cast<double>(near[i]) - mean);
  return {mean, std::sqrt(squares / static_cast<double>(std::max<Size>(1, known)))};
}

// Adds a channel's weighted z-scores of nearness to sums; nothing where a row has no score.
inline void add_scaled(const float *near, Size count, double mean, double factor, double *sums) {
  on_cpu([=](auto) {
    for (Size row = 0; row < count; ++row)
      sums[row] += near[row] == NONE ? 0 : (static_cast<double>(near[row]) - mean) * factor;
  });
}

// Fills the weighted mean of z-scores of nearness by several channels, as cosines; NONE where no channel has a score.
inline void fuse(const std::vector<std::vector<float>> &near, const std::vector<Spread> &spreads,
                 const std::vector<double> &weights, std::vector<double> &z, float *scores) {
  const auto rows = static_cast<Size>(near.front().size());
  z.assign(rows, 0);
  std::fill_n(scores, rows, NONE);
  double mean = 0, deviation = 0;
  for (std::size_t number = 0; number < near.size(); ++number) {
    const Spread &spread = spreads[number];
    add_scaled(near[number].data(), rows, spread.mean, weights[number] / std::max(spread.deviation, MIN_SPREAD), z.data());
    for (Size row = 0; row < rows; ++row) scores[row] = std::max(near[number][row], scores[row]);  // a NaN stays one
    mean += weights[number] * spread.mean;
    deviation += weights[number] * spread.deviation;
  }
  on_cpu([=, z = z.data()](auto) {
    for (Size row = 0; row < rows; ++row) {
      const float cosine = static_cast<float>(1 - exp_of(-(mean + deviation * z[row])));
      scores[row] = scores[row] == NONE ? NONE : cosine;
    }
  });
}

// The weights of channels, whose sum is 1, by their trust and by how far they led; where none leads, trust decides.
inline std::vector<double> weights_of(const std::vector<double> &trust, const std::vector<double> &leads) {
  std::vector<double> weights = trust;
  for (std::size_t number = 0; number < trust.size(); ++number) weights[number] *= std::max(0.0, leads[number]);
  if (!(std::accumulate(weights.begin(), weights.end(), 0.0) > 0)) weights = trust;
  const double sum = std::accumulate(weights.begin(), weights.end(), 0.0);
  for (double &weight : weights) weight /= sum;
  return weights;
}

// The highest of values, and the highest that is not around it, from the first of two places to before the
// second; -infinity without one.
template <typename Number, typename Around>
std::pair<Number, Number> leading(const Number *values, Size count, Around around) {
  const Number *best = std::max_element(values, values + count);
  const auto [before, after] = around(static_cast<Size>(best - values));
  Number other = -std::numeric_limits<Number>::infinity();
  for (Size row = 0; row < before; ++row) other = std::max(other, values[row]);
  for (Size row = after; row < count; ++row) other = std::max(other, values[row]);
  return {*best, other};
}

}  // namespace places

#endif
