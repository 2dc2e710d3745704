// The functions of the C headers: they check arguments, and what is thrown becomes a return code.

#include <cstdarg>
#include <cstdio>
#include <cstring>
#include <exception>

#include "describe.hpp"
#include "interface.hpp"
#include "loops.hpp"
#include "map.hpp"
#include "products.hpp"
#include "signs.hpp"
#include "tracker.hpp"
#include "ssrvlad_loops.h"
#include "ssrvlad_map.h"

using namespace places;

struct ssrvlad_head : Head {
  explicit ssrvlad_head(const ssrvlad_settings &settings)
      : Head(settings), fingerprint(fingerprint_of(settings)) {}
  const std::string fingerprint;
};

struct ssrvlad_map : Map {
  using Map::Map;
};

struct ssrvlad_tracker : Tracker {
  using Tracker::Tracker;
};

struct ssrvlad_loops {
  Stream stream;
};

namespace {

thread_local char last_error[256];

void say(const char *reason) { std::snprintf(last_error, sizeof last_error, "%s", reason); }

// Runs a function of the interface; what it throws becomes a return code.
template <typename Function>
int guarded(Function function) {
  try {
    function();
    return SSRVLAD_OK;
  } catch (const Failed &failed) {
    return static_cast<int>(std::max<int64_t>(failed.code, std::numeric_limits<int>::min()));
  } catch (const WrongScores &) {
    say("expected scores of at most 1.001, got a higher one or NaN");
    return SSRVLAD_WRONG_ARGUMENT;
  } catch (const std::exception &) {  // bad_alloc, or length_error of sizes beyond memory
    say("not enough memory");
    return SSRVLAD_NO_MEMORY;
  }
}

// What a function makes for a program of this interface, or NULL.
template <typename Function>
auto made(int program, Function function) -> decltype(function()) {
  decltype(function()) result = nullptr;
  guarded([&] {
    if (program != SSRVLAD_INTERFACE)
      refuse("the library ssrvlad has interface %d, the program is of %d: compile it again",
             SSRVLAD_INTERFACE, program);
    result = function();
  });
  return result;
}

template <typename Number, typename Other>
void give(const std::vector<Number> &values, Other *target) {
  require(target || values.empty());
  std::copy(values.begin(), values.end(), target);
}

void give(const Decision &decided, ssrvlad_decision &decision) {
  give(decided.scores, decision.scores);
  give(decided.rows, decision.rows);
  give(decided.right, decision.right);
  give(decided.spread, decision.spread);
  give(decided.together, decision.together);
  decision.followed = decided.followed;
  decision.way = decided.course.way;
  decision.rate = decided.course.rate;
  decision.streams = decided.course.streams;
  decision.gain = decided.gain;
  if (decision.follows) give(decided.follows, decision.follows);
}

void give(const Answer &answer, bool standardised, ssrvlad_decision &decision, ssrvlad_taken &taken, int64_t &query) {
  give(answer, decision);
  taken.standardised = standardised;
  taken.width = answer.width;
  give(answer.weights, taken.weights);
  query = answer.query;
}

}  // namespace

void places::refuse(const char *reason, ...) {
  std::va_list values;
  va_start(values, reason);
  std::vsnprintf(last_error, sizeof last_error, reason, values);
  va_end(values);
  throw Failed{SSRVLAD_WRONG_ARGUMENT};
}

// -------------------------------------------------------------------------------------- ssrvlad.h

namespace {

constexpr Size MOST_PIXELS = Size{1} << 31, MOST_BYTES = Size{1} << 58;

void check(const ssrvlad_settings *settings) {
  require(settings, "settings");
  const ssrvlad_settings &s = *settings;
  require_range("opening", s.opening, 0, 0.5);
  require_range("closing", s.closing, 0, 0.5);
  require_range("hole_area", s.hole_area, 0, 1);
  require_range("region_area", s.region_area, 0, 1);
  require_range("radius", s.radius, 1e-300, 1);
  require_range("inner_radius", s.inner_radius, 1e-300, 1);
  require_range("spectral_weight", s.spectral_weight, 0, 4);
  require_range("power", s.power, 0.5, 1);
  require_range("working_size", s.working_size, 0, 1 << 14);
  require_range("rings", s.rings, 1, 64);
  require_range("sectors", s.sectors, 1, 360);
  require_range("thinning", s.thinning, SSRVLAD_ZHANG_SUEN, SSRVLAD_GUO_HALL);
  require_range("context", s.context, SSRVLAD_SKELETON, SSRVLAD_KEYPOINTS);
  require_range("aggregation", s.aggregation, SSRVLAD_RESIDUALS, SSRVLAD_HARMONICS);
  require_range("anchor", s.anchor, SSRVLAD_VANISHING_COLUMN, SSRVLAD_MIDDLE);
  const bool unused = s.aggregation == SSRVLAD_RESIDUALS;
  const int most = unused ? 1 << 12 : s.rings * (2 * ((s.sectors + 1) / 2) - 1);
  require_range("harmonics", s.harmonics, 1, std::min(most, 1 << 12));
  require_range("boundary_harmonics", s.boundary_harmonics, 1, std::min(most, 1 << 12));
}

void check(const ssrvlad_labels *labels, const ssrvlad_table *table) {
  require(labels && table, "label maps and a table");
  const auto [ids, bytes, images, height, width] = *labels;
  require(ids, "images");
  if (images < 1 || height < 1 || width < 1 || height >= MOST_PIXELS / width ||
      images > MOST_BYTES / 8 / height / width)
    refuse("expected images of up to 2^31 pixels, got %lld of %lld x %lld", static_cast<long long>(images),
           static_cast<long long>(height), static_cast<long long>(width));
  if (bytes != 1 && bytes != 2 && bytes != 4 && bytes != 8)
    refuse("expected ids of 1, 2, 4 or 8 bytes, got %d", bytes);
  require(table->categories && table->entries > 0 && table->origin >= 0 && table->origin < table->entries,
          "a table of categories with its origin among its entries");
}

}  // namespace

#ifndef SSRVLAD_SOURCE
#define SSRVLAD_SOURCE ""
#endif

const char *ssrvlad_last_error(void) { return last_error; }

const char *ssrvlad_source(void) { return SSRVLAD_SOURCE; }

const char *ssrvlad_simd(void) { return simd_name(); }

int ssrvlad_interface(void) { return SSRVLAD_INTERFACE; }

int ssrvlad_preset(const char *name, ssrvlad_settings *settings) {
  return guarded([&] {
    require(name && settings, "the name of a preset and settings");
    const bool paper = !std::strcmp(name, "paper");
    if (!paper && std::strcmp(name, "default")) refuse("expected the preset default or paper, got %s", name);
    ssrvlad_settings s{};
    s.opening = 0.0, s.closing = 0.01, s.hole_area = 0.002, s.region_area = 0.0005;
    s.radius = 0.5, s.inner_radius = paper ? 1.0 / 16 : 1.0 / 6;
    s.spectral_weight = 1.0, s.power = 0.75;
    s.working_size = paper ? 0 : 120;
    s.rings = paper ? 5 : 6, s.sectors = paper ? 12 : 20;
    s.harmonics = 64, s.boundary_harmonics = 24;
    s.thinning = SSRVLAD_ZHANG_SUEN, s.context = SSRVLAD_SKELETON;
    s.aggregation = paper ? SSRVLAD_RESIDUALS : SSRVLAD_HARMONICS;
    s.anchor = SSRVLAD_VANISHING_COLUMN;
    *settings = s;
  });
}

ssrvlad_head *ssrvlad_new_for(int program, const ssrvlad_settings *settings) {
  return made(program, [&] {
    check(settings);
    return new ssrvlad_head(*settings);
  });
}

void ssrvlad_free(ssrvlad_head *head) { delete head; }

int64_t ssrvlad_length(const ssrvlad_head *head) {
  return head ? head->length() : Size{SSRVLAD_WRONG_ARGUMENT};
}

const char *ssrvlad_fingerprint(const ssrvlad_head *head) { return head ? head->fingerprint.c_str() : ""; }

int64_t ssrvlad_describe(ssrvlad_head *head, const ssrvlad_labels *labels,
                         const ssrvlad_table *table, int threads, float *descriptors) {
  int64_t unknown = 0;
  const int code = guarded([&] {
    require(head && descriptors, "a head and memory for descriptors");
    check(labels, table);
    unknown = head->describe(*labels, *table, threads, descriptors);
  });
  return code ? code : unknown;
}

// ---------------------------------------------------------------------------------- ssrvlad_map.h

namespace {

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
  require(map && queries && steps && taken && map->channels() && count >= 0, "a map of one channel or more, queries and steps");
  require(steps->follow >= SSRVLAD_ALONE && steps->follow <= SSRVLAD_OFFLINE && steps->delay >= 0 &&
          steps->top >= 1, "steps in range");
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
    give(map->query(queries, count, *steps, threads, *taken), *decision);
  });
}

int ssrvlad_map_compare(const ssrvlad_map *map, const ssrvlad_queries *queries, int64_t count,
                        const ssrvlad_steps *steps, int threads, float *scores, ssrvlad_taken *taken) {
  return guarded([&] {
    check(map, queries, count, steps, taken);
    require(scores || !count);
    const auto compared = map->compare(queries, count, *steps, threads, *taken);
    for (Size query = 0; query < count; ++query) compared->of(query, scores + query * compared->rows());
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
  return guarded([&] {
    require(tracker && queries && decision && taken && query);
    *query = -1;
    tracker->update(queries, nullptr, threads);
    if (tracker->waits_long_enough()) give(tracker->answer(), tracker->standardised(), *decision, *taken, *query);
  });
}

int ssrvlad_tracker_finish(ssrvlad_tracker *tracker, ssrvlad_decision *decision, ssrvlad_taken *taken,
                           int64_t *query) {
  return guarded([&] {
    require(tracker && decision && taken && query);
    *query = -1;
    if (tracker->waiting()) give(tracker->answer(), tracker->standardised(), *decision, *taken, *query);
  });
}

int64_t ssrvlad_tracker_save(ssrvlad_tracker *tracker, void *state, int64_t size) {
  int64_t bytes = -1;
  guarded([&] {
    require(tracker && (state || size <= 0));
    const std::vector<std::uint8_t> saved = tracker->save();
    bytes = static_cast<int64_t>(saved.size());
    if (bytes <= size) std::copy(saved.begin(), saved.end(), static_cast<std::uint8_t *>(state));
  });
  return bytes;
}

int ssrvlad_tracker_load(ssrvlad_tracker *tracker, const void *state, int64_t size) {
  return guarded([&] {
    require(tracker && state && size >= 0);
    tracker->load(static_cast<const std::uint8_t *>(state), size);
  });
}

// -------------------------------------------------------------------------------- ssrvlad_loops.h

namespace {

constexpr int64_t MOST_EXCLUDED = int64_t{1} << 62, MOST_RESERVED = int64_t{1} << 40;
constexpr int64_t MOST = int64_t{1} << 31;  // numbers of a descriptor, and signs

void check(const ssrvlad_loops_channel &channel) {
  require_range("kind", channel.kind, SSRVLAD_VECTORS, SSRVLAD_SIGNS);
  require(channel.trust > 0 && channel.trust < 1e300, "a trust above 0");
  int64_t size = 1;
  for (const int64_t axis : channel.shape) {
    require(axis >= 1 && axis <= MOST / size, "shapes of up to 2^31 numbers");
    size *= axis;
  }
  require(channel.kind == SSRVLAD_SIGNS || channel.shape[0] == size, "the shape of vectors: their length, 1, 1");
}

// Whether there are descriptors of one frame that can be such.
bool fits(const Stream &stream, const void *const *descriptors, const int64_t *anchors) {
  for (std::size_t number = 0; descriptors && number < stream.channels().size(); ++number)
    if (!descriptors[number] ||
        !stream.channels()[number]->fits(descriptors[number], anchors ? anchors[number] : 1))
      return false;
  return descriptors;
}

}  // namespace

ssrvlad_loops *ssrvlad_loops_new_for(int program, const ssrvlad_loops_settings *settings,
                                     const ssrvlad_loops_channel *channels, int count) {
  return made(program, [&] {
    require(settings && channels, "settings and channels");
    require_range("channels", count, 1, SSRVLAD_CHANNELS);
    require(settings->exclude >= 0, "frames to exclude, or 0");
    require_range("threshold", settings->threshold, 0, 1);
    require(settings->scan_above > 0, "scan_above of 1 frame or more");
    std::for_each(channels, channels + count, [](const auto &channel) { check(channel); });
    auto capped = *settings;
    capped.exclude = std::min(capped.exclude, MOST_EXCLUDED);
    return new ssrvlad_loops{Stream(capped, channels, count)};
  });
}

void ssrvlad_loops_free(ssrvlad_loops *loops) { delete loops; }

int ssrvlad_loops_reserve(ssrvlad_loops *loops, int64_t frames) {
  return guarded([&] {
    require(loops && frames >= 0 && frames <= MOST_RESERVED, "a stream, and a number of frames up to 2^40");
    loops->stream.reserve(frames);
  });
}

int64_t ssrvlad_loops_rows(const ssrvlad_loops *loops) { return loops ? loops->stream.rows() : 0; }

int ssrvlad_loops_update(ssrvlad_loops *loops, const void *const *descriptors, const int64_t *anchors,
                         double stamp, int starts, int threads, ssrvlad_loop *result) {
  return guarded([&] {
    require(loops && result, "a stream and memory for the result");
    require(fits(loops->stream, descriptors, anchors),
            "finite vectors of length 1 or 0, from an odd number of anchors, and signs from 1");
    *result = loops->stream.update(descriptors, anchors, stamp, starts != 0, threads);
  });
}

int ssrvlad_loops_extend(ssrvlad_loops *loops, const void *const *descriptors, const double *stamps,
                         const uint8_t *starts, int64_t frames) {
  return guarded([&] {
    require(loops && descriptors && starts && frames >= 0, "a stream, descriptors and starts");
    const auto &channels = loops->stream.channels();
    const auto frame = [&](int64_t row) {
      std::vector<const void *> addresses;
      for (std::size_t number = 0; number < channels.size(); ++number)
        addresses.push_back(static_cast<const std::uint8_t *>(descriptors[number]) +
                        row * channels[number]->bytes());
      return addresses;
    };
    for (int64_t row = 0; row < frames; ++row)
      require(fits(loops->stream, frame(row).data(), nullptr), "finite vectors of length 1 or 0");
    for (int64_t row = 0; row < frames; ++row) {
      const double stamp = stamps ? stamps[row] : std::numeric_limits<double>::quiet_NaN();
      loops->stream.extend(frame(row).data(), stamp, starts[row] != 0);
    }
    if (frames >= loops->stream.rows() / 10) loops->stream.settle();
  });
}

int ssrvlad_loops_descriptors(const ssrvlad_loops *loops, int channel, int64_t first, int64_t last,
                              void *descriptors) {
  return guarded([&] {
    require(loops && descriptors && channel >= 0 && first >= 0 && last >= first && last <= loops->stream.rows() &&
                static_cast<std::size_t>(channel) < loops->stream.channels().size(),
            "a channel and rows of the stream");
    loops->stream.channels()[static_cast<std::size_t>(channel)]->copy(first, last, descriptors);
  });
}

void ssrvlad_loops_weights(const ssrvlad_loops *loops, double *weights) {
  if (!loops || !weights) return;
  for (const double weight : loops->stream.weights()) *weights++ = weight;
}
