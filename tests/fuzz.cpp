// Made-up label maps, maps and streams of every shape and setting, drawn by seeds: what the core says of
// them is in range. Every so often memory runs short: then it says so. Run as: fuzz FIRST COUNT [bits]
//
// With `bits` memory is there, and a digest of all bits of the answers is printed for each seed: on all processors
// the same.

#include <atomic>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <new>
#include <random>
#include <vector>

#include "ssrvlad_loops.h"
#include "ssrvlad_map.h"

namespace {

std::atomic<long> allocations_left{-1};  // before one fails; -1: none does

void *allocated(std::size_t bytes) {
  if (allocations_left >= 0 && allocations_left-- == 0) throw std::bad_alloc();
  if (void *memory = std::malloc(bytes ? bytes : 1)) return memory;
  throw std::bad_alloc();
}

long long seed;
bool only_bits = false;
std::uint64_t digest;
std::mt19937_64 noise;

void expect(bool holds, const char *what, double got = NAN) {
  if (holds) return;
  std::printf("seed %lld: %s, got %g\n", seed, what, got);
  std::exit(1);
}

template <typename Number>
void see(const Number *numbers, int64_t count) {
  const auto *bytes = reinterpret_cast<const unsigned char *>(numbers);
  for (std::size_t at = 0; at < count * sizeof(Number); ++at) digest = (digest ^ bytes[at]) * 0x100000001b3;
}

int64_t between(int64_t least, int64_t most) {
  return least + static_cast<int64_t>(noise() % static_cast<std::uint64_t>(most - least + 1));
}
bool one_in(int64_t count) { return !between(0, count - 1); }
double fraction() { return static_cast<double>(noise() >> 11) * 0x1p-53; }
float number() { return static_cast<float>(fraction() * 2 - 1); }

// Calls a function of the core; where an allocation fails, the status is that.
template <typename Function>
bool called(Function function, bool fails = !only_bits && one_in(4)) {
  if (fails) allocations_left = between(0, 400);
  const int64_t status = function();
  const bool failed = fails && allocations_left < 0;
  allocations_left = -1;
  expect(!status || (failed && status == SSRVLAD_NO_MEMORY), "a status of a call", static_cast<double>(status));
  return !status;
}

// Descriptors of `count` frames that go through a street of few places, some of them empty: (count,
// anchors, size) numbers of length 1, or bytes.
struct Frames {
  int64_t count, anchors, size;
  std::vector<float> vectors;
  std::vector<unsigned char> signs;

  Frames(int64_t frames, int64_t sides, int64_t numbers, double speed) : count(frames), anchors(sides), size(numbers) {
    const int64_t places = between(1, 60), start = between(0, 60);
    const float strength = static_cast<float>(fraction());
    for (int64_t frame = 0; frame < count; ++frame) {
      const auto place = static_cast<int64_t>(std::abs(static_cast<double>(start) + speed * static_cast<double>(frame))) % places;
      std::mt19937 look(static_cast<unsigned>(place));
      const bool empty = one_in(20);
      for (int64_t anchor = 0; anchor < anchors; ++anchor) {
        double squares = 0;
        for (int64_t n = 0; n < size; ++n) {
          const float seen = static_cast<float>(look() % 2001) / 1000 - 1 + strength * number();
          vectors.push_back(empty ? 0 : seen);
          squares += static_cast<double>(seen) * static_cast<double>(seen);
          if (!anchor) signs.push_back(static_cast<unsigned char>(look() ^ (noise() & noise() & noise())));
        }
        for (int64_t n = 0; n < size; ++n)
          vectors[vectors.size() - static_cast<std::size_t>(size - n)] /= static_cast<float>(std::sqrt(squares + 1e-30));
      }
    }
    vectors.resize(vectors.size() + 1), signs.resize(signs.size() + 1);  // no null pointers
  }
};

std::vector<int64_t> drives_of(int64_t rows) {
  std::vector<int64_t> starts;
  for (int64_t row = 0; row < rows; ++row)
    if (!row || one_in(40)) starts.push_back(row);
  return starts;
}

// A tracker sees one query again and again; its state goes into another, and damaged into none.
void tracks(const ssrvlad_map *map, const std::vector<ssrvlad_queries> &asked, ssrvlad_steps steps, ssrvlad_decision &decision, ssrvlad_taken &taken) {
  steps.delay = between(0, 12);
  ssrvlad_tracker *tracker = ssrvlad_tracker_new(map, &steps), *other = ssrvlad_tracker_new(map, &steps), *third = ssrvlad_tracker_new(map, &steps);
  int64_t query = -1;
  const int64_t frames = between(0, 40);
  for (int64_t frame = 0; frame < frames; ++frame) {
    expect(!ssrvlad_tracker_update(tracker, asked.data(), 1, &decision, &taken, &query), "an update");
    expect(query == (frame < steps.delay ? -1 : frame - steps.delay), "the number of a query", static_cast<double>(query));
  }
  std::vector<unsigned char> state(static_cast<std::size_t>(ssrvlad_tracker_save(tracker, nullptr, 0)));
  ssrvlad_tracker_save(tracker, state.data(), static_cast<int64_t>(state.size()));
  expect(!ssrvlad_tracker_load(other, state.data(), static_cast<int64_t>(state.size())), "a state");
  expect(ssrvlad_tracker_count(other) == frames, "the count of queries");
  state[static_cast<std::size_t>(noise() % state.size())] ^= 1;
  expect(ssrvlad_tracker_load(third, state.data(), between(0, static_cast<int64_t>(state.size()))) == SSRVLAD_WRONG_ARGUMENT, "a damaged state is refused");
  for (ssrvlad_tracker *each : {tracker, other})
    for (int64_t waiting = std::min(frames, steps.delay); waiting >= 0; --waiting) {
      expect(!ssrvlad_tracker_finish(each, &decision, &taken, &query), "the end");
      expect(query == (waiting ? frames - waiting : -1), "the number of a late query", static_cast<double>(query));
      if (waiting) see(decision.scores, steps.top), see(decision.rows, steps.top), see(decision.right, 1);
    }
  const auto update = [&] { return ssrvlad_tracker_update(other, asked.data(), 1, &decision, &taken, &query); };
  if (!called(update)) {
    expect(update() == SSRVLAD_WRONG_ARGUMENT, "no query after memory was short");
    expect(ssrvlad_tracker_finish(other, &decision, &taken, &query) == SSRVLAD_WRONG_ARGUMENT, "no answer either");
    expect(ssrvlad_tracker_save(other, nullptr, 0) == -1, "nor a state");
  }
  for (ssrvlad_tracker *each : {tracker, other, third}) ssrvlad_tracker_free(each);
}

void finds() {
  const int64_t rows = one_in(5) ? between(0, 3) : between(1, 160), queries = one_in(5) ? between(0, 2) : between(0, 70);
  const auto starts = drives_of(rows);
  const ssrvlad_drives drives{starts.data(), static_cast<int64_t>(starts.size()), rows};
  std::vector<int64_t> listed;
  for (int64_t row = 0; row < rows; ++row)
    if (!row || one_in(2)) listed.push_back(row);
  const bool is_whole = listed.empty() || !one_in(3);
  const int64_t count = is_whole ? rows : static_cast<int64_t>(listed.size()), mean = 0;
  std::vector<double> stand_for(listed.size(), 1 + fraction());
  const ssrvlad_shortlist shortlist{listed.data(), stand_for.data(), count, &mean, 1};
  ssrvlad_map *map = is_whole ? ssrvlad_map_new(&drives) : ssrvlad_map_of(&drives, &shortlist);
  expect(map, "a map");
  std::vector<Frames> there, here;
  std::vector<float> by_scores;  // of another method
  for (int64_t score = 0; score <= queries * count; ++score) by_scores.push_back(one_in(9) ? -INFINITY : number());
  std::vector<ssrvlad_queries> asked;
  const double speed = fraction() * 4 - 1.5;
  const auto channels = between(1, 3), top = between(1, 8);
  there.reserve(3), here.reserve(3);
  for (int64_t channel = 0; channel < channels; ++channel) {
    const bool vectors = one_in(2), scores = one_in(4);
    const int64_t columns = vectors ? 1 : between(1, 8), height = vectors ? 1 : between(1, 4);
    const int64_t size = vectors ? between(1, 64) : between(1, 20);
    there.emplace_back(count, 1, columns * height * size, 1);
    here.emplace_back(queries, vectors && one_in(2) ? 2 * between(0, 7) + 1 : 1, columns * height * size, speed);
    ssrvlad_channel added{};
    added.kind = vectors ? SSRVLAD_VECTORS : SSRVLAD_SIGNS;
    added.rows = vectors ? static_cast<const void *>(there.back().vectors.data()) : there.back().signs.data();
    added.columns = columns, added.height = height, added.size = size, added.trust = 0.5 + fraction();
    if (scores) added.kind = SSRVLAD_SCORES, added.rows = nullptr, added.columns = added.height = added.size = 1;
    expect(!ssrvlad_map_add_channel(map, &added), "a channel");
    ssrvlad_queries seen{};
    seen.descriptors = vectors ? static_cast<const void *>(here.back().vectors.data()) : here.back().signs.data();
    seen.anchors = here.back().anchors;
    if (scores) seen.descriptors = by_scores.data(), seen.anchors = 1;
    asked.push_back(seen);
  }
  std::vector<float> scores(static_cast<std::size_t>(queries * top + 1)), right(scores), spread(scores), together(scores);
  std::vector<int64_t> found(scores.size());
  std::vector<double> weights(static_cast<std::size_t>(channels));
  ssrvlad_steps steps{};
  steps.standardise = one_in(2), steps.sweep = one_in(2), steps.follow = static_cast<int32_t>(between(0, 2));
  steps.delay = one_in(4) ? int64_t{1} << 40 : between(0, 12), steps.top = top;
  std::vector<unsigned char> allowed(static_cast<std::size_t>(count + 1));
  std::vector<int64_t> excluded;
  for (unsigned char &each : allowed) each = !one_in(5);
  for (int64_t query = 0; query < queries; ++query) {
    const int64_t first = between(0, rows);
    excluded.push_back(first), excluded.push_back(between(first, rows));
  }
  if (one_in(2)) steps.allowed = allowed.data();
  if (one_in(2)) steps.excluded = excluded.data();
  ssrvlad_decision decision{};
  decision.scores = scores.data(), decision.rows = found.data(), decision.right = right.data();
  decision.spread = spread.data(), decision.together = together.data();
  ssrvlad_taken taken{};
  taken.weights = weights.data();
  const int threads = static_cast<int>(between(1, 3));
  if (called([&] { return ssrvlad_map_query(map, asked.data(), queries, &steps, threads, &decision, &taken); })) {
    for (const auto *numbers : {&scores, &right, &spread, &together}) see(numbers->data(), queries);
    see(found.data(), queries * top), see(weights.data(), channels), see(&decision.gain, 1);
    for (int64_t query = 0; query < queries; ++query) {
      expect(right[query] >= 0 && right[query] <= 1, "a probability", right[query]);
      expect(spread[query] >= 0 && spread[query] <= 1, "a deviation", spread[query]);
      expect(together[query] >= 1, "answers together", together[query]);
    }
    for (int64_t place = 0; place < queries * top; ++place) {
      expect(scores[place] <= 1.001F, "a score", scores[place]);
      expect(found[place] >= -1 && found[place] < rows, "a row", static_cast<double>(found[place]));
    }
  }
  if (queries && decision.scores) tracks(map, asked, steps, decision, taken);
  std::vector<float> cosines(static_cast<std::size_t>(queries * count + 1));
  if (called([&] { return ssrvlad_map_compare(map, asked.data(), queries, &steps, threads, cosines.data(), &taken); }))
    for (int64_t each = 0; each < queries * count; ++each) expect(cosines[each] <= 1.001F, "a cosine", cosines[each]);
  see(cosines.data(), queries * count);
  by_scores[0] = NAN, steps.allowed = nullptr, steps.excluded = nullptr;
  if (queries && count && asked[0].descriptors == by_scores.data())
    expect(ssrvlad_map_query(map, asked.data(), queries, &steps, threads, &decision, &taken) == SSRVLAD_WRONG_ARGUMENT, "NaN is refused");
  ssrvlad_map_free(map);
}

void closes() {
  const int64_t frames = between(0, 200), count = between(1, 3);
  std::vector<ssrvlad_loops_channel> channels;
  std::vector<Frames> seen;
  for (int64_t channel = 0; channel < count; ++channel) {
    const bool vectors = one_in(2);
    const int64_t size = between(1, 40), columns = between(1, 8), height = between(1, 4), cell = between(1, 9);
    channels.push_back({vectors ? SSRVLAD_VECTORS : SSRVLAD_SIGNS, {vectors ? size : columns, vectors ? 1 : height, vectors ? 1 : cell}, 0.5 + 5 * fraction()});
    seen.emplace_back(frames, 1, vectors ? size : columns * height * cell, fraction() * 3 - 1);
  }
  const ssrvlad_loops_settings settings{one_in(5) ? int64_t{1} << 62 : between(0, 30), fraction(), one_in(3) ? 50000 : between(1, 60)};
  ssrvlad_loops *loops = ssrvlad_loops_new(&settings, channels.data(), static_cast<int>(count));
  expect(loops, "a stream");
  if (one_in(4)) expect(!ssrvlad_loops_reserve(loops, between(0, 300)), "memory for frames");
  const bool runs_short = !only_bits && one_in(4);
  const void *none[3] = {};
  const std::uint8_t no_starts = 0;
  expect(!ssrvlad_loops_extend(loops, none, nullptr, &no_starts, 0), "no frames that are known");
  for (int64_t frame = 0; frame < frames; ++frame) {
    std::vector<const void *> descriptors;
    for (int64_t channel = 0; channel < count; ++channel) {
      const Frames &of = seen[channel];
      const auto at = static_cast<std::size_t>(frame * of.size);
      descriptors.push_back(channels[channel].kind == SSRVLAD_VECTORS ? static_cast<const void *>(&of.vectors[at]) : &of.signs[at]);
    }
    const double stamp = one_in(9) ? NAN : static_cast<double>(frame + 1000 * (frame / 90));
    const std::uint8_t starts = one_in(60);
    ssrvlad_loop loop;
    const bool is_known = one_in(12);
    const int threads = static_cast<int>(between(1, 3));
    const auto take = [&] {
      return is_known ? ssrvlad_loops_extend(loops, descriptors.data(), &stamp, &starts, 1)
                      : ssrvlad_loops_update(loops, descriptors.data(), nullptr, stamp, starts, threads, &loop);
    };
    if (!called(take, runs_short && one_in(30))) {
      expect(take() == SSRVLAD_WRONG_ARGUMENT, "no frame after memory was short");
      std::vector<float> copy(static_cast<std::size_t>(frame * seen[0].size + 1));
      expect(!ssrvlad_loops_descriptors(loops, 0, 0, ssrvlad_loops_rows(loops), copy.data()), "the frames before");
      break;
    }
    if (!is_known) {
      expect(loop.reason >= 0 && loop.reason <= SSRVLAD_BELOW_THRESHOLD, "a reason", loop.reason);
      expect(loop.candidate >= -1 && loop.candidate < frame, "a candidate", static_cast<double>(loop.candidate));
      expect(loop.probability >= 0 && loop.probability <= 1, "a probability", loop.probability);
      expect(loop.score <= 1.001, "a score", loop.score);
      see(&loop.reason, 1), see(&loop.candidate, 1), see(&loop.score, 1), see(&loop.probability, 1);
      for (int place = 0; place < loop.places; ++place)
        expect(loop.best[place].row >= 0 && loop.best[place].row < frame, "a place", static_cast<double>(loop.best[place].row));
    }
    expect(ssrvlad_loops_rows(loops) == frame + 1, "a row a frame");
  }
  ssrvlad_loops_free(loops);
}

void describes() {
  ssrvlad_settings settings;
  ssrvlad_preset(one_in(2) ? "paper" : "default", &settings);
  settings.closing = fraction() / 2, settings.opening = fraction() / 5, settings.hole_area = fraction() / 10;
  settings.thinning = static_cast<int32_t>(between(0, 1)), settings.context = static_cast<int32_t>(between(0, 1));
  settings.rings = static_cast<int32_t>(between(1, 8)), settings.sectors = static_cast<int32_t>(between(1, 24));
  settings.radius = 0.05 + 0.95 * fraction(), settings.inner_radius = 0.05 + 0.95 * fraction();
  settings.working_size = static_cast<int32_t>(one_in(2) ? between(1, 130) : 0);
  const int64_t most = settings.rings * (2 * ((settings.sectors + 1) / 2) - 1);
  settings.harmonics = static_cast<int32_t>(between(1, most)), settings.boundary_harmonics = static_cast<int32_t>(between(1, most));
  ssrvlad_head *head = ssrvlad_new(&settings);
  expect(head, "a head");
  const int64_t images = between(1, 3), height = between(1, 150), width = between(1, 200), grain = between(1, 40);
  std::vector<unsigned char> categories(256), ids;
  for (auto &category : categories) category = static_cast<unsigned char>(between(0, 8));
  for (int64_t pixel = 0; pixel < images * height * width; ++pixel)
    ids.push_back(static_cast<unsigned char>(one_in(30) ? noise() : static_cast<std::uint64_t>(pixel / width / grain * 31 + pixel % width / grain * 7)));
  const ssrvlad_table table{categories.data(), 256, 0};
  const ssrvlad_labels labels{ids.data(), 1, images, height, width};
  std::vector<float> descriptors(static_cast<std::size_t>(images * ssrvlad_length(head)));
  const int threads = static_cast<int>(between(1, 3));
  if (called([&] { return ssrvlad_describe(head, &labels, &table, threads, descriptors.data()); }))
    for (int64_t image = 0; image < images; ++image) {
      double squares = 0;
      for (int64_t n = 0; n < ssrvlad_length(head); ++n) squares += std::pow(descriptors[image * ssrvlad_length(head) + n], 2);
      expect(squares == 0 || std::abs(squares - 1) < 1e-4, "a length of 1", squares);
    }
  see(descriptors.data(), static_cast<int64_t>(descriptors.size()));
  ssrvlad_free(head);
}

}  // namespace

void *operator new(std::size_t bytes) { return allocated(bytes); }
void *operator new[](std::size_t bytes) { return allocated(bytes); }
void operator delete(void *memory) noexcept { std::free(memory); }
void operator delete[](void *memory) noexcept { std::free(memory); }
void operator delete(void *memory, std::size_t) noexcept { std::free(memory); }
void operator delete[](void *memory, std::size_t) noexcept { std::free(memory); }

int main(int count_of_arguments, char **arguments) {
  only_bits = count_of_arguments > 3;
  const long long first = std::atoll(arguments[1]), count = std::atoll(arguments[2]);
  for (seed = first; seed < first + count; ++seed) {
    noise.seed(static_cast<std::uint64_t>(seed)), digest = 0xcbf29ce484222325;
    finds(), closes(), describes();
    if (only_bits) std::printf("%lld %016llx\n", seed, static_cast<unsigned long long>(digest));
  }
  std::puts("clean");
}
