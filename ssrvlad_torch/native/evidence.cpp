// The parts of decisions of evidence.hpp.

#include "evidence.hpp"

#include "interface.hpp"

#include <numeric>

namespace places {

std::vector<Size> in_order(Size count) {
  std::vector<Size> order(count);
  std::iota(order.begin(), order.end(), 0);
  return order;
}

namespace {
constexpr Size BLOCK = 256;  // rows of which none is among the best if their highest is not

// Courses that are tried, both ways.
constexpr Course COURSES[] = {
    {FORWARDS, 1, 1}, {FORWARDS, MOST_RATE, 1}, {FORWARDS, 0.25, 1}, {FORWARDS, 1, MODEL.streams}};

// The places of the highest of values above NONE, the first of equals first.
std::vector<Size> best_of(const Floats &values, Size top) {
  std::vector<Size> best;
  const auto higher = [&](Size some, Size other) {
    return values[some] > values[other] || (values[some] == values[other] && some < other);
  };
  const auto take = [&](Size place) {
    if (static_cast<Size>(best.size()) == top) {
      if (!(values[place] > values[best.front()])) return;
      std::pop_heap(best.begin(), best.end(), higher);
      best.pop_back();
    }
    if (!(values[place] > NONE)) return;
    best.push_back(place);
    std::push_heap(best.begin(), best.end(), higher);
  };
  const auto count = static_cast<Size>(values.size());
  for (Size first = 0; first < count; first += BLOCK) {
    const Size last = std::min(count, first + BLOCK);
    const bool full = static_cast<Size>(best.size()) == top;
    if (full && !(highest(values.data() + first, last - first) > values[best.front()])) continue;
    for (Size place = first; place < last; ++place) take(place);
  }
  std::sort_heap(best.begin(), best.end(), higher);
  return best;
}

// The highest of values of the rows of a sight at the place of a row, NONE without one.
double highest_near(const Floats &values, const Sight &sight, const Drives &drives, Size row) {
  float most = NONE;
  for (const Run &run : sight.rows.runs) {
    if (run.drive != drives.of(row)) continue;
    const Size first = std::max(row - MODEL.near, run.first), last = std::min(row + MODEL.near + 1, run.last);
    for (Size other = first; other < last; ++other) most = std::max(most, values[run.at + other - run.first]);
  }
  return static_cast<double>(most);
}

// How a row compares with its rivals by values of the rows of a sight; 1 if a row elsewhere is better
// than all that are `near` it.
double chance_near(Floats values, const Sight &sight, const Drives &drives, Size row) {
  const Size count = sight.rows.count;
  scored(values.data(), values.data(), std::numeric_limits<float>::lowest(), sight.scores.data(), count);
  if (highest_near(values, sight, drives, row) < static_cast<double>(highest(values.data(), count))) return 1;
  return chance_of(values.data(), sight.rows, sight.matching).chance;
}

}  // namespace

Evidence::Evidence(const Listing &listing, const Scores &scores, Size kept)
    : listing_(listing), scores_(scores), known_(static_cast<std::size_t>(std::max<Size>(1, kept))) {
  std::vector<Size> sample;  // of rows that represent all
  for (Size place = 0; place < listing.count(); ++place)
    if (listing.weights.empty() || listing.weights[place] > 1) sample.push_back(place);
  if (sample.empty()) sample = in_order(listing.count());
  const std::size_t most = MODEL.compared, step = std::max<std::size_t>(1, (sample.size() + most - 1) / most);
  for (std::size_t at = 0; at < sample.size(); at += step) compared_.push_back(sample[at]);
}

Sight Evidence::sight_of(Size query) const {
  const Size count = listing_.count();
  Sight sight{listing_.rows, Floats(static_cast<std::size_t>(count)), NONE, -1, {}, {}, {}};
  scores_.of(query, sight.scores.data());
  sight.highest = highest(sight.scores.data(), count);
  if (std::isnan(sum(sight.scores.data(), count)) || sight.highest > HIGHEST_SCORE)
    refuse("expected scores of at most 1.001, got a higher one or NaN");
  double matching = 0;
  for (std::size_t place = 0; place < listing_.weights.size(); ++place)
    if (sight.scores[place] != NONE) matching += listing_.weights[place];
  if (!listing_.weights.empty()) sight.matching = std::llround(matching);
  return sight;
}

Evidence::Known &Evidence::known(Size query) const {
  Known &here = known_[static_cast<std::size_t>(query) % known_.size()];
  if (query == here.query) return here;
  here.query = -1;
  here.likelihoods.clear();
  here.sight = std::make_shared<Sight>(sight_of(query));
  here.query = query;
  return here;
}

Evidence::Known &Evidence::near(Size query) const {
  Known &here = known(query);
  Sight &sight = *here.sight;
  if (sight.near.empty()) {
    sight.near.resize(sight.scores.size());
    nearness(sight.scores.data(), listing_.count(), sight.near.data());
    sight.spread = listing_.spread(sight.near.data());
  }
  return here;
}

std::shared_ptr<const Sight> Evidence::beside(Size query) const {
  const std::shared_ptr<Sight> sight = near(query).sight;
  if (sight->z.empty()) {
    sight->z.resize(sight->scores.size());
    if (sight->spread.deviation <= MIN_SPREAD)  // equal scores say nothing
      std::fill(sight->z.begin(), sight->z.end(), 0.0F);
    else
      deviations(sight->near.data(), listing_.count(), sight->spread, sight->z.data());
  }
  return sight;
}

std::shared_ptr<const Likelihood> Evidence::likelihood(const Motion &motion, Size query) const {
  Known &here = near(query);
  for (const auto &[weight, level, likelihood] : here.likelihoods)
    if (motion.weight == weight && motion.level == level) return likelihood;
  const Sight &sight = *here.sight;
  const auto likelihood = std::make_shared<Likelihood>();
  Floats &rows = likelihood->rows;
  rows.resize(sight.near.size());
  if (sight.spread.deviation <= MIN_SPREAD)
    std::fill(rows.begin(), rows.end(), 1.0F);
  else
    likelihoods(sight.near.data(), listing_.count(), motion.weight, motion.level, sight.spread, rows.data());
  // The rows that are not listed are like those of the sample, which stand for them.
  const Size others = listing_.map.rows - listing_.count();
  double elsewhere = 0;
  for (std::size_t place = 0; place < listing_.weights.size(); ++place)
    elsewhere += (listing_.weights[place] - 1) * static_cast<double>(rows[place]);
  if (others > 0) likelihood->elsewhere = elsewhere / static_cast<double>(others);
  here.likelihoods.emplace_back(motion.weight, motion.level, likelihood);
  return likelihood;
}

std::vector<float> Evidence::profile(const Sight &sight) const {
  std::vector<float> scores;
  for (const Size place : compared_) scores.push_back(sight.scores[place]);
  return scores;
}

void put(const Floats &values, const Rows &rows, Size query, Matches &matches) {
  Size at = query * matches.top;
  for (const Size place : best_of(values, matches.top)) {
    matches.scores[at] = values[place];
    matches.rows[at++] = rows.at(place);
  }
}

// Of one query by the beliefs in its listed rows. Rows without a score are no candidates, unless none has
// one: any row may be the place of an empty query.
void place(const Filter &filter, const Sight &sight, const Smoothed &smoothed, Size query, Places &places) {
  const auto &[beliefs, unmapped] = smoothed;
  Floats candidates = beliefs;
  if (sight.highest > NONE)
    scored(candidates.data(), beliefs.data(), 0, sight.scores.data(), sight.rows.count);
  put(candidates, sight.rows, query, places);
  places.unmapped[query] = static_cast<float>(unmapped);
  const Size row = places.rows[query * places.top];
  if (row >= 0) {
    const Drives &drives = filter.drives();
    const Size drive = drives.of(row);
    const Size first = std::max(row - MODEL.near, drives.starts[drive]);
    const Size last = std::min(row + MODEL.near + 1, drives.last(drive));
    for (const Run &run : sight.rows.runs)
      for (Size each = std::max(first, run.first); each < std::min(last, run.last); ++each)
        places.near[query] += beliefs[run.at + each - run.first];
  }
  places.chance[query] =
      chance_of_beliefs(beliefs.data(), sight.scores.data(), sight.rows, sight.matching).chance;
}

std::pair<double, double> chances_around(const Filter &filter, const std::deque<std::shared_ptr<const Sight>> &sights,
                                         const std::vector<Size> &rows, Size at, Size later) {
  if (rows[at] < 0) return {1, std::numeric_limits<double>::quiet_NaN()};
  const Drives &drives = filter.drives();
  const auto [least, most] = filter.reach();
  const Size longest = std::max(-least, most);
  const Sight &here = *sights[at];
  Floats total = here.z;
  const auto take = [&](Size other) {
    const Sight &sight = *sights[other];
    const Size moved = rows[other] - rows[at];
    for (const Run &run : here.rows.runs)
      visit(
          run.first + moved, run.last + moved, run.drive, sight.rows, drives,
          [&](Size row, Size place, Size number) {
            add(total.data() + run.at + row - moved - run.first, sight.z.data() + place, 1, number);
          },
          [](Size, Size) {}, [](Size, Size) {});
  };
  const Size first = std::max<Size>(0, at - MODEL.around), last = std::min(static_cast<Size>(sights.size()) - 1, at + later);
  for (const Size way : {Size{-1}, Size{1}})
    for (Size other = at + way; other >= first && other <= last; other += way) {
      if (rows[other] < 0 || std::abs(rows[other] - rows[other - way]) > longest) break;
      take(other);
    }
  return {chance_near(total, here, drives, rows[at]), highest_near(here.z, here, drives, rows[at])};
}

std::vector<Course> courses() {
  std::vector<Course> courses;
  for (const Course &kind : COURSES)
    for (const int way : {FORWARDS, BACKWARDS}) courses.push_back({way, kind.rate, kind.streams});
  return courses;
}

double least_gain(Size queries) { return MODEL.least_rate * static_cast<double>(std::max(queries, MODEL.around)); }

std::size_t likeliest(const std::vector<double> &gains) {
  const auto likely = [&](std::size_t course) { return gains[course] - (course ? MODEL.unusual : 0); };
  std::size_t best = 0;
  for (std::size_t course = 1; course < gains.size(); ++course)
    if (likely(course) > likely(best)) best = course;
  return best;
}

}  // namespace places
