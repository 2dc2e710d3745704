// The comparison of neighbouring queries of progress.hpp.

#include "progress.hpp"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <utility>

namespace places {

namespace {
constexpr double ALIKE = 1e-9;  // likeness that rounding makes

// Nearness without its mean, of length 1; zeros where there is no score, and if all are equal.
std::vector<double> profile(const std::vector<float> &scores) {
  std::vector<double> seen(scores.size());
  double total = 0, count = 0, square = 0;
  for (std::size_t row = 0; row < scores.size(); ++row) {
    if (!std::isfinite(scores[row])) continue;
    total += seen[row] = nearness(static_cast<double>(scores[row]));
    ++count;
  }
  const double mean = total / std::max(1.0, count);
  for (std::size_t row = 0; row < scores.size(); ++row) {
    if (std::isfinite(scores[row])) seen[row] -= mean;
    square += seen[row] * seen[row];
  }
  const double length = std::sqrt(square);
  const bool equal = std::sqrt(square / std::max(1.0, count)) <= static_cast<double>(MIN_SPREAD);
  for (double &value : seen) value = equal ? 0 : value / length;
  return seen;
}

// How many queries apart frames of a likeness are: as many as those for which it is usual.
double apart(double likeness, const std::vector<double> &usual) {
  const auto first = std::find_if(usual.begin(), usual.end(),
                                  [&](double value) { return value <= likeness + ALIKE; });
  if (first == usual.begin()) return 0;
  const double lag = static_cast<double>(first - usual.begin()) - 1, last = *(first - 1);
  return first == usual.end() ? lag : lag + std::min(1.0, (last - likeness) / (last - *first));
}
}  // namespace

void Likeness::add(const std::vector<float> &scores) {
  const std::vector<double> seen = profile(scores);
  each_.emplace_back();
  for (std::size_t back = 0; back < recent_.size(); ++back)
    each_.back()[back] = dot(seen.data(), recent_[back].data(), static_cast<Size>(seen.size()));
  recent_.push_front(seen);
  if (recent_.size() > each_.back().size()) recent_.pop_back();
}

std::vector<bool> lingering(const Likeness &likeness, const std::vector<Size> &queries,
                            const std::vector<Size> &rows, Size later) {
  struct Pair {
    Size query, before;
    double apart, moved;
  };
  const Size count = static_cast<Size>(queries.size());
  std::vector<Pair> pairs;
  std::vector<double> usual = {1}, paces;
  for (Size lag = 1; lag <= std::min(MODEL.around, count - 1); ++lag) {
    std::vector<double> alike;
    for (Size query = lag; query < count; ++query)
      alike.push_back(likeness.of(queries[query], queries[query - lag]));
    usual.push_back(std::min(usual.back(), median(alike)));
    for (Size query = lag; query < count; ++query) {
      const Size before = query - lag;
      if (rows[query] < 0 || rows[before] < 0) continue;
      const double far = apart(alike[before], usual);
      pairs.push_back({query, before, far, std::abs(static_cast<double>(rows[query] - rows[before]))});
      if (far >= 1) paces.push_back(pairs.back().moved / far);
    }
  }
  const double pace = median(std::move(paces));
  std::vector<Size> still(queries.size()), neighbours(queries.size());
  for (const auto &[query, before, far, moved] : pairs) {
    const double usually = pace * far;
    const bool stands = far >= 1 && usually >= 1 && moved <= MODEL.elsewhere && moved < MODEL.lingering * usually;
    ++neighbours[query], still[query] += stands;
    if (query - before <= later) ++neighbours[before], still[before] += stands;
  }
  std::vector<bool> lingers(queries.size());
  for (std::size_t query = 0; query < lingers.size(); ++query)
    lingers[query] = 2 * neighbours[query] >= MODEL.around &&
                     static_cast<double>(still[query]) > MODEL.lingering * static_cast<double>(neighbours[query]);
  return lingers;
}

}  // namespace places
