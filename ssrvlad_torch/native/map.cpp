// The map of map.hpp: its channels compare, are fused, and decide; and the functions of ssrvlad_map.h.

#include "map.hpp"

#include "interface.hpp"
#include "tracker.hpp"

namespace places {

namespace {

// Scores of another method, which come query by query.
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

// Those of all queries, (count, rows).
class Matrix : public Scores {
 public:
  Matrix(const float *scores, Size count, Size rows) : scores_(scores), count_(count), rows_(rows) {}
  Size queries() const override { return count_; }
  void of(Size query, float *scores) const override { std::copy_n(scores_ + query * rows_, rows_, scores); }

 private:
  const float *scores_;
  Size count_, rows_;
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
  const Member &member = channels_[number];
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
    digest = digest_of(member.rows, member.bytes * listing_.count(), digest);
  }
  return digest;
}

std::unique_ptr<LiveComparison> Map::live(Size number, Size anchors, bool standardised, bool swept, int threads) const {
  const Member &member = channels_[number];
  if (!member.channel) return std::make_unique<LiveScores>(listing_.count());
  return member.channel->live(anchors, standardised, swept, threads);
}

std::unique_ptr<Scores> Map::compare(const ssrvlad_queries *queries, Size count, const ssrvlad_steps &steps,
                                     int threads, ssrvlad_taken &taken) const {
  for (Size number = 0; steps.excluded && number < 2 * count; ++number)
    require(steps.excluded[number] >= 0 && steps.excluded[number] <= listing_.map.rows, "excluded rows of the map");
  taken.standardised = steps.standardise && std::min(count, listing_.map.rows) >= MODEL.min_frames;
  taken.width = 0;
  std::vector<std::unique_ptr<Scores>> compared;
  for (Size number = 0; number < channels(); ++number, ++queries) {
    check(number, *queries, count);
    const auto &channel = channels_[number].channel;
    std::unique_ptr<Scores> scores;
    if (channel) {
      auto comparison = channel->compare(*queries, count, taken.standardised, steps.sweep, threads);
      taken.width = std::max(taken.width, comparison->width);
      scores = std::move(comparison);
    } else {
      scores = std::make_unique<Matrix>(static_cast<const float *>(queries->descriptors), count, listing_.count());
    }
    compared.push_back(std::make_unique<Candidates>(std::move(scores), listing_, steps.allowed, steps.excluded));
  }
  require(taken.weights);
  *taken.weights = 1;
  if (compared.size() == 1) return std::move(compared.front());
  auto fused = std::make_unique<Fused>(std::move(compared), trust(), listing_);
  std::copy(fused->weights().begin(), fused->weights().end(), taken.weights);
  return fused;
}

}  // namespace places

// ---------------------------------------------------------------------------------- ssrvlad_map.h

using namespace places;

struct ssrvlad_map : Map {
  using Map::Map;
};

struct ssrvlad_tracker : Tracker {
  using Tracker::Tracker;
  bool is_whole = true;
};

namespace {

// Fills what is decided of queries, from a first one on.
void give(const Decision &decided, Size first, ssrvlad_decision &decision) {
  const auto copy = [first](const auto &values, auto *target, Size size) {
    require(target || values.empty());
    std::copy(values.begin(), values.end(), target + first * size);
  };
  copy(decided.scores, decision.scores, decided.top);
  copy(decided.rows, decision.rows, decided.top);
  copy(decided.right, decision.right, 1);
  copy(decided.spread, decision.spread, 1);
  copy(decided.together, decision.together, 1);
  if (decision.follows) copy(decided.follows, decision.follows, 1);
  decision.followed = (first && decision.followed) || decided.followed;
  decision.way = decided.course.way;
  decision.rate = decided.course.rate;
  decision.streams = decided.course.streams;
  decision.gain = decided.gain;
}

// The answer of a tracker to the first query that waits, and the number of this query.
Size give(Tracker &tracker, Size first, ssrvlad_decision &decision, ssrvlad_taken &taken) {
  const Answer answer = tracker.answer();
  give(answer, first, decision);
  require(taken.weights);
  std::copy(answer.weights.begin(), answer.weights.end(), taken.weights);
  taken.standardised = tracker.standardised();
  taken.width = answer.width;
  return answer.query;
}

// Finds queries as if they came one by one.
void track(const Map &map, std::vector<ssrvlad_queries> next, Size count, const ssrvlad_steps &steps, int threads,
           ssrvlad_decision &decision, ssrvlad_taken &taken) {
  Tracker tracker(map, steps);
  give(Decision(0, steps.top), 0, decision);
  taken.standardised = tracker.standardised();
  for (Size query = 0, answers = 0; query < count || tracker.waiting();) {
    if (query < count) {
      tracker.update(next.data(), steps.excluded ? steps.excluded + 2 * query : nullptr, threads);
      ++query;
      for (Size number = 0; number < map.channels(); ++number) {
        auto &[descriptors, anchors] = next[number];
        descriptors = static_cast<const char *>(descriptors) + map.bytes(number, anchors);
      }
    }
    if (query == count || tracker.waits_long_enough()) give(tracker, answers++, decision, taken);
  }
}

Drives drives_of(const ssrvlad_drives *map) {
  require(map && map->count >= 0 && map->rows >= 0 && (map->count > 0) == (map->rows > 0) &&
          (map->starts || !map->count));
  Drives drives;
  drives.rows = map->rows;
  drives.starts.assign(map->starts, map->starts + map->count);
  for (Size drive = 0; drive < map->count; ++drive)
    require(drive ? drives.starts[drive] > drives.starts[drive - 1] : !drives.starts[drive],
            "starts of drives that rise from 0");
  require(!map->count || drives.starts.back() < drives.rows, "drives that start before the last row");
  return drives;
}

void check(const ssrvlad_map *map, const ssrvlad_queries *queries, Size count, const ssrvlad_steps *steps,
           const ssrvlad_taken *taken) {
  require(map && queries && steps && taken && map->channels() && count >= 0,
          "a map of one channel or more, queries and steps");
  require(steps->follow >= SSRVLAD_ALONE && steps->follow <= SSRVLAD_OFFLINE && steps->delay >= 0 && steps->top >= 1,
          "steps in range");
}

}  // namespace

ssrvlad_map *ssrvlad_map_new_for(int program, const ssrvlad_drives *drives) {
  return made(program, [&] { return new ssrvlad_map(Listing(drives_of(drives))); });
}

ssrvlad_map *ssrvlad_map_of_for(int program, const ssrvlad_drives *drives, const ssrvlad_shortlist *shortlist) {
  return made(program, [&] {
    Drives all = drives_of(drives);
    const char *expected = "a shortlist of rising rows, each with a weight from 1";
    require(shortlist && shortlist->rows && shortlist->weights && shortlist->count >= 1, expected);
    const auto [rows, weights, count, means, means_count] = *shortlist;
    for (Size place = 0; place < count; ++place)
      require(rows[place] < all.rows && (place ? rows[place] > rows[place - 1] : rows[place] >= 0) &&
              weights[place] >= 1 && std::isfinite(weights[place]), expected);
    const ssrvlad_drives parts = {means, means_count, count};
    return new ssrvlad_map(Listing(std::move(all), rows, {weights, weights + count}, drives_of(&parts)));
  });
}

void ssrvlad_map_free(ssrvlad_map *map) { delete map; }

int ssrvlad_map_add_channel(ssrvlad_map *map, const ssrvlad_channel *channel) {
  return guarded([&] {
    require(map && channel);
    map->add(*channel);
  });
}

int ssrvlad_map_query(const ssrvlad_map *map, const ssrvlad_queries *queries, int64_t count,
                      const ssrvlad_steps *steps, int threads, ssrvlad_decision *decision,
                      ssrvlad_taken *taken) {
  return guarded([&] {
    check(map, queries, count, steps, taken);
    require(decision);
    if (steps->follow == SSRVLAD_ONLINE)
      return track(*map, {queries, queries + map->channels()}, count, *steps, threads, *decision, *taken);
    const auto scores = map->compare(queries, count, *steps, threads, *taken);
    give(decide(map->listing(), *scores, steps->follow == SSRVLAD_OFFLINE, threads, steps->top), 0, *decision);
  });
}

int ssrvlad_map_compare(const ssrvlad_map *map, const ssrvlad_queries *queries, int64_t count,
                        const ssrvlad_steps *steps, int threads, float *scores, ssrvlad_taken *taken) {
  return guarded([&] {
    check(map, queries, count, steps, taken);
    require(scores || !count);
    const auto compared = map->compare(queries, count, *steps, threads, *taken);
    for (Size query = 0; query < count; ++query) compared->of(query, scores + query * map->listing().count());
  });
}

ssrvlad_tracker *ssrvlad_tracker_new_for(int program, const ssrvlad_map *map, const ssrvlad_steps *steps) {
  return made(program, [&] {
    require(map && steps && map->channels() && steps->delay >= 0 && steps->top >= 1,
            "a map of one channel or more, and steps in range");
    return new ssrvlad_tracker(*map, *steps);
  });
}

void ssrvlad_tracker_free(ssrvlad_tracker *tracker) { delete tracker; }

int64_t ssrvlad_tracker_count(const ssrvlad_tracker *tracker) { return tracker ? tracker->count() : -1; }

int ssrvlad_tracker_update(ssrvlad_tracker *tracker, const ssrvlad_queries *queries, int threads,
                           ssrvlad_decision *decision, ssrvlad_taken *taken, int64_t *query) {
  return changed(tracker, [&] {
    require(tracker && queries && decision && taken && query);
    *query = -1;
    tracker->update(queries, nullptr, threads);
    if (tracker->waits_long_enough()) *query = give(*tracker, 0, *decision, *taken);
  });
}

int ssrvlad_tracker_finish(ssrvlad_tracker *tracker, ssrvlad_decision *decision, ssrvlad_taken *taken,
                           int64_t *query) {
  return changed(tracker, [&] {
    require(tracker && decision && taken && query);
    *query = -1;
    if (tracker->waiting()) *query = give(*tracker, 0, *decision, *taken);
  });
}

int64_t ssrvlad_tracker_save(ssrvlad_tracker *tracker, void *state, int64_t size) {
  int64_t bytes = -1;
  guarded([&] {
    require(tracker && tracker->is_whole && (state || size <= 0), "a tracker that memory was enough for, and room");
    const std::vector<std::uint8_t> &saved = tracker->save();
    bytes = static_cast<int64_t>(saved.size());
    if (bytes <= size) std::copy(saved.begin(), saved.end(), static_cast<std::uint8_t *>(state));
  });
  return bytes;
}

int ssrvlad_tracker_load(ssrvlad_tracker *tracker, const void *state, int64_t size) {
  return changed(tracker, [&] {
    require(tracker && state && size >= 0);
    tracker->load(static_cast<const std::uint8_t *>(state), size);
  });
}
