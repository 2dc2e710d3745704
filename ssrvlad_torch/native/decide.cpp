// The decision of decide.hpp.

#include "decide.hpp"

#include <deque>
#include <memory>
#include <numeric>
#include <random>

namespace places {

std::vector<Size> in_order(Size count) {
  std::vector<Size> order(count);
  std::iota(order.begin(), order.end(), 0);
  return order;
}

namespace {
constexpr Size AROUND = Likeness::AROUND;
constexpr double BEST = 1.0 / 3;  // how often a wrong answer of a followed drive is the best of its query
constexpr Size KEPT = Size{1} << 24;  // numbers of beliefs that are kept rather than computed again

// Courses that are tried, both ways.
constexpr Course COURSES[] = {
    {FORWARDS, 1, 1}, {FORWARDS, 3, 1}, {FORWARDS, 0.25, 1}, {FORWARDS, 1, Likeness::STREAMS}};
// What counts of the gain of two streams: a slow one is hardly less likely as two in turn.
constexpr double OF_TWO = 0.75;
// The gain of a course, and how much more another than forwards at the rate of the map must have: before
// anything is known, one drive in twenty takes it. Gains a query: real drives and two streams in turn 0.3 to
// 1.0, three to six streams 0.03 to 0.35, drives in foreign maps 0.05 to 0.4, random frames 0.0 to 0.1.
constexpr double LEAST_GAIN = 1, UNUSUAL = 3;
// How much of its gain a drive may have in a random order: a row like every query gains all of it.
constexpr double BY_ROWS = 0.5;
// The gain a query that only drives have, and a difference of mean confidences.
constexpr double DRIVE = 0.5, MARGIN = 0.05;

// ------------------------------------------------------------------------------------------ evidence

// What is known of one query: its scores at the listed rows, and how many rows of the map could match, less
// than 0 for those that have a score.
struct Sight {
  const Rows &rows;
  std::vector<float> scores;
  Size matching;
  Likelihood likelihood;  // if the query is followed
  std::vector<float> z;   // beside others: by how many deviations each row is nearer than the mean of all
};

// The queries of one drive, and how they fit a map. Not to be shared by threads.
class Evidence {
 public:
  Evidence(const Listing &listing, const Scores &scores) : listing_(listing), scores_(scores) {
    std::vector<Size> sample;  // of rows that represent all
    for (Size place = 0; place < listing.count(); ++place)
      if (listing.weights.empty() || listing.weights[place] > 1) sample.push_back(place);
    if (sample.empty()) sample = in_order(listing.count());
    const std::size_t most = Likeness::COMPARED, step = std::max<std::size_t>(1, (sample.size() + most - 1) / most);
    for (std::size_t at = 0; at < sample.size(); at += step) compared_.push_back(sample[at]);
  }

  Size queries() const { return scores_.queries(); }
  const Drives &map() const { return listing_.map; }

  // A query by itself.
  Sight alone(Size query) const {
    Sight sight{listing_.rows, std::vector<float>(static_cast<std::size_t>(listing_.count())), -1, {}, {}};
    scores_.of(query, sight.scores.data());
    const Size count = listing_.count();
    if (std::isnan(sum(sight.scores.data(), count)) || highest(sight.scores.data(), count) > HIGHEST_SCORE)
      throw WrongScores();
    double matching = 0;
    for (std::size_t place = 0; place < listing_.weights.size(); ++place)
      if (sight.scores[place] != NONE) matching += listing_.weights[place];
    if (!listing_.weights.empty()) sight.matching = std::llround(matching);
    return sight;
  }

  // A query with others; 0 deviations where there is no score.
  std::shared_ptr<const Sight> beside(Size query) const {
    const auto sight = std::make_shared<Sight>(alone(query));
    const Spread spread = spread_of(*sight);
    sight->z.resize(sight->scores.size());
    if (spread.deviation <= MIN_SPREAD) return sight;  // equal scores say nothing
    for (std::size_t place = 0; place < sight->z.size(); ++place) {
      const double near = nearness(static_cast<double>(sight->scores[place]));
      if (sight->scores[place] != NONE)
        sight->z[place] = static_cast<float>((near - spread.mean) / spread.deviation);
    }
    return sight;
  }

  // A query that is followed.
  std::shared_ptr<const Sight> followed(const Motion &motion, Size query) const {
    if (last_ && query == query_ && motion.weight == weight_ && motion.level == level_) return last_;
    const auto sight = std::make_shared<Sight>(alone(query));
    std::vector<float> &rows = sight->likelihood.rows;
    rows = likelihoods(sight->scores.data(), listing_.count(), motion, spread_of(*sight));
    // The rows that are not listed are like those of the sample, which stand for them.
    const Size others = listing_.map.rows - listing_.count();
    double elsewhere = 0;
    for (std::size_t place = 0; place < listing_.weights.size(); ++place)
      elsewhere += (listing_.weights[place] - 1) * static_cast<double>(rows[place]);
    if (others > 0) sight->likelihood.elsewhere = elsewhere / static_cast<double>(others);
    query_ = query, weight_ = motion.weight, level_ = motion.level;
    return last_ = sight;
  }

  // The scores of a query at rows that represent all, the same for each query.
  std::vector<float> profile(const Sight &sight) const {
    std::vector<float> scores;
    for (const Size place : compared_) scores.push_back(sight.scores[place]);
    return scores;
  }

 private:
  Spread spread_of(const Sight &sight) const {
    std::vector<float> near(sight.scores.size());
    nearness(sight.scores.data(), listing_.count(), near.data());
    return listing_.spread(near.data());
  }

  const Listing &listing_;
  const Scores &scores_;
  std::vector<Size> compared_;
  mutable std::shared_ptr<const Sight> last_;  // of the query, weight and level
  mutable Size query_ = -1;
  mutable double weight_ = 0, level_ = 0;
};

// ------------------------------------------------------------------------------------------ following

// The places of the highest of values above NONE, the first of equals first.
std::vector<Size> best_of(const std::vector<float> &values, Size top) {
  std::vector<Size> best;
  const auto higher = [&](Size some, Size other) {
    return values[some] > values[other] || (values[some] == values[other] && some < other);
  };
  for (Size place = 0; place < static_cast<Size>(values.size()); ++place) {
    if (static_cast<Size>(best.size()) == top) {
      if (!(values[place] > values[best.front()])) continue;
      std::pop_heap(best.begin(), best.end(), higher);
      best.pop_back();
    }
    if (!(values[place] > NONE)) continue;
    best.push_back(place);
    std::push_heap(best.begin(), best.end(), higher);
  }
  std::sort_heap(best.begin(), best.end(), higher);
  return best;
}

void put(const std::vector<float> &values, const Rows &rows, Size query, Matches &matches) {
  Size at = query * matches.top;
  for (const Size place : best_of(values, matches.top)) {
    matches.scores[at] = values[place];
    matches.rows[at++] = rows.at(place);
  }
}

// A query, and the belief after it.
struct Seen {
  std::shared_ptr<const Sight> sight;
  std::shared_ptr<const Belief> belief;
};

// The forward algorithm.
struct Walk {
  const Filter &filter;
  Seen now;

  // Takes the next query: the logarithm of how much likelier it is so than alone.
  double step(const Evidence &evidence, Size query) {
    const Belief *before = now.belief.get();
    now.sight = evidence.followed(filter.motion(), query);
    const Rows &rows = now.sight->rows;
    const auto belief =
        std::make_shared<Belief>(before ? filter.predicted(*before, rows) : filter.start(rows));
    const double gain = filter.update(*belief, now.sight->likelihood);
    now.belief = belief;
    return gain;
  }
};

// Of one query by the beliefs in its listed rows. Rows without a score are no candidates, unless none has
// one: any row may be the place of an empty query.
void place(const Filter &filter, const Sight &sight,
           const std::pair<std::vector<float>, double> &found, Size query, Places &places) {
  const auto &[beliefs, unmapped] = found;
  std::vector<float> masked = beliefs;
  if (highest(sight.scores.data(), sight.rows.count) > NONE)
    for (Size row = 0; row < sight.rows.count; ++row)
      if (sight.scores[row] == NONE) masked[row] = NONE;
  put(masked, sight.rows, query, places);
  places.unmapped[query] = static_cast<float>(unmapped);
  const Size row = places.rows[query * places.top];
  if (row >= 0) {
    const Drives &drives = filter.drives();
    const Size drive = drives.of(row);
    const Size first = std::max(row - NEAR, drives.starts[drive]);
    const Size last = std::min(row + NEAR + 1, drives.last(drive));
    for (const Run &run : sight.rows.runs)
      for (Size each = std::max(first, run.first); each < std::min(last, run.last); ++each)
        places.near[query] += beliefs[run.at + each - run.first];
  }
  places.chance[query] =
      chance_of_beliefs(beliefs.data(), sight.scores.data(), sight.rows, sight.matching).chance;
}

void follow_online(const Filter &filter, const Evidence &evidence, const std::vector<Size> &queries,
                   Size delay, Places &places) {
  const auto count = static_cast<Size>(queries.size());
  std::deque<Seen> window;  // a query and those after it
  Walk walk{filter, {}};
  for (Size query = 0, next = 0; query < count; ++query) {
    for (; next < count && next - query <= delay; ++next) {
      walk.step(evidence, queries[next]);
      window.push_back(walk.now);
    }
    const Seen &now = window.front();
    if (window.size() == 1) {
      place(filter, *now.sight, {now.belief->of_rows(), now.belief->unmapped}, query, places);
    } else {
      Future future = filter.none(*window.back().belief);
      for (std::size_t later = window.size() - 1; later > 0; --later)
        future = filter.before(*window[later - 1].belief, window[later].sight->rows,
                               window[later].sight->likelihood, future);
      place(filter, *now.sight, filter.smoothed(*now.belief, future), query, places);
    }
    window.pop_front();
  }
}

// Keeps one belief in `stride`; the others are computed again.
void follow_offline(const Filter &filter, const Evidence &evidence,
                    const std::vector<Size> &queries, Places &places) {
  const auto count = static_cast<Size>(queries.size());
  Walk walk{filter, {}};
  std::vector<Seen> kept;
  Size stride = 1;
  for (Size query = 0; query < count; ++query) {
    walk.step(evidence, queries[query]);
    if (!query && count * static_cast<Size>(walk.now.belief->mapped.size()) > KEPT)
      stride = static_cast<Size>(std::sqrt(static_cast<double>(count)));
    if (query % stride == 0) kept.push_back(walk.now);
  }
  Seen later;
  Future future;
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
      future = later.sight
                   ? filter.before(*now.belief, later.sight->rows, later.sight->likelihood, future)
                   : filter.none(*now.belief);
      place(filter, *now.sight, filter.smoothed(*now.belief, future), query, places);
      later = now;
    }
  }
}

// The queries of each stream of a course, in an order.
std::vector<std::vector<Size>> streams_of(const Course &course, const std::vector<Size> &order) {
  std::vector<std::vector<Size>> streams(course.streams);
  for (std::size_t place = 0; place < order.size(); ++place)
    streams[place % streams.size()].push_back(order[place]);
  return streams;
}

// As torch.randperm with the seed 0.
std::vector<Size> at_random(Size count) {
  std::vector<Size> order = in_order(count);
  std::mt19937 random(0);
  for (Size place = 0; place + 1 < count; ++place)
    std::swap(order[place], order[place + static_cast<Size>(random()) % (count - place)]);
  return order;
}

// Courses that are tried at once, so that each query is scored once.
class Trial {
 public:
  Trial(const Drives &drives, const std::vector<Course> &courses) {
    for (const Course &course : courses) {
      Motion motion;
      motion.unmapped = 0;
      motion.rate = course.rate;
      filters_.push_back(std::make_unique<Filter>(drives, motion, std::vector<int>{course.way}));
      walks_.emplace_back(course.streams, Walk{*filters_.back(), {}});
    }
  }

  // The gain of queries by each course; what counts of it.
  std::vector<double> gains(const Evidence &evidence, const std::vector<Size> &order) {
    std::vector<double> gains(walks_.size());
    for (std::size_t place = 0; place < order.size(); ++place)
      for (std::size_t each = 0; each < walks_.size(); ++each)
        gains[each] += walks_[each][place % walks_[each].size()].step(evidence, order[place]);
    for (std::size_t each = 0; each < gains.size(); ++each)
      if (walks_[each].size() > 1) gains[each] *= OF_TWO;
    return gains;
  }

 private:
  std::vector<std::unique_ptr<Filter>> filters_;
  std::vector<std::vector<Walk>> walks_;
};

// The likeliest course and its gain; no gain if there is hardly any, or as much in a random order.
std::pair<Course, double> course_of(const Evidence &evidence) {
  if (evidence.queries() < 2) return {};
  std::vector<Course> courses;
  for (const Course &kind : COURSES)
    for (const int way : {FORWARDS, BACKWARDS}) courses.push_back({way, kind.rate, kind.streams});
  const std::vector<double> gains =
      Trial(evidence.map(), courses).gains(evidence, in_order(evidence.queries()));
  std::size_t best = 0;
  const auto likely = [&](std::size_t course) { return gains[course] - (course ? UNUSUAL : 0); };
  for (std::size_t course = 1; course < courses.size(); ++course)
    if (likely(course) > likely(best)) best = course;
  if (gains[best] <= LEAST_GAIN) return {};
  Trial again(evidence.map(), {courses[best]});
  if (again.gains(evidence, at_random(evidence.queries())).front() > BY_ROWS * gains[best])
    return {};
  return {courses[best], gains[best]};
}

void assure(const std::vector<double> &chances, const std::vector<double> &mapped, double together,
            Decision &decision) {
  Confidence sure = Confidence::of(chances, mapped, together, decision.followed);
  decision.right = std::move(sure.right);
  decision.spread = std::move(sure.spread);
  decision.together.assign(chances.size(), static_cast<float>(together));
}

double mean(const std::vector<float> &values) {
  return sum(values.data(), static_cast<Size>(values.size())) /
         static_cast<double>(std::max<std::size_t>(1, values.size()));
}

// The places of a course, and the chance of each by its query alone.
struct Followed : Places {
  std::vector<double> alone;

  using Places::Places;
};

// How a row compares with its rivals by values of the rows of a sight; 1 if a row elsewhere is better
// than all that are NEAR it.
double chance_near(const std::vector<float> &values, const Sight &sight, const Drives &drives,
                   Size row) {
  std::vector<double> known(values.begin(), values.end());
  double near = static_cast<double>(NONE), best = near;
  for (const Run &run : sight.rows.runs)
    for (Size each = run.first; each < run.last; ++each) {
      double &value = known[run.at + each - run.first];
      if (sight.scores[run.at + each - run.first] == NONE) value = static_cast<double>(NONE);
      best = std::max(best, value);
      if (std::abs(each - row) <= NEAR && run.drive == drives.of(row)) near = std::max(near, value);
    }
  return near < best ? 1 : chance_of(known.data(), sight.rows, sight.matching).chance;
}

// How the answers of a stream, their rows, compare with their rivals by the frames around each: AROUND
// earlier ones and so many later, as far as no step is longer than the drive can make. The value of a row
// is the sum of the deviations of these frames along the same path, moved to it. And by each frame alone.
std::pair<std::vector<double>, std::vector<double>> chances_around(
    const Filter &filter, const Evidence &evidence, const std::vector<Size> &queries,
    const std::vector<Size> &rows, Size later) {
  const Drives &drives = filter.drives();
  const auto [least, most] = filter.reach();
  const Size count = static_cast<Size>(queries.size()), longest = std::max(-least, most);
  std::deque<std::shared_ptr<const Sight>> window;  // of the queries from `first` on
  std::vector<double> chances(queries.size(), 1), alone(chances);
  for (Size query = 0, first = 0, next = 0; query < count; ++query) {
    for (; next < std::min(count, query + later + 1); ++next)
      window.push_back(evidence.beside(queries[next]));
    for (; first < query - AROUND; ++first) window.pop_front();
    if (rows[query] < 0) continue;
    const Sight &here = *window[query - first];
    alone[query] = chance_near(here.z, here, drives, rows[query]);
    std::vector<float> total = here.z;
    const auto take = [&](Size other) {
      const Sight &sight = *window[other - first];
      const Size moved = rows[other] - rows[query];
      for (const Run &run : here.rows.runs)
        visit(
            run.first + moved, run.last + moved, run.drive, sight.rows, drives,
            [&](Size row, Size place, Size number) {
              add(total.data() + run.at + row - moved - run.first, sight.z.data() + place, 1, number);
            },
            [](Size, Size) {}, [](Size, Size) {});
    };
    for (const Size way : {Size{-1}, Size{1}})
      for (Size other = query + way; other >= first && other < next; other += way) {
        if (rows[other] < 0 || std::abs(rows[other] - rows[other - way]) > longest) break;
        take(other);
      }
    chances[query] = chance_near(total, here, drives, rows[query]);
  }
  return {std::move(chances), std::move(alone)};
}

// How many later queries count beside an answer.
Size later_of(Mode mode, Size delay) {
  return mode == Mode::ONLINE ? std::min(AROUND, delay) : AROUND;
}

// Follows some queries as one stream in a way that the motion of the filter has.
Places follow(const Filter &filter, const Evidence &evidence, const std::vector<Size> &queries,
              Mode mode, Size delay, Size top) {
  Places places(static_cast<Size>(queries.size()), top);
  if (mode == Mode::ONLINE)
    follow_online(filter, evidence, queries, delay, places);
  else
    follow_offline(filter, evidence, queries, places);
  return places;
}

// Places all streams of a course.
Followed follow_course(const Evidence &evidence, const Likeness &likeness, const Course &course, Mode mode, Size delay, Size top) {
  const Filter filter(evidence.map(), Motion().at(course.rate), {course.way});
  const Size later = later_of(mode, delay);
  Followed places(evidence.queries(), top);
  places.alone.resize(places.chance.size());
  for (const std::vector<Size> &stream : streams_of(course, in_order(evidence.queries()))) {
    const Places some = follow(filter, evidence, stream, mode, delay, top);
    std::vector<Size> rows(stream.size());
    for (std::size_t at = 0; at < rows.size(); ++at) rows[at] = some.rows[at * top];
    const auto [around, alone] = chances_around(filter, evidence, stream, rows, later);
    const std::vector<bool> lingers = lingering(likeness, stream, rows, later);
    for (std::size_t at = 0; at < stream.size(); ++at) {
      const auto from = static_cast<std::ptrdiff_t>(at) * top, to = stream[at] * top;
      std::copy_n(some.scores.begin() + from, top, places.scores.begin() + to);
      std::copy_n(some.rows.begin() + from, top, places.rows.begin() + to);
      places.near[stream[at]] = some.near[at];
      places.chance[stream[at]] = lingers[at] ? 1 : std::max(some.chance[at], around[at]);
      places.alone[stream[at]] = lingers[at] ? 1 : alone[at];
    }
  }
  return places;
}

// Makes a followed decision of one that was made alone, if that makes its answers surer. An empty query
// stays one.
void take(const Followed &places, double together, Decision &decision) {
  const Size queries = static_cast<Size>(decision.right.size()), top = decision.top;
  std::vector<double> chances = places.chance, alone = places.alone;
  for (Size query = 0; query < queries; ++query)
    if (decision.rows[query * top] < 0)
      chances[query] = alone[query] = std::numeric_limits<double>::quiet_NaN();
  const std::vector<double> mapped = places::mapped(alone, together, BEST);
  const double followed = mean(Confidence::of(chances, mapped, together, false).right);
  if (followed <= mean(decision.right) + (decision.gain > DRIVE ? -MARGIN : MARGIN)) return;
  decision.followed = true;
  assure(chances, mapped, std::max(static_cast<double>(AROUND), together), decision);
  for (Size query = 0; query < queries; ++query) {
    const Size first = query * top;
    if (decision.rows[first] < 0) continue;
    std::copy_n(places.scores.begin() + first, top, decision.scores.begin() + first);
    std::copy_n(places.rows.begin() + first, top, decision.rows.begin() + first);
    if (places.rows[first] >= 0) decision.scores[first] = places.near[query];
  }
}

// Each query by itself.
struct Judged {
  std::vector<double> chances;  // NaN without an answer
  double together;              // how many err together
  Likeness likeness;            // of a drive that may be followed
};

Judged judge(const Evidence &evidence, bool drive, Decision &decision) {
  const Size queries = evidence.queries();
  Judged judged;
  judged.chances.assign(static_cast<std::size_t>(queries), std::numeric_limits<double>::quiet_NaN());
  std::vector<Size> rivals;
  for (Size query = 0; query < queries; ++query) {
    const Sight sight = evidence.alone(query);
    if (drive) judged.likeness.add(evidence.profile(sight));
    put(sight.scores, sight.rows, query, decision);
    if (decision.rows[query * decision.top] < 0) continue;
    const Chance chance = chance_of_scores(sight.scores.data(), sight.rows, sight.matching);
    judged.chances[query] = chance.chance;
    rivals.push_back(chance.rival);
  }
  judged.together = answers_together(rivals);
  return judged;
}

// Of answers that linger the chance is 1.
void doubt_lingering(const Decision &decision, Size later, Judged &judged) {
  for (const std::vector<Size> &stream :
       streams_of(decision.course, in_order(static_cast<Size>(judged.chances.size())))) {
    std::vector<Size> rows;
    for (const Size query : stream) rows.push_back(decision.rows[query * decision.top]);
    const std::vector<bool> lingers = lingering(judged.likeness, stream, rows, later);
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

Decision decide(const Listing &listing, const Scores &scores, Mode mode, Size delay, Size top) {
  const Evidence evidence(listing, scores);
  Decision decision(evidence.queries(), top);
  Judged judged = judge(evidence, mode != Mode::ALONE, decision);
  if (mode != Mode::ALONE) std::tie(decision.course, decision.gain) = course_of(evidence);
  if (decision.gain > 0) doubt_lingering(decision, later_of(mode, delay), judged);
  const double together = judged.together;
  assure(judged.chances, mapped(judged.chances, together, 1), together, decision);
  if (decision.gain > 0) {
    decision.gain /= static_cast<double>(evidence.queries());
    const Course course = decision.course;
    take(follow_course(evidence, judged.likeness, course, mode, delay, top), together, decision);
  }
  if (listing.map.rows < MIN_FRAMES) std::fill(decision.right.begin(), decision.right.end(), 0.0F);
  return decision;
}

}  // namespace places
