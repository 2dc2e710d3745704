// What the channels of compare.hpp have in common, and their scores as one.

#include "compare.hpp"

#include "fusion.hpp"

namespace places {

constexpr Size IN_MEMORY = Size{1} << 26;  // scores at once

std::vector<Shared> sharing(const Drives &drives, const float *means, Size length) {
  std::vector<Shared> shared;
  const auto count = static_cast<Size>(drives.starts.size());
  const auto is_short = [&](Size drive) { return drives.last(drive) - drives.starts[drive] < MODEL.min_frames; };
  for (Size drive = 0; means && drive < count; ++drive)
    shared.push_back({drives.starts[drive], drives.last(drive), 0, 0, means + drive * length});
  for (Size drive = 0, next; !means && drive < count && drives.rows >= MODEL.min_frames; drive = next) {
    next = drive + 1;
    while (is_short(drive) && next < count && is_short(next)) ++next;
    const Size first = drives.starts[drive], last = drives.last(next - 1);
    const bool enough = last - first >= MODEL.min_frames;
    shared.push_back({first, last, enough ? first : 0, enough ? last : drives.rows, nullptr});
  }
  return shared;
}

Comparison::Comparison(Size queries, Size rows) : queries_(queries), rows_(rows) {
  const Size most = std::max<Size>(1, IN_MEMORY / 4 / std::max<Size>(1, rows));
  size_ = queries * rows <= IN_MEMORY ? std::max<Size>(1, queries) : most;
}

void Comparison::of(Size query, float *scores) const {
  const Size first = query - query % size_;
  if (first != held_) {
    const Size last = std::min(queries_, first + size_);
    held_ = -1;
    block_.resize((last - first) * rows_);
    compute(first, last, block_.data());
    held_ = first;
  }
  std::copy_n(block_.data() + (query - first) * rows_, rows_, scores);
}

void mask(const Listing &listing, const std::uint8_t *allowed, const Size *excluded, float *scores) {
  for (Size place = 0; allowed && place < listing.count(); ++place)
    if (!allowed[place]) scores[place] = NONE;
  if (excluded && excluded[0] < excluded[1])
    std::fill(scores + listing.rows.from(excluded[0]), scores + listing.rows.from(excluded[1]), NONE);
}

Fusion::Fusion(std::vector<std::vector<float>> scores, const Listing &listing)
    : near_(std::move(scores)), listing_(listing) {
  for (std::vector<float> &near : near_) {
    const auto count = static_cast<Size>(near.size());
    nearness(near.data(), count, near.data());
    spreads_.push_back(listing.spread(near.data()));
    if (spreads_.back().deviation <= MIN_SPREAD) spreads_.back() = plain_spread(near.data(), count);
  }
}

std::vector<double> Fusion::leads() const {
  std::vector<double> leads(near_.size());
  const Size rows = listing_.count();
  for (std::size_t number = 0; number < leads.size() && rows > 2 * MODEL.elsewhere + 1; ++number) {
    const auto [mean, deviation] = spreads_[number];
    std::vector<double> z(rows);
    add_scaled(near_[number].data(), rows, mean, 1 / std::max(deviation, MIN_SPREAD), z.data());
    const auto [best, other] =
        leading(z.data(), rows, [&](Size row) { return listing_.around(row, MODEL.elsewhere); });
    leads[number] = best - other;
  }
  return leads;
}

void Fusion::of(const std::vector<double> &weights, float *scores) const {
  std::vector<double> z;
  fuse(near_, spreads_, weights, z, scores);
}

Fused::Fused(std::vector<std::unique_ptr<Scores>> members, const std::vector<double> &trust, const Listing &listing)
    : Comparison(members.front()->queries(), listing.count()), members_(std::move(members)), listing_(listing) {
  std::vector<double> leads(trust.size());
  const Size step = std::max<Size>(1, queries() / MODEL.compared), sampled = (queries() + step - 1) / step;
  for (Size query = 0; queries() >= MODEL.min_frames && query < queries(); query += step) {
    const std::vector<double> more = of_query(query).leads();
    for (std::size_t member = 0; member < leads.size(); ++member) leads[member] += more[member];
  }
  for (double &lead : leads) lead /= static_cast<double>(std::max<Size>(1, sampled));
  weights_ = weights_of(trust, leads);
}

Fusion Fused::of_query(Size query) const {
  std::vector<std::vector<float>> scores;
  for (const auto &member : members_) {
    scores.emplace_back(rows());
    member->of(query, scores.back().data());
  }
  return {std::move(scores), listing_};
}

void Fused::compute(Size first, Size last, float *scores) const {
  for (Size query = first; query < last; ++query, scores += rows()) of_query(query).of(weights_, scores);
}

}  // namespace places
