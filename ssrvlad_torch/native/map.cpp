// The map of map.hpp: its channels compare, are fused, and decide.

#include "map.hpp"

#include "interface.hpp"
#include "tracker.hpp"

namespace places {

namespace {

// Scores of another method that come query by query.
class LiveScores : public LiveComparison {
 public:
  explicit LiveScores(Size rows) : rows_(rows) {}
  void next(const void *query, int, float *scores) override {
    std::copy_n(static_cast<const float *>(query), rows_, scores);
  }
  void keep(Archive &) override {}

 private:
  Size rows_;
};

// What a map is compared by, and what this is made of.
class Together : public Scores {
 public:
  std::vector<std::unique_ptr<Scores>> parts;

  Size queries() const override { return parts.back()->queries(); }
  Size rows() const override { return parts.back()->rows(); }
  void of(Size query, float *scores) const override { parts.back()->of(query, scores); }
};

}  // namespace

void Map::add(const ssrvlad_channel &channel) {
  const Size rows = listing_.count();
  require(channel.trust > 0 && std::isfinite(channel.trust) && channel.columns >= 1 && channel.height >= 1 &&
              channel.size >= 1,
          "a trust above 0, and columns, a height and a size from 1");
  Member member{nullptr, 0, 0, channel.trust, static_cast<const std::uint8_t *>(channel.rows), 0};
  if (channel.kind != SSRVLAD_SCORES) {
    const bool are_signs = channel.kind == SSRVLAD_SIGNS;
    require((channel.rows || !rows) && may_be({rows, channel.columns, channel.height, channel.size}));
    member.of_mean = channel.columns * channel.height * channel.size * (are_signs ? 8 : 1);
    member.bytes = channel.columns * channel.height * channel.size * (are_signs ? 1 : static_cast<Size>(sizeof(float)));
    require(member.of_mean <= MOST_NUMBERS, "descriptors of up to 2^31 numbers");
    const auto means = static_cast<Size>(listing_.drives.starts.size());
    require(!channel.means || are_finite(channel.means, means * member.of_mean), "finite means");
    if (are_signs) {
      member.channel = channel_of_signs(static_cast<const std::uint8_t *>(channel.rows), channel.columns,
                                        channel.height, channel.size, listing_, channel.means);
    } else {
      const auto *vectors = static_cast<const float *>(channel.rows);
      require(channel.kind == SSRVLAD_VECTORS && channel.columns == 1 && channel.height == 1);
      require(are_finite(vectors, rows * channel.size), "finite rows");
      member.channel = channel_of_vectors(vectors, channel.size, listing_, channel.means);
      member.length = channel.size;
    }
  }
  channels_.push_back(std::move(member));
}

void Map::check(Size number, const ssrvlad_queries &queries, Size count) const {
  const Member &member = channels_[static_cast<std::size_t>(number)];
  const Size size = member.channel ? member.of_mean : listing_.count();
  require((queries.descriptors || !count || !size) && queries.anchors >= 1 && queries.anchors % 2 == 1 &&
          may_be({count, queries.anchors, size}));
  const auto *numbers = static_cast<const float *>(queries.descriptors);
  if (!member.channel) {
    require(!std::isnan(sum(numbers, count * size)) && highest(numbers, count * size) <= HIGHEST_SCORE,
            "scores of at most 1.001, got a higher one or NaN");
    return;
  }
  require(member.length ? are_finite(numbers, count * queries.anchors * member.length) : queries.anchors == 1,
          "finite queries, and signs from one anchor");
}

std::vector<double> Map::trust() const {
  std::vector<double> trust;
  for (const Member &member : channels_) trust.push_back(member.trust);
  return trust;
}

std::uint64_t Map::digest() const {
  std::uint64_t digest = digest_of(listing_.map.starts.data(), listing_.map.starts.size() * sizeof(Size), listing_.map.rows);
  for (const Member &member : channels_) {
    digest = digest_of(&member.trust, sizeof member.trust, digest + static_cast<std::uint64_t>(member.of_mean));
    digest = digest_of(member.rows, static_cast<std::size_t>(member.bytes * listing_.count()), digest);
  }
  return digest;
}

std::unique_ptr<LiveComparison> Map::live(Size number, Size anchors, bool standardised, bool swept, int threads) const {
  const Member &member = channels_[static_cast<std::size_t>(number)];
  if (!member.channel) return std::make_unique<LiveScores>(listing_.count());
  return member.channel->live(anchors, standardised, swept, threads);
}

std::unique_ptr<Comparison> Map::compare(Size number, const ssrvlad_queries &queries, Size count, bool standardised,
                                         bool swept, int threads) const {
  check(number, queries, count);
  const Member &member = channels_[static_cast<std::size_t>(number)];
  const auto *numbers = static_cast<const float *>(queries.descriptors);
  if (!member.channel) return comparison_of_scores(numbers, count, listing_.count());
  return member.channel->compare({numbers, count, queries.anchors}, standardised, swept, threads);
}

std::unique_ptr<Scores> Map::compare(const ssrvlad_queries *queries, Size count, const ssrvlad_steps &steps,
                                     int threads, ssrvlad_taken &taken) const {
  for (Size number = 0; steps.excluded && number < 2 * count; ++number)
    require(steps.excluded[number] >= 0 && steps.excluded[number] <= listing_.map.rows, "excluded rows of the map");
  taken.standardised = steps.standardise && std::min(count, listing_.map.rows) >= MODEL.min_frames;
  taken.width = 0;
  auto together = std::make_unique<Together>();
  std::vector<const Scores *> candidates;
  for (Size number = 0; number < channels(); ++number) {
    auto compared = compare(number, *queries++, count, taken.standardised, steps.sweep, threads);
    taken.width = std::max(taken.width, compared->width);
    together->parts.push_back(std::move(compared));
    together->parts.push_back(std::make_unique<Candidates>(*together->parts.back(), listing_, steps.allowed, steps.excluded));
    candidates.push_back(together->parts.back().get());
  }
  std::vector<double> weights = {1};
  if (candidates.size() > 1) {
    auto fused = std::make_unique<Fused>(candidates, trust(), listing_);
    weights = fused->weights();
    together->parts.push_back(std::move(fused));
  }
  require(taken.weights);
  std::copy(weights.begin(), weights.end(), taken.weights);
  return together;
}

Decision Map::query(const ssrvlad_queries *queries, Size count, const ssrvlad_steps &steps, int threads,
                    ssrvlad_taken &taken) const {
  if (steps.follow == SSRVLAD_ONLINE) return track(queries, count, steps, threads, taken);
  const auto scores = compare(queries, count, steps, threads, taken);
  return decide(listing_, *scores, steps.follow == SSRVLAD_OFFLINE, steps.top);
}

Decision Map::track(const ssrvlad_queries *queries, Size count, const ssrvlad_steps &steps, int threads,
                    ssrvlad_taken &taken) const {
  Tracker tracker(*this, steps);
  Decision decision(count, steps.top);
  std::vector<ssrvlad_queries> next(queries, queries + channels());
  for (std::vector<float> *values : {&decision.right, &decision.spread, &decision.together})
    values->resize(static_cast<std::size_t>(count));
  decision.follows.resize(static_cast<std::size_t>(count));
  const auto take = [&] {
    const Answer answer = tracker.answer();
    const auto at = static_cast<std::size_t>(answer.query);
    std::copy(answer.scores.begin(), answer.scores.end(), decision.scores.begin() + answer.query * steps.top);
    std::copy(answer.rows.begin(), answer.rows.end(), decision.rows.begin() + answer.query * steps.top);
    decision.right[at] = answer.right.front();
    decision.spread[at] = answer.spread.front();
    decision.together[at] = answer.together.front();
    decision.follows[at] = answer.followed;
    decision.followed |= answer.followed;
    decision.course = answer.course;
    decision.gain = answer.gain;
    taken.width = answer.width;
    std::copy(answer.weights.begin(), answer.weights.end(), taken.weights);
  };
  taken.standardised = steps.standardise && listing_.map.rows >= MODEL.min_frames;
  for (Size query = 0; query < count; ++query) {
    tracker.update(next.data(), steps.excluded ? steps.excluded + 2 * query : nullptr, threads);
    if (tracker.waiting() > steps.delay) take();
    for (Size number = 0; number < channels(); ++number) {
      const Member &member = channels_[static_cast<std::size_t>(number)];
      const Size bytes = member.channel ? member.bytes * next[number].anchors : listing_.count() * static_cast<Size>(sizeof(float));
      next[number].descriptors = static_cast<const char *>(next[number].descriptors) + bytes;
    }
  }
  while (tracker.waiting()) take();
  return decision;
}

}  // namespace places
