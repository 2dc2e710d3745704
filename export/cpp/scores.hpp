// Scores by channels, and of all channels as one. Part of `place.hpp`.

#pragma once

#include <algorithm>
#include <bitset>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <numeric>
#include <vector>

#include "npy.hpp"

namespace ssrvlad {

// How much label maps, features and HOG count in a score, and columns of cells by which features are
// moved to each side, as in `ssrvlad query` for single frames.
constexpr double kLabelShapes = 1, kFeatures = 6, kHog = 2;
constexpr std::int64_t kReach = 2;

namespace detail {

inline float length_of(const float* vector, std::size_t size) {
  return std::sqrt(std::inner_product(vector, vector + size, vector, 0.0F));
}

// The number of bits that differ; the size is a multiple of 8 bytes.
inline std::size_t different(const std::uint8_t* one, const std::uint8_t* other, std::size_t size) {
  std::size_t count = 0;
  for (std::size_t at = 0; at < size; at += 8) {
    std::uint64_t ours, theirs;
    std::memcpy(&ours, one + at, 8);
    std::memcpy(&theirs, other + at, 8);
    count += std::bitset<64>(ours ^ theirs).count();
  }
  return count;
}

// The cosine of signs over the columns of cells that overlap, for the best of all moves.
inline float cosine_of_signs(const std::uint8_t* query, const std::uint8_t* reference,
                             std::int64_t columns, std::int64_t column) {
  float best = -1;
  for (std::int64_t move = -kReach; move <= kReach; ++move) {
    const auto size = static_cast<std::size_t>((columns - std::abs(move)) * column);
    const auto bits = different(query + std::max<std::int64_t>(0, -move) * column,
                                reference + std::max<std::int64_t>(0, move) * column, size);
    best = std::max(best, 1 - static_cast<float>(bits) / static_cast<float>(4 * size));
  }
  return best;
}

constexpr float kNoScore = -std::numeric_limits<float>::infinity();

// The cosines of a vector, or of those of several anchors of a length, of which the best counts, to
// all rows of an array; `kNoScore` where a vector is zero.
inline std::vector<float> cosines(const std::vector<float>& query, std::size_t length,
                                  const npy::Array& rows) {
  std::vector<float> scores(static_cast<std::size_t>(rows.shape[0]), kNoScore);
  for (std::size_t row = 0; row < scores.size(); ++row) {
    const float* reference = rows.as<float>() + row * length;
    const float norm = length_of(reference, length);
    for (const float* anchor = query.data(); anchor < query.data() + query.size();
         anchor += length) {
      const float norms = norm * length_of(anchor, length);
      const float product = std::inner_product(anchor, anchor + length, reference, 0.0F);
      if (norms > 0) scores[row] = std::max(scores[row], product / norms);
    }
  }
  return scores;
}

// The scores of all rows by a channel, and its weight.
struct Scores {
  double weight;
  std::vector<float> of_rows;
};

// The scores of one query by several channels as one, by the rule of `ssrvlad query`: the weighted
// means of their z-scores of nearness, minus the logarithm of 1 - cosine.
inline std::vector<float> fused(const std::vector<Scores>& channels) {
  std::vector<double> z(channels[0].of_rows.size());
  std::vector<bool> scored(z.size());
  double mean = 0, spread = 0, weights = 0;
  for (const auto& channel : channels) weights += channel.weight;
  for (const auto& channel : channels) {
    std::vector<double> near(z.size());
    double sum = 0, squares = 0, count = 0;
    for (std::size_t row = 0; row < z.size(); ++row) {
      if (channel.of_rows[row] == kNoScore) continue;
      near[row] = -std::log(std::max(1.0 - static_cast<double>(channel.of_rows[row]), 1e-6));
      scored[row] = true;
      sum += near[row];
      ++count;
    }
    const double own_mean = sum / std::max(1.0, count);
    for (std::size_t row = 0; row < z.size(); ++row)
      if (channel.of_rows[row] != kNoScore) squares += std::pow(near[row] - own_mean, 2);
    const double own_spread = std::sqrt(squares / std::max(1.0, count));
    const double weight = channel.weight / weights;
    for (std::size_t row = 0; row < z.size(); ++row)
      if (channel.of_rows[row] != kNoScore)
        z[row] += weight * (near[row] - own_mean) / std::max(own_spread, 1e-6);
    mean += weight * own_mean;
    spread += weight * own_spread;
  }
  std::vector<float> scores(z.size(), kNoScore);
  for (std::size_t row = 0; row < z.size(); ++row)
    if (scored[row]) scores[row] = static_cast<float>(-std::expm1(-(mean + spread * z[row])));
  return scores;
}

}  // namespace detail
}  // namespace ssrvlad
