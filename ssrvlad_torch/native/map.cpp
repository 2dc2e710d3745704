// The map of map.hpp: its channels compare, are fused, and decide.

#include "map.hpp"

#include "interface.hpp"

namespace places {

namespace {

// Values that are not finite make the sum NaN.
bool are_finite(const float *values, Size count) {
  return on_cpu([=](auto) {
    constexpr int LANES = 16;
    float lanes[LANES] = {};
    Size i = 0;
    for (; i + LANES <= count; i += LANES)
      for (int lane = 0; lane < LANES; ++lane) lanes[lane] += values[i + lane] * 0;
    for (; i < count; ++i) lanes[0] += values[i] * 0;
    return std::all_of(lanes, lanes + LANES, [](float lane) { return lane == 0; });
  });
}

}  // namespace

void Map::add(const ssrvlad_channel &channel) {
  require((channel.rows || !drives_.rows) && channel.trust > 0 && std::isfinite(channel.trust) &&
          channel.columns >= 1 && channel.size >= 1);
  const bool are_signs = channel.kind == SSRVLAD_SIGNS;
  require(may_be({drives_.rows, channel.columns, channel.size}));
  Member member{nullptr, 0, channel.columns * channel.size * (are_signs ? 8 : 1), channel.trust};
  require(member.of_mean <= MOST_NUMBERS);
  require(!channel.means ||
          are_finite(channel.means, static_cast<Size>(drives_.starts.size()) * member.of_mean));
  if (are_signs) {
    member.channel = channel_of_signs(static_cast<const std::uint8_t *>(channel.rows), channel.columns,
                                      channel.size, drives_, channel.means);
  } else {
    const auto *rows = static_cast<const float *>(channel.rows);
    require(channel.kind == SSRVLAD_VECTORS && channel.columns == 1);
    require(are_finite(rows, drives_.rows * channel.size));
    member.channel = channel_of_vectors(rows, channel.size, drives_, channel.means);
    member.length = channel.size;
  }
  members_.push_back(std::move(member));
}

std::unique_ptr<Comparison> Map::compare(Size channel, const ssrvlad_queries &queries, Size count,
                                         bool standardised, bool swept, int threads) const {
  const Member &member = members_[static_cast<std::size_t>(channel)];
  require((queries.descriptors || !count) && queries.anchors >= 1 && queries.anchors % 2 == 1 &&
          may_be({count, queries.anchors, member.of_mean}));
  const auto *vectors = static_cast<const float *>(queries.descriptors);
  require(member.length ? are_finite(vectors, count * queries.anchors * member.length) : queries.anchors == 1);
  require(!queries.mean || are_finite(queries.mean, member.of_mean));
  return member.channel->compare({queries.descriptors, count, queries.anchors, queries.mean}, standardised,
                                 swept, threads);
}

Decision Map::query(const ssrvlad_queries *queries, Size count, const ssrvlad_steps &steps, int threads,
                    ssrvlad_taken &taken) const {
  const bool standardised = steps.standardise && std::min(count, drives_.rows) >= MIN_FRAMES;
  std::vector<std::unique_ptr<Comparison>> compared;
  std::vector<const Scores *> members;
  std::vector<double> trust;
  taken.standardised = standardised;
  taken.width = 0;
  for (Size channel = 0; channel < channels(); ++channel) {
    compared.push_back(compare(channel, queries[channel], count, standardised, steps.sweep, threads));
    members.push_back(compared.back().get());
    trust.push_back(members_[static_cast<std::size_t>(channel)].trust);
    taken.width = std::max(taken.width, compared.back()->width);
  }
  std::unique_ptr<Fused> fused;
  if (members.size() > 1) fused = std::make_unique<Fused>(members, trust);
  const std::vector<double> weights = fused ? fused->weights() : std::vector<double>{1};
  require(taken.weights);
  std::copy(weights.begin(), weights.end(), taken.weights);
  const Scores &scores = fused ? *fused : *members.front();
  const AllRows evidence(scores);
  return decide(drives_, evidence, static_cast<Mode>(steps.follow), steps.delay, steps.top);
}

}  // namespace places
