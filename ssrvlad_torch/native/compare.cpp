// What the channels of compare.hpp have in common, and their scores as one.

#include "compare.hpp"

#include <numeric>

#include "fusion.hpp"

namespace places {

namespace {

constexpr Size IN_MEMORY = Size{1} << 26;  // scores at once

// Nearness, NONE where there is none; its mean and deviation over the rows that have one.
struct Scaled {
  std::vector<float> near;
  double mean = 0, deviation = 0;

  Scaled(std::vector<float> scores, const Listing &listing) : near(std::move(scores)) {
    const auto count = static_cast<Size>(near.size());
    nearness(near.data(), count, near.data());
    const Spread spread = listing.spread(near.data());
    mean = spread.mean;
    deviation = spread.deviation;
    if (deviation > MIN_SPREAD) return;
    const auto [of_equals, apart] = plain_spread(near.data(), count);
    mean = of_equals;
    deviation = apart;
  }

  double unit() const { return std::max(deviation, MIN_SPREAD); }
};

std::vector<float> scores_of(const Scores &member, Size query) {
  std::vector<float> scores(static_cast<std::size_t>(member.rows()));
  member.of(query, scores.data());
  return scores;
}

// How many deviations the first candidate is ahead of the best row elsewhere.
double lead(const Scaled &scaled, const Listing &listing) {
  const auto rows = static_cast<Size>(scaled.near.size());
  if (rows <= 2 * ELSEWHERE + 1) return 0;
  std::vector<double> z(scaled.near.size());
  add_scaled(scaled.near.data(), rows, scaled.mean, 1 / scaled.unit(), z.data());
  const auto [best, other] =
      leading(z.data(), rows, [&](Size row) { return listing.around(row, ELSEWHERE); });
  return best - other;
}

}  // namespace

std::vector<Shared> sharing(const Drives &drives) {
  std::vector<Shared> shared;
  const auto count = static_cast<Size>(drives.starts.size());
  const auto start = [&](Size drive) { return drives.starts[static_cast<std::size_t>(drive)]; };
  const auto is_short = [&](Size drive) { return drives.last(drive) - start(drive) < MIN_FRAMES; };
  for (Size drive = 0, next; drive < count && drives.rows >= MIN_FRAMES; drive = next) {
    next = drive + 1;
    while (is_short(drive) && next < count && is_short(next)) ++next;
    const Size first = start(drive), last = drives.last(next - 1);
    const bool enough = last - first >= MIN_FRAMES;
    shared.push_back({first, last, enough ? first : 0, enough ? last : drives.rows});
  }
  return shared;
}

std::vector<Shared> each_alone(const Drives &drives) {
  std::vector<Shared> shared;
  for (std::size_t drive = 0; drive < drives.starts.size(); ++drive) {
    const Size first = drives.starts[drive], last = drives.last(static_cast<Size>(drive));
    shared.push_back({first, last, first, last});
  }
  return shared;
}

Blocks::Blocks(Size queries, Size rows) : queries_(queries), rows_(rows) {
  const Size most = std::max<Size>(1, IN_MEMORY / 4 / std::max<Size>(1, rows));
  size_ = queries * rows <= IN_MEMORY ? std::max<Size>(1, queries) : most;
}

void Blocks::of(Size query, float *scores) const {
  const Size first = query - query % size_;
  if (first != held_) {
    const Size last = std::min(queries_, first + size_);
    held_ = -1;
    block_.resize(static_cast<std::size_t>((last - first) * rows_));
    compute(first, last, block_.data());
    held_ = first;
  }
  std::copy_n(block_.data() + (query - first) * rows_, rows_, scores);
}

namespace {
class Matrix : public Comparison {
 public:
  Matrix(const float *scores, Size count, Size rows) : Comparison(count, rows), scores_(scores) {}
  void of(Size query, float *scores) const override {
    std::copy_n(scores_ + query * rows(), rows(), scores);
  }

 protected:
  void compute(Size, Size, float *) const override {}

 private:
  const float *scores_;
};
}  // namespace

std::unique_ptr<Comparison> comparison_of_scores(const float *scores, Size count, Size rows) {
  return std::make_unique<Matrix>(scores, count, rows);
}

void Candidates::of(Size query, float *scores) const {
  scores_.of(query, scores);
  for (Size place = 0; allowed_ && place < rows(); ++place)
    if (!allowed_[place]) scores[place] = NONE;
  if (excluded_ && excluded_[2 * query] < excluded_[2 * query + 1])
    std::fill(scores + listing_.rows.from(excluded_[2 * query]),
              scores + listing_.rows.from(excluded_[2 * query + 1]), NONE);
}

Fused::Fused(std::vector<const Scores *> members, const std::vector<double> &trust,
             const Listing &listing)
    : Blocks(members.front()->queries(), members.front()->rows()), members_(std::move(members)),
      weights_(trust), listing_(listing) {
  double sum = 0;
  if (queries() >= MIN_FRAMES) {
    std::vector<double> known(trust);
    for (std::size_t member = 0; member < members_.size(); ++member) {
      double leads = 0;
      Size sampled = 0;
      for (Size query = 0; query < queries(); query += std::max<Size>(1, queries() / SAMPLE), ++sampled)
        leads += lead(Scaled(scores_of(*members_[member], query), listing), listing);
      known[member] *= std::max(0.0, leads / static_cast<double>(sampled));
      sum += known[member];
    }
    if (sum > 0) weights_ = known;
  }
  sum = std::accumulate(weights_.begin(), weights_.end(), 0.0);
  for (double &weight : weights_) weight /= sum;
}

void Fused::compute(Size first, Size last, float *scores) const {
  std::vector<double> z(static_cast<std::size_t>(rows()));
  for (Size query = first; query < last; ++query, scores += rows()) {
    std::fill(z.begin(), z.end(), 0);
    std::fill_n(scores, rows(), NONE);
    double mean = 0, deviation = 0;
    for (std::size_t member = 0; member < members_.size(); ++member) {
      const Scaled scaled(scores_of(*members_[member], query), listing_);
      add_scaled(scaled.near.data(), rows(), scaled.mean, weights_[member] / scaled.unit(), z.data());
      for (Size row = 0; row < rows(); ++row)  // a NaN stays one
        scores[row] = std::max(scaled.near[static_cast<std::size_t>(row)], scores[row]);
      mean += weights_[member] * scaled.mean;
      deviation += weights_[member] * scaled.deviation;
    }
    as_cosines(z.data(), rows(), mean, deviation, scores);
  }
}

}  // namespace places
