// The map of map.hpp: its channels compare, are fused, and decide.

#include "map.hpp"

#include "interface.hpp"

namespace places {

namespace {

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
  require(channel.trust > 0 && std::isfinite(channel.trust) && channel.columns >= 1 && channel.size >= 1,
          "a trust above 0, and columns and a size from 1");
  Member member{nullptr, 0, 0, channel.trust};
  if (channel.kind != SSRVLAD_SCORES) {
    const bool are_signs = channel.kind == SSRVLAD_SIGNS;
    require((channel.rows || !rows) && may_be({rows, channel.columns, channel.size}));
    member.of_mean = channel.columns * channel.size * (are_signs ? 8 : 1);
    require(member.of_mean <= MOST_NUMBERS, "descriptors of up to 2^31 numbers");
    const auto means = static_cast<Size>(listing_.drives.starts.size());
    require(!channel.means || are_finite(channel.means, means * member.of_mean), "finite means");
    if (are_signs) {
      member.channel = channel_of_signs(static_cast<const std::uint8_t *>(channel.rows), channel.columns,
                                        channel.size, listing_, channel.means);
    } else {
      const auto *vectors = static_cast<const float *>(channel.rows);
      require(channel.kind == SSRVLAD_VECTORS && channel.columns == 1);
      require(are_finite(vectors, rows * channel.size), "finite rows");
      member.channel = channel_of_vectors(vectors, channel.size, listing_, channel.means);
      member.length = channel.size;
    }
  }
  channels_.push_back(std::move(member));
}

std::unique_ptr<Comparison> Map::compare(const Member &member, const ssrvlad_queries &queries, Size count,
                                         bool standardised, bool swept, int threads) const {
  const Size size = member.channel ? member.of_mean : listing_.count();
  require((queries.descriptors || !count || !size) && queries.anchors >= 1 && queries.anchors % 2 == 1 &&
          may_be({count, queries.anchors, size}));
  const auto *numbers = static_cast<const float *>(queries.descriptors);
  if (!member.channel) {
    require(!std::isnan(sum(numbers, count * size)) && highest(numbers, count * size) <= HIGHEST_SCORE,
            "scores of at most 1.001, got a higher one or NaN");
    return comparison_of_scores(numbers, count, size);
  }
  require(member.length ? are_finite(numbers, count * queries.anchors * member.length) : queries.anchors == 1,
          "finite queries, and signs from one anchor");
  return member.channel->compare({numbers, count, queries.anchors}, standardised, swept, threads);
}

std::unique_ptr<Scores> Map::compare(const ssrvlad_queries *queries, Size count, const ssrvlad_steps &steps,
                                     int threads, ssrvlad_taken &taken) const {
  for (Size number = 0; steps.excluded && number < 2 * count; ++number)
    require(steps.excluded[number] >= 0 && steps.excluded[number] <= listing_.map.rows, "excluded rows of the map");
  taken.standardised = steps.standardise && std::min(count, listing_.map.rows) >= MIN_FRAMES;
  taken.width = 0;
  auto together = std::make_unique<Together>();
  std::vector<const Scores *> candidates;
  std::vector<double> trust;
  for (const Member &member : channels_) {
    auto compared = compare(member, *queries++, count, taken.standardised, steps.sweep, threads);
    taken.width = std::max(taken.width, compared->width);
    together->parts.push_back(std::move(compared));
    together->parts.push_back(std::make_unique<Candidates>(*together->parts.back(), listing_, steps.allowed, steps.excluded));
    candidates.push_back(together->parts.back().get());
    trust.push_back(member.trust);
  }
  std::vector<double> weights = {1};
  if (candidates.size() > 1) {
    auto fused = std::make_unique<Fused>(candidates, trust, listing_);
    weights = fused->weights();
    together->parts.push_back(std::move(fused));
  }
  require(taken.weights);
  std::copy(weights.begin(), weights.end(), taken.weights);
  return together;
}

Decision Map::query(const ssrvlad_queries *queries, Size count, const ssrvlad_steps &steps, int threads,
                    ssrvlad_taken &taken) const {
  const auto scores = compare(queries, count, steps, threads, taken);
  return decide(listing_, *scores, static_cast<Mode>(steps.follow), steps.delay, steps.top);
}

}  // namespace places
