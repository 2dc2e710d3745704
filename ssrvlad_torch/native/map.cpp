// The map of ssrvlad_map.h: its channels compare, are fused, and decide.

#include "ssrvlad_map.h"

#include "compare.hpp"
#include "interface.hpp"

using namespace places;

namespace {

// Values that are not finite make the sum NaN.
SSRVLAD_CLONES bool are_finite(const float *values, Size count) {
  constexpr int LANES = 16;
  float lanes[LANES] = {};
  Size i = 0;
  for (; i + LANES <= count; i += LANES)
    for (int lane = 0; lane < LANES; ++lane) lanes[lane] += values[i + lane] * 0;
  for (; i < count; ++i) lanes[0] += values[i] * 0;
  return std::all_of(lanes, lanes + LANES, [](float lane) { return lane == 0; });
}

// A channel of a map, and what its queries must be.
struct Member {
  std::unique_ptr<Channel> channel;
  Size length;  // of vectors; 0 for signs
  Size of_mean;
  double trust;
};

}  // namespace

struct ssrvlad_map {
  Drives drives;
  std::vector<Member> members;

  std::unique_ptr<Comparison> compare(std::size_t number, const ssrvlad_queries &queries, Size count,
                                      bool standardised, bool swept, int threads) const {
    const Member &member = members[number];
    require((queries.descriptors || !count) && queries.anchors >= 1 && queries.anchors % 2 == 1 &&
            may_be({count, queries.anchors, member.of_mean}));
    const auto *vectors = static_cast<const float *>(queries.descriptors);
    require(member.length ? are_finite(vectors, count * queries.anchors * member.length) : queries.anchors == 1);
    require(!queries.mean || are_finite(queries.mean, member.of_mean));
    return member.channel->compare({queries.descriptors, count, queries.anchors, queries.mean}, standardised,
                                   swept, threads);
  }
};

struct ssrvlad_comparison {
  std::unique_ptr<Comparison> scores;
};

ssrvlad_map *ssrvlad_map_new(const ssrvlad_drives *drives) {
  ssrvlad_map *map = nullptr;
  guarded([&] { map = new ssrvlad_map{drives_of(drives), {}}; });
  return map;
}

void ssrvlad_map_free(ssrvlad_map *map) { delete map; }

int ssrvlad_map_add_channel(ssrvlad_map *map, const ssrvlad_channel *channel) {
  return guarded([&] {
    require(map && channel && (channel->rows || !map->drives.rows) && channel->trust > 0 &&
            std::isfinite(channel->trust) && channel->columns >= 1 && channel->size >= 1);
    const bool are_signs = channel->kind == SSRVLAD_SIGNS;
    require(may_be({map->drives.rows, channel->columns, channel->size}));
    Member member{nullptr, 0, channel->columns * channel->size * (are_signs ? 8 : 1), channel->trust};
    const auto drives = static_cast<Size>(map->drives.starts.size());
    require(member.of_mean <= MOST_NUMBERS);
    require(!channel->means || are_finite(channel->means, drives * member.of_mean));
    if (are_signs) {
      member.channel = channel_of_signs(static_cast<const std::uint8_t *>(channel->rows),
                                        channel->columns, channel->size, map->drives, channel->means);
    } else {
      const auto *rows = static_cast<const float *>(channel->rows);
      require(channel->kind == SSRVLAD_VECTORS && channel->columns == 1);
      require(are_finite(rows, map->drives.rows * channel->size));
      member.channel = channel_of_vectors(rows, channel->size, map->drives, channel->means);
      member.length = channel->size;
    }
    map->members.push_back(std::move(member));
  });
}

int ssrvlad_map_query(const ssrvlad_map *map, const ssrvlad_queries *queries, int64_t count,
                      const ssrvlad_steps *steps, int threads, ssrvlad_decision *decision,
                      ssrvlad_taken *taken) {
  return guarded([&] {
    require(map && queries && steps && decision && taken && !map->members.empty() && count >= 0);
    require(steps->follow >= SSRVLAD_ALONE && steps->follow <= SSRVLAD_OFFLINE && steps->delay >= 0 &&
            steps->top >= 1);
    const bool standardised = steps->standardise && std::min(count, map->drives.rows) >= MIN_FRAMES;
    std::vector<std::unique_ptr<Comparison>> compared;
    std::vector<const Scores *> members;
    std::vector<double> trust;
    taken->standardised = standardised;
    taken->width = 0;
    for (std::size_t number = 0; number < map->members.size(); ++number) {
      compared.push_back(map->compare(number, queries[number], count, standardised, steps->sweep, threads));
      members.push_back(compared.back().get());
      trust.push_back(map->members[number].trust);
      taken->width = std::max(taken->width, compared.back()->width);
    }
    std::unique_ptr<Fused> fused;
    if (members.size() > 1) fused = std::make_unique<Fused>(members, trust);
    give(fused ? fused->weights() : std::vector<double>{1}, taken->weights);
    const Scores &scores = fused ? *fused : *members.front();
    const AllRows evidence(scores);
    give(decide(map->drives, evidence, static_cast<Mode>(steps->follow), steps->delay, steps->top), *decision);
  });
}

ssrvlad_comparison *ssrvlad_map_compare(const ssrvlad_map *map, int64_t channel,
                                        const ssrvlad_queries *queries, int64_t count, int standardised,
                                        int sweep, int threads, int64_t *width) {
  ssrvlad_comparison *comparison = nullptr;
  guarded([&] {
    require(map && queries && width && count >= 0 && channel >= 0 &&
            channel < static_cast<Size>(map->members.size()));
    auto scores = map->compare(static_cast<std::size_t>(channel), *queries, count, standardised, sweep, threads);
    *width = scores->width;
    comparison = new ssrvlad_comparison{std::move(scores)};
  });
  return comparison;
}

void ssrvlad_comparison_free(ssrvlad_comparison *comparison) { delete comparison; }

int ssrvlad_comparison_scores(const ssrvlad_comparison *comparison, int64_t query, float *scores) {
  return guarded([&] {
    require(comparison && scores && query >= 0 && query < comparison->scores->queries());
    comparison->scores->of(query, scores);
  });
}
