// The decision of decide.hpp.

#include "decide.hpp"

#include <numeric>
#include <random>

#include "evidence.hpp"
#include "parallel.hpp"

namespace places {

namespace {
constexpr Size KEPT = Size{1} << 24;  // numbers that are kept rather than computed again
constexpr Size BLOCK = 16;            // queries that are shared among threads

// ------------------------------------------------------------------------------------------ following

// One belief in so many is kept, and the others are computed again: new memory costs more than they do.
Size stride_of(Size queries) { return static_cast<Size>(std::sqrt(static_cast<double>(queries))); }

// `kept` may have what was seen at each stride.
void follow_offline(const Filter &filter, const Evidence &evidence, const std::vector<Size> &queries, int threads,
                    std::vector<Seen> kept, Places &places) {
  const auto count = static_cast<Size>(queries.size()), stride = stride_of(evidence.queries());
  Walk walk{filter, {}};
  for (Size query = 0; static_cast<Size>(kept.size()) * stride < count; ++query) {
    walk.step(evidence, queries[query]);
    if (query % stride == 0) kept.push_back(walk.now);
  }
  Seen later;
  Future future;
  Floats spare;
  std::vector<std::pair<std::shared_ptr<const Sight>, Smoothed>> smoothed;  // backwards
  for (Size start = (count - 1) / stride * stride; start >= 0; start -= stride) {
    std::vector<Seen> stretch = {kept.back()};
    walk.now = kept.back();
    kept.pop_back();
    for (Size query = start + 1; query < std::min(start + stride, count); ++query) {
      walk.step(evidence, queries[query]);
      stretch.push_back(walk.now);
    }
    for (Size query = start + static_cast<Size>(stretch.size()) - 1; query >= start; --query) {
      const Seen now = stretch.back();
      stretch.pop_back();
      if (later.sight) {
        auto [here, beliefs] = filter.before(*now.belief, *now.likelihood, later.sight->rows, future, std::move(spare));
        spare = std::exchange(future, std::move(here)).mapped;
        smoothed.emplace_back(now.sight, std::move(beliefs));
      } else {
        future = filter.last(*now.belief, *now.likelihood);
        smoothed.push_back({now.sight, {now.belief->of_rows(), now.belief->unmapped}});
      }
      later = now;
      if (query % BLOCK) continue;
      over_blocks(static_cast<Size>(smoothed.size()), 1, threads, [&](Size at, Size) {
        const auto &[sight, beliefs] = smoothed[static_cast<std::size_t>(at)];
        place(filter, *sight, beliefs, query + static_cast<Size>(smoothed.size()) - 1 - at, places);
      });
      smoothed.clear();
    }
  }
}

// As torch.randperm with the seed 0.
std::vector<Size> at_random(Size count) {
  std::vector<Size> order = in_order(count);
  std::mt19937 random(0);
  for (Size place = 0; place + 1 < count; ++place)
    std::swap(order[place], order[place + static_cast<Size>(random()) % (count - place)]);
  return order;
}

// A course and its gain, 0 without one; what was seen by each of its streams, if that is kept.
struct BestCourse {
  Course course;
  double gain = 0;
  std::vector<std::vector<Seen>> past;
};

// A course that trails by `trailing` rests. It goes on at the end if the likeliest one gained less than `remainder`
// of what it had gained a query until then.
BestCourse best_course_of(const Evidence &evidence) {
  const std::vector<Course> tried = courses();
  Trial trial(evidence.map(), tried, KEPT, stride_of(evidence.queries()));
  std::vector<std::size_t> running(tried.size());
  std::iota(running.begin(), running.end(), 0);
  Size rested = 0;  // queries until the last one came to rest, and the gain there
  double gain = 0;
  for (Size query = 0; query < evidence.queries(); ++query) {
    for (const std::size_t course : running) trial.step(evidence, query, course);
    const double best = trial.gains()[likeliest(trial.gains())];
    const auto trails = [&](std::size_t course) { return trial.gains()[course] < best - MODEL.trailing; };
    const auto end = std::remove_if(running.begin(), running.end(), trails);
    if (end != running.end()) rested = query + 1, gain = best;
    running.erase(end, running.end());
  }
  const double since = trial.gains()[likeliest(trial.gains())] - gain;
  const auto others = static_cast<double>(evidence.queries() - rested);
  if (rested && since * static_cast<double>(rested) < MODEL.remainder * gain * others)
    for (std::size_t course = 0; course < tried.size(); ++course)
      while (trial.count(course) < evidence.queries()) trial.step(evidence, trial.count(course), course);
  const std::size_t best = likeliest(trial.gains());
  return {tried[best], trial.gains()[best], trial.past(best)};
}

// Whether the queries gain by a course as much in a random order.
bool gains_at_random(const Evidence &evidence, const Course &course, double gain) {
  Trial trial(evidence.map(), {course});
  for (const Size query : at_random(evidence.queries())) {
    trial.step(evidence, query);
    const double share = static_cast<double>(trial.count(0)) / static_cast<double>(evidence.queries());
    if (trial.count(0) >= MODEL.min_frames && trial.gains().front() < MODEL.remainder / 2 * gain * share) return false;
  }
  return trial.gains().front() > MODEL.remainder * gain;
}

// The likeliest course; none if there is hardly any gain, or as much in a random order.
BestCourse course_of(const Evidence &evidence) {
  if (evidence.queries() < 2) return {};
  BestCourse best = best_course_of(evidence);
  if (best.gain <= least_gain(evidence.queries()) || gains_at_random(evidence, best.course, best.gain)) return {};
  return best;
}

void assure(const std::vector<double> &chances, const std::vector<double> &mapped, double together,
            Decision &decision) {
  Confidence sure = Confidence::of(chances, mapped, together, decision.followed);
  decision.right = std::move(sure.right);
  decision.spread = std::move(sure.spread);
  decision.together.assign(chances.size(), static_cast<float>(together));
}

// The places of a course, and by how many deviations each is nearer to its query than all rows in the mean.
struct Followed : Places {
  std::vector<double> nearer;

  using Places::Places;
};

// The queries of each stream of a course, in an order.
std::vector<std::vector<Size>> streams_of(const Course &course, const std::vector<Size> &order) {
  std::vector<std::vector<Size>> streams(course.streams);
  for (std::size_t place = 0; place < order.size(); ++place)
    streams[place % streams.size()].push_back(order[place]);
  return streams;
}

// Places all streams of a course.
Followed follow_course(const Evidence &evidence, const Likeness &likeness, BestCourse &best, int threads, Size top) {
  const Course &course = best.course;
  const Filter filter(evidence.map(), Motion().at(course.rate), {course.way});
  Followed places(evidence.queries(), top);
  places.nearer.resize(places.chance.size());
  const std::vector<std::vector<Size>> streams = streams_of(course, in_order(evidence.queries()));
  for (std::size_t number = 0; number < streams.size(); ++number) {
    const std::vector<Size> &stream = streams[number];
    Places followed(static_cast<Size>(stream.size()), top);
    const bool as_tried = course.rate == 1;  // else a query counts otherwise
    follow_offline(filter, evidence, stream, threads, as_tried ? std::move(best.past[number]) : std::vector<Seen>{},
                   followed);
    std::vector<Size> rows(stream.size());
    for (std::size_t at = 0; at < rows.size(); ++at) rows[at] = followed.rows[at * top];
    const std::vector<bool> lingers = lingering(likeness, stream, rows, MODEL.around);
    const auto count = static_cast<Size>(stream.size());
    std::deque<std::shared_ptr<const Sight>> sights;  // of the queries from `first` on
    std::vector<Size> near;                           // their rows
    for (Size start = 0, first = 0, next = 0; start < count; start += BLOCK) {
      const Size end = std::min(count, start + BLOCK);
      for (; next < std::min(count, end + MODEL.around); ++next) sights.push_back(evidence.beside(stream[next]));
      for (; first < start - MODEL.around; ++first) sights.pop_front();
      near.assign(rows.begin() + first, rows.begin() + next);
      over_blocks(end - start, 1, threads, [&](Size offset, Size) {
        const Size at = start + offset, from = at * top, to = stream[at] * top;
        const auto [around, nearer] = chances_around(filter, sights, near, at - first, MODEL.around);
        std::copy_n(followed.scores.begin() + from, top, places.scores.begin() + to);
        std::copy_n(followed.rows.begin() + from, top, places.rows.begin() + to);
        places.near[stream[at]] = followed.near[at];
        places.chance[stream[at]] = lingers[at] ? 1 : std::max(followed.chance[at], around);
        places.nearer[stream[at]] = nearer;
      });
    }
  }
  return places;
}

// Each query by itself.
struct Judged {
  std::vector<double> chances;          // NaN without an answer
  std::vector<double> rivals_together;  // how many have the rival of each
  double together;                      // how many err together
  Likeness likeness;                    // of a drive that may be followed
};

// Makes a followed decision of one that was made alone, if that leaves its answers hardly less ahead. An empty
// query stays one.
void take(const Followed &places, const Judged &judged, Decision &decision) {
  const Size queries = static_cast<Size>(decision.right.size()), top = decision.top;
  std::vector<double> chances = places.chance, nearer = places.nearer;
  for (Size query = 0; query < queries; ++query)
    if (decision.rows[query * top] < 0)
      chances[query] = nearer[query] = std::numeric_limits<double>::quiet_NaN();
  if (!are_hardly_less_ahead(chances, judged.chances)) return;
  decision.followed = true;
  assure(chances, mapped_along(nearer, judged.rivals_together),
         std::max(static_cast<double>(MODEL.around), judged.together), decision);
  for (Size query = 0; query < queries; ++query) {
    const Size first = query * top;
    if (decision.rows[first] < 0) continue;
    std::copy_n(places.scores.begin() + first, top, decision.scores.begin() + first);
    std::copy_n(places.rows.begin() + first, top, decision.rows.begin() + first);
    if (places.rows[first] >= 0) decision.scores[first] = places.near[query];
  }
}

Judged judge(const Evidence &evidence, bool drive, int threads, Decision &decision) {
  const Size queries = evidence.queries();
  Judged judged;
  judged.chances.assign(static_cast<std::size_t>(queries), std::numeric_limits<double>::quiet_NaN());
  std::vector<Size> rivals(judged.chances.size());
  for (Size first = 0; first < queries; first += BLOCK) {
    const Size end = std::min(queries, first + BLOCK);
    std::vector<std::shared_ptr<const Sight>> sights;
    for (Size query = first; query < end; ++query) sights.push_back(evidence.alone(query));
    for (const std::shared_ptr<const Sight> &sight : sights)
      if (drive) judged.likeness.add(evidence.profile(*sight));
    over_blocks(end - first, 1, threads, [&](Size offset, Size) {
      const Sight &sight = *sights[static_cast<std::size_t>(offset)];
      const Size query = first + offset;
      put(sight.scores, sight.rows, query, decision);
      if (decision.rows[query * decision.top] < 0) return;
      const Chance chance = chance_of_scores(sight.scores.data(), sight.rows, sight.matching);
      judged.chances[query] = chance.chance;
      rivals[query] = chance.rival;
    });
  }
  judged.rivals_together = rivals_together(judged.chances, rivals);
  judged.together = answers_together(judged.rivals_together);
  return judged;
}

// Of answers that linger the chance is 1.
void doubt_lingering(const Decision &decision, Judged &judged) {
  for (const std::vector<Size> &stream :
       streams_of(decision.course, in_order(static_cast<Size>(judged.chances.size())))) {
    std::vector<Size> rows;
    for (const Size query : stream) rows.push_back(decision.rows[query * decision.top]);
    const std::vector<bool> lingers = lingering(judged.likeness, stream, rows, MODEL.around);
    for (std::size_t at = 0; at < stream.size(); ++at)
      if (lingers[at]) judged.chances[stream[at]] = 1;
  }
}
}  // namespace

// ------------------------------------------------------------------------------------------ decision

namespace {
std::size_t room(Size queries, Size top) {
  if (top > std::numeric_limits<Size>::max() / std::max<Size>(1, queries)) throw std::bad_alloc();
  return static_cast<std::size_t>(queries * top);
}
}  // namespace

Matches::Matches(Size queries, Size number)
    : top(number), scores(room(queries, top), NONE), rows(scores.size(), -1) {}

Places::Places(Size queries, Size number)
    : Matches(queries, number),
      near(static_cast<std::size_t>(queries)),
      unmapped(near),
      chance(near.size(), 1) {}

Decision decide(const Listing &listing, const Scores &scores, bool follow, int threads, Size top) {
  const bool fits = scores.queries() <= KEPT / std::max<Size>(1, listing.count());
  const Evidence evidence(listing, scores, follow && fits ? scores.queries() : 0);
  Decision decision(evidence.queries(), top);
  Judged judged = judge(evidence, follow, threads, decision);
  BestCourse best;
  if (follow) best = course_of(evidence);
  decision.course = best.course;
  decision.gain = best.gain;
  if (decision.gain > 0) doubt_lingering(decision, judged);
  assure(judged.chances, mapped(judged.chances, judged.together), judged.together, decision);
  if (decision.gain > 0) {
    decision.gain /= static_cast<double>(evidence.queries());
    take(follow_course(evidence, judged.likeness, best, threads, top), judged, decision);
  }
  decision.follows.assign(decision.right.size(), decision.followed);
  if (listing.map.rows < MODEL.min_frames) std::fill(decision.right.begin(), decision.right.end(), 0.0F);
  return decision;
}

}  // namespace places
