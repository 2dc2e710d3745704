// Scores by features, and of label maps and features as one. Part of `place.hpp`.

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

namespace ssrvlad {

// Weights of label maps and of features in a score, and columns of cells by which features are moved
// to each side, as in `ssrvlad query` for single frames.
constexpr double kWeights[] = {1.0 / 7, 6.0 / 7};
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

// The scores of one query by several methods as one, by the rule of `ssrvlad query`: the weighted
// means of their z-scores of nearness, minus the logarithm of 1 - cosine.
inline std::vector<float> fused(const std::vector<std::vector<float>>& methods) {
  std::vector<double> z(methods[0].size());
  std::vector<bool> scored(z.size());
  double mean = 0, spread = 0;
  for (std::size_t method = 0; method < methods.size(); ++method) {
    std::vector<double> near(z.size());
    double sum = 0, squares = 0, count = 0;
    for (std::size_t row = 0; row < z.size(); ++row) {
      if (methods[method][row] == kNoScore) continue;
      near[row] = -std::log(std::max(1.0 - static_cast<double>(methods[method][row]), 1e-6));
      scored[row] = true;
      sum += near[row];
      ++count;
    }
    const double own_mean = sum / std::max(1.0, count);
    for (std::size_t row = 0; row < z.size(); ++row)
      if (methods[method][row] != kNoScore) squares += std::pow(near[row] - own_mean, 2);
    const double own_spread = std::sqrt(squares / std::max(1.0, count));
    for (std::size_t row = 0; row < z.size(); ++row)
      if (methods[method][row] != kNoScore)
        z[row] += kWeights[method] * (near[row] - own_mean) / std::max(own_spread, 1e-6);
    mean += kWeights[method] * own_mean;
    spread += kWeights[method] * own_spread;
  }
  std::vector<float> scores(z.size(), kNoScore);
  for (std::size_t row = 0; row < z.size(); ++row)
    if (scored[row]) scores[row] = static_cast<float>(-std::expm1(-(mean + spread * z[row])));
  return scores;
}

}  // namespace detail
}  // namespace ssrvlad
