// The hidden Markov model of filter.hpp.

#include "filter.hpp"

namespace places {

namespace {
constexpr Size BLOCK = 1024;  // rows that are moved at once: they fit into the nearest cache
constexpr double HIGH = 1e6;  // a future is scaled beyond it
constexpr double LEAST_TOTAL = std::numeric_limits<float>::min();  // a sum of probabilities below it is 0

// Probability of each step at each speed: 0, 1/2, 1, 3/2, 2, 3 and 4 rows a frame.
const std::array<std::vector<std::pair<Size, double>>, SPEEDS> STEPS = {{
    {{-1, 0.05}, {0, 0.9}, {1, 0.05}},
    {{0, 0.5}, {1, 0.5}},
    {{0, 0.1}, {1, 0.8}, {2, 0.1}},
    {{1, 0.5}, {2, 0.5}},
    {{1, 0.1}, {2, 0.8}, {3, 0.1}},
    {{2, 0.1}, {3, 0.8}, {4, 0.1}},
    {{3, 0.15}, {4, 0.7}, {5, 0.15}},
}};

// Calls a function with the rows of a list in pieces of neighbours.
template <typename Function>
void in_pieces(const Rows &rows, Function function) {
  for (const Run &run : rows.runs)
    for (Size first = run.first; first < run.last; first += BLOCK)
      function(
          Run{first, std::min(run.last, first + BLOCK), run.at + first - run.first, run.drive});
}

// Calls a function with the place and the number of rows of one list that are not in another.
template <typename Function>
void visit_others(const Rows &rows, const Rows &listed, const Drives &drives, Function function) {
  for (const Run &run : rows.runs)
    visit(
        run.first, run.last, run.drive, listed, drives, [](Size, Size, Size) {},
        [&](Size row, Size count) { function(run.at + row - run.first, count); },
        [](Size, Size) {});
}

// Adds to a target the sums of following values, each times its weight.
template <Size WIDTH>
void slide_by(float *target, const float *values, Size count, const float *weights) {
  on_cpu([=](auto) {
    for (Size i = 0; i < count; ++i) {
      float total = 0;
      for (Size k = 0; k < WIDTH; ++k) total += weights[k] * values[i + k];
      target[i] += total;
    }
  });
}

// The same of any number of weights: a loop of a number that the compiler knows is ten times as fast.
void slide(float *target, const float *values, Size count, const float *weights, Size width) {
  constexpr decltype(&slide_by<1>) BY[] = {slide_by<1>, slide_by<2>, slide_by<3>, slide_by<4>,
                                           slide_by<5>, slide_by<6>, slide_by<7>};
  constexpr Size MOST = std::size(BY);
  for (; width > 0; width -= MOST, values += MOST, weights += MOST)
    BY[std::min(width, MOST) - 1](target, values, count, weights);
}

// Of values and what they have in common, each times a factor.
void mixed(float *target, const float *values, float factor, const float *common, float part, Size count) {
  on_cpu([=](auto) { for (Size i = 0; i < count; ++i) target[i] = factor * values[i] + part * common[i]; });
}
}  // namespace

// -------------------------------------------------------------------------------------------- motion

Motion Motion::at(double other) const {
  Motion motion = *this;
  motion.rate = other;
  motion.change = std::min(1.0, change * other);
  motion.jump = std::min(1.0, jump * other);
  motion.weight = weight * other;
  return motion;
}

Steps::Steps(double rate) {
  const double whole = std::floor(rate);
  for (int speed = 0; speed < SPEEDS; ++speed) {
    Size first = 0;
    std::vector<double> chances = {1};
    for (double done = 0; done < rate; ++done) {
      const double likely = done < whole ? 1.0 : rate - whole;
      const Size least = std::min<Size>(0, STEPS[speed].front().first);
      std::vector<double> after(chances.size() +
                                static_cast<std::size_t>(STEPS[speed].back().first - least));
      for (std::size_t place = 0; place < chances.size(); ++place) {
        after[place + static_cast<std::size_t>(-least)] += (1 - likely) * chances[place];
        for (const auto &[step, part] : STEPS[speed])
          after[place + static_cast<std::size_t>(step - least)] += chances[place] * part * likely;
      }
      first += least;
      chances = after;
    }
    while (chances.front() == 0) chances.erase(chances.begin()), ++first;
    of[speed] = {first, {chances.begin(), chances.end()}, {chances.rbegin(), chances.rend()}};
  }
}

void likelihoods(const float *near, Size count, double weight, double level, const Spread &spread, float *likely) {
  const double least = spread.mean + level * spread.deviation, factor = weight / spread.deviation;
  on_cpu([=, limits = Limits()](auto) {
    for (Size i = 0; i < count; ++i) {
      const double emission = (static_cast<double>(near[i]) - least) * factor;
      const double capped = emission < limits.most ? emission : limits.most;
      likely[i] = static_cast<float>(exp_of(near[i] == NONE ? limits.none : capped));
    }
  });
}

// ---------------------------------------------------------------------------------------------- rows

Size Drives::last(Size drive) const {
  return drive + 1 < static_cast<Size>(starts.size()) ? starts[drive + 1] : rows;
}

Size Drives::of(Size row) const {
  return std::upper_bound(starts.begin(), starts.end(), row) - starts.begin() - 1;
}

Rows Drives::all() const {
  Rows all;
  for (Size drive = 0; drive < static_cast<Size>(starts.size()); ++drive)
    all.runs.push_back({starts[drive], last(drive), starts[drive], drive});
  all.count = rows;
  return all;
}

Rows Drives::some(const Size *listed, Size count) const {
  Rows list;
  list.count = count;
  for (Size i = 0; i < count; ++i) {
    const Size drive = of(listed[i]);
    if (!list.runs.empty() && list.runs.back().last == listed[i] && list.runs.back().drive == drive)
      ++list.runs.back().last;
    else
      list.runs.push_back({listed[i], listed[i] + 1, i, drive});
  }
  return list;
}

Size Rows::at(Size place) const {
  const auto next = std::upper_bound(runs.begin(), runs.end(), place,
                                     [](Size value, const Run &run) { return value < run.at; });
  return std::prev(next)->first + place - std::prev(next)->at;
}

Size Rows::from(Size row) const {
  const auto run = std::upper_bound(runs.begin(), runs.end(), row,
                                    [](Size value, const Run &run) { return value < run.last; });
  return run == runs.end() ? count : run->at + std::max<Size>(0, row - run->first);
}

Spread Listing::spread(const float *near) const {
  if (weights.empty()) return Spread::of(near, count());
  double number = 0, total = 0, squares = 0;
  for (Size place = 0; place < count(); ++place)
    if (near[place] != NONE) number += weights[place], total += weights[place] * static_cast<double>(near[place]);
  if (number == 0) return {};
  const double mean = total / number;
  for (Size place = 0; place < count(); ++place)
    if (near[place] != NONE) squares += weights[place] * (static_cast<double>(near[place]) - mean) * (static_cast<double>(near[place]) - mean);
  return {mean, std::max(MIN_SPREAD, std::sqrt(squares / number))};
}

std::vector<float> Belief::of_rows(std::vector<float> memory) const {
  memory.assign(mapped.begin(), mapped.begin() + rows.count);
  for (int speed = 1; speed < SPEEDS; ++speed)
    add(memory.data(), mapped.data() + speed * rows.count, 1, rows.count);
  return memory;
}

// -------------------------------------------------------------------------------------------- filter

Filter::Filter(const Drives &drives, const Motion &motion, std::vector<int> ways)
    : drives_(drives), motion_(motion), steps_(motion.rate), ways_(std::move(ways)) {}

std::pair<Size, Size> Filter::reach() const {
  Size least = 0, most = 0;
  for (const int way : ways_)
    for (const Steps::Speed &speed : steps_.of) {
      least = std::min({least, way * speed.first, way * speed.last()});
      most = std::max({most, way * speed.first, way * speed.last()});
    }
  return {least, most};
}

Size Filter::places() const {
  return std::max<Size>(1, drives_.rows) * static_cast<Size>(ways_.size());
}

double Filter::unmapped_at_start() const { return drives_.rows ? motion_.unmapped : 1.0; }

Belief Filter::start(const Rows &rows, std::vector<float> memory) const {
  memory.clear();
  Belief belief{rows, std::move(memory), 0, unmapped_at_start()};
  const double share = (1 - belief.unmapped) / static_cast<double>(places());
  belief.mapped.reserve(ways_.size() * SPEEDS * static_cast<std::size_t>(rows.count));
  for (std::size_t way = 0; way < ways_.size(); ++way)
    for (const double prior : PRIOR)
      belief.mapped.insert(belief.mapped.end(), static_cast<std::size_t>(rows.count),
                           static_cast<float>(prior * share));
  belief.elsewhere =
      share * static_cast<double>((drives_.rows - rows.count) * static_cast<Size>(ways_.size()));
  return belief;
}

Belief Filter::extended(const Belief &belief, const Rows &rows, std::vector<float> memory) const {
  memory.assign(ways_.size() * SPEEDS * static_cast<std::size_t>(rows.count), 0);
  Belief more{rows, std::move(memory), belief.elsewhere, belief.unmapped};
  const auto copy = [&](const Run &run, Size row, Size place, Size count) {
    for (std::size_t state = 0; state < ways_.size() * SPEEDS; ++state)
      std::copy_n(belief.mapped.data() + static_cast<Size>(state) * belief.rows.count + run.at +
                      row - run.first,
                  count, more.mapped.data() + static_cast<Size>(state) * rows.count + place);
  };
  for (const Run &run : belief.rows.runs)
    visit(
        run.first, run.last, run.drive, rows, drives_,
        [&](Size row, Size place, Size count) { copy(run, row, place, count); }, [](Size, Size) {},
        [](Size, Size) {});
  return more;
}

// Moves the belief in listed rows. Returns what reaches rows that are not listed; what leaves its drive
// is lost.
double Filter::transition(const Belief &before, Belief &after, double &lost) const {
  const Size here = before.rows.count, there = after.rows.count;
  const double stays = 1 - motion_.jump;
  double left = 0;
  std::vector<float> all(BLOCK), padded, out;
  in_pieces(before.rows, [&](const Run &piece) {
    const Size size = piece.last - piece.first;
    for (std::size_t way = 0; way < ways_.size(); ++way) {
      const float *from = before.mapped.data() + static_cast<Size>(way) * SPEEDS * here + piece.at;
      std::copy_n(from, size, all.data());
      for (int speed = 1; speed < SPEEDS; ++speed) add(all.data(), from + speed * here, 1, size);
      for (int speed = 0; speed < SPEEDS; ++speed) {
        const Steps::Speed &steps = steps_.of[speed];
        const Size width = steps.count(), reached = size + width - 1;
        padded.resize(static_cast<std::size_t>(reached + width - 1));
        std::fill_n(padded.begin(), width - 1, 0.0F);
        std::fill_n(padded.end() - (width - 1), width - 1, 0.0F);
        mixed(padded.data() + width - 1, from + speed * here,
              static_cast<float>(stays * (1 - motion_.change)), all.data(),
              static_cast<float>(stays * motion_.change * PRIOR[speed]), size);
        const bool onwards = ways_[way] == FORWARDS;
        const float *chances = (onwards ? steps.reversed : steps.chances).data();
        const Size first = piece.first + (onwards ? steps.first : -steps.last());
        float *to = after.mapped.data() + (static_cast<Size>(way) * SPEEDS + speed) * there;
        const auto moved = [&](Size row, Size count) {
          out.assign(static_cast<std::size_t>(count), 0.0F);
          slide(out.data(), padded.data() + row - first, count, chances, width);
          return sum(out.data(), count);
        };
        visit(
            first, first + reached, piece.drive, after.rows, drives_,
            [&](Size row, Size place, Size count) {
              slide(to + place, padded.data() + row - first, count, chances, width);
            },
            [&](Size row, Size count) { left += moved(row, count); },
            [&](Size row, Size count) { lost += moved(row, count); });
      }
    }
  });
  return left;
}

Belief Filter::predicted(const Belief &before, const Rows &rows, std::vector<float> memory) const {
  if (!drives_.rows) return {rows, {}, 0, 1};
  const Size here = before.rows.count, there = rows.count;
  const auto ways = static_cast<Size>(ways_.size());
  memory.assign(static_cast<std::size_t>(ways * SPEEDS * there), 0);
  Belief after{rows, std::move(memory), 0, 0};
  double lost = motion_.jump * (1 - before.unmapped);
  const double left = transition(before, after, lost);
  Size fresh = 0;  // listed now, but not before
  visit_others(rows, before.rows, drives_, [&](Size, Size count) { fresh += count; });
  const double stayed = before.elsewhere * (1 - motion_.jump);
  const double came = stayed * static_cast<double>(fresh) /
                      static_cast<double>(std::max<Size>(1, drives_.rows - here));
  if (came > 0) {
    const double share = came / static_cast<double>(fresh * ways);
    visit_others(rows, before.rows, drives_, [&](Size place, Size count) {
      for (Size state = 0; state < ways * SPEEDS; ++state)
        for (Size i = 0; i < count; ++i)
          after.mapped[static_cast<std::size_t>(state * there + place + i)] +=
              static_cast<float>(PRIOR[static_cast<std::size_t>(state % SPEEDS)] * share);
    });
  }
  const double any_row = lost * (1 - motion_.unmapped) + before.unmapped * (1 - motion_.stay);
  const double share = any_row / static_cast<double>(places());
  after.unmapped = lost * motion_.unmapped + before.unmapped * motion_.stay;
  after.elsewhere =
      left + stayed - came + share * static_cast<double>((drives_.rows - there) * ways);
  for (Size state = 0; state < ways * SPEEDS; ++state)
    raise(after.mapped.data() + state * there,
          static_cast<float>(PRIOR[static_cast<std::size_t>(state % SPEEDS)] * share), there);
  return after;
}

double Filter::update(Belief &belief, const Likelihood &likelihood) const {
  const Size count = belief.rows.count, others = drives_.rows - count;
  const auto states = static_cast<Size>(ways_.size()) * SPEEDS;
  const float *emission = likelihood.rows.data();
  const auto total_of = [&](const Belief &now) {
    double total = now.elsewhere * likelihood.elsewhere + now.unmapped;
    for (Size state = 0; state < states; ++state)
      total += dot(now.mapped.data() + state * count, emission, count);
    return total;
  };
  double total = total_of(belief);
  if (total < LEAST_TOTAL) total = total_of(belief = start(belief.rows));
  if (total < LEAST_TOTAL) return 0;
  for (Size state = 0; state < states; ++state)
    multiply(belief.mapped.data() + state * count, emission, static_cast<float>(1 / total), count);
  belief.elsewhere *= likelihood.elsewhere;
  belief.elsewhere /= total;
  belief.unmapped /= total;
  const double mean = (sum(emission, count) + static_cast<double>(others) * likelihood.elsewhere) /
                      static_cast<double>(std::max<Size>(1, drives_.rows));
  const double unmapped = unmapped_at_start();
  return log_of(total / ((1 - unmapped) * mean + unmapped));
}

Future Filter::none(const Belief &belief) const {
  return {std::vector<float>(belief.mapped.size(), 1.0F), 1, 1};
}

// The future of a piece of neighbouring rows, by that of the later rows.
void Filter::transition_back(const Run &piece, std::size_t way, const Future &future, const Rows &later,
                        const Likelihood &likelihood, double lost, Future &earlier,
                        Size here) const {
  const Size size = piece.last - piece.first, there = later.count;
  const float elsewhere = static_cast<float>(future.elsewhere * likelihood.elsewhere);
  const double stays = 1 - motion_.jump;
  std::vector<float> padded, reached(static_cast<std::size_t>(SPEEDS * size)),
      all(static_cast<std::size_t>(size));
  for (int speed = 0; speed < SPEEDS; ++speed) {
    const Steps::Speed &steps = steps_.of[speed];
    const bool onwards = ways_[way] == FORWARDS;
    const Size width = steps.count(), first = piece.first + (onwards ? steps.first : -steps.last());
    const float *from = future.mapped.data() + (static_cast<Size>(way) * SPEEDS + speed) * there;
    padded.resize(static_cast<std::size_t>(size + width - 1));
    visit(
        first, first + size + width - 1, piece.drive, later, drives_,
        [&](Size row, Size place, Size count) {
          const float *emission = likelihood.rows.data() + place;
          for (Size i = 0; i < count; ++i) padded[row - first + i] = from[place + i] * emission[i];
        },
        [&](Size row, Size count) { std::fill_n(padded.begin() + row - first, count, elsewhere); },
        [&](Size row, Size count) {
          std::fill_n(padded.begin() + row - first, count, static_cast<float>(lost));
        });
    slide(reached.data() + speed * size, padded.data(), size,
          (onwards ? steps.chances : steps.reversed).data(), width);
    add(all.data(), reached.data() + speed * size,
        static_cast<float>(stays * motion_.change * PRIOR[speed]), size);
  }
  raise(all.data(), static_cast<float>(motion_.jump * lost), size);
  for (int speed = 0; speed < SPEEDS; ++speed)
    mixed(earlier.mapped.data() + (static_cast<Size>(way) * SPEEDS + speed) * here + piece.at,
          reached.data() + speed * size, static_cast<float>(stays * (1 - motion_.change)),
          all.data(), 1, size);
}

Future Filter::before(const Belief &belief, const Rows &later, const Likelihood &likelihood,
                      const Future &future, std::vector<float> memory) const {
  const Size here = belief.rows.count, there = later.count;
  const auto ways = static_cast<Size>(ways_.size());
  const float *emission = likelihood.rows.data();
  double any_row = 0;
  for (Size state = 0; state < ways * SPEEDS; ++state)
    any_row += PRIOR[static_cast<std::size_t>(state % SPEEDS)] *
               dot(future.mapped.data() + state * there, emission, there);
  const double elsewhere = future.elsewhere * likelihood.elsewhere;
  any_row += static_cast<double>((drives_.rows - there) * ways) * elsewhere;
  any_row /= static_cast<double>(places());
  const double lost = (1 - motion_.unmapped) * any_row + motion_.unmapped * future.unmapped;
  memory.assign(static_cast<std::size_t>(ways * SPEEDS * here), 0);
  Future earlier{std::move(memory), 0, 0};
  earlier.unmapped = motion_.stay * future.unmapped + (1 - motion_.stay) * any_row;
  in_pieces(belief.rows, [&](const Run &piece) {
    for (std::size_t way = 0; way < ways_.size(); ++way)
      transition_back(piece, way, future, later, likelihood, lost, earlier, here);
  });
  Size fresh = 0;
  double at_fresh = 0;
  visit_others(later, belief.rows, drives_, [&](Size place, Size count) {
    fresh += count;
    for (Size state = 0; state < ways * SPEEDS; ++state)
      at_fresh += PRIOR[static_cast<std::size_t>(state % SPEEDS)] *
                  dot(future.mapped.data() + state * there + place, emission + place, count);
  });
  const double part =
      static_cast<double>(fresh) / static_cast<double>(std::max<Size>(1, drives_.rows - here));
  const double come = fresh ? part * at_fresh / static_cast<double>(fresh * ways) : 0;
  earlier.elsewhere = (1 - motion_.jump) * (come + (1 - part) * elsewhere) + motion_.jump * lost;
  const auto count = static_cast<Size>(earlier.mapped.size());
  const double most = highest(earlier.mapped.data(), count);
  const double high = std::max({earlier.unmapped, earlier.elsewhere, most});
  if (high < LEAST_TOTAL) return none(belief);
  if (high > HIGH || high < 1 / HIGH) {
    scale(earlier.mapped.data(), static_cast<float>(1 / high), count);
    earlier.elsewhere /= high;
    earlier.unmapped /= high;
  }
  return earlier;
}

std::pair<std::vector<float>, double> Filter::smoothed(const Belief &belief,
                                                       const Future &future) const {
  const Size count = belief.rows.count;
  const auto states = static_cast<Size>(ways_.size()) * SPEEDS;
  std::vector<float> rows(static_cast<std::size_t>(count));
  const double unmapped = belief.unmapped * future.unmapped;
  double total = belief.elsewhere * future.elsewhere + unmapped;
  for (Size state = 0; state < states; ++state) {
    const float *now = belief.mapped.data() + state * count,
                *then = future.mapped.data() + state * count;
    if (state < SPEEDS)
      add_product(rows.data(), now, then, count);
    else
      total += dot(now, then, count);
  }
  total += sum(rows.data(), count);
  if (total < LEAST_TOTAL) return smoothed(belief, none(belief));
  scale(rows.data(), static_cast<float>(1 / total), count);
  return {rows, unmapped / total};
}

}  // namespace places
