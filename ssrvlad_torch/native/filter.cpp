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

// Calls a function with neighbouring rows in pieces.
template <typename Function>
void in_pieces(const Run &run, Function function) {
  for (Size first = run.first; first < run.last; first += BLOCK)
    function(Run{first, std::min(run.last, first + BLOCK), run.at + first - run.first, run.drive});
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

// Takes the sums of as many following values as there are weights, each times its weight. A loop of a number that the
// compiler knows is ten times as fast; a speed has at most seven steps, as rates above 1 are whole and at most MOST_RATE.
template <typename Take>
void slide(const float *values, Size count, const std::vector<float> &weights, Take take) {
  const auto by = [&](auto width) {
    constexpr Size WIDTH = width;
    std::array<float, WIDTH> factors;
    std::copy_n(weights.begin(), WIDTH, factors.begin());
    on_cpu([=](auto) {
      for (Size i = 0; i < count; ++i) {
        float total = 0;
        for (Size k = 0; k < WIDTH; ++k) total += factors[k] * values[i + k];
        take(i, total);
      }
    });
  };
  switch (weights.size()) {
    case 1: return by(std::integral_constant<Size, 1>());
    case 2: return by(std::integral_constant<Size, 2>());
    case 3: return by(std::integral_constant<Size, 3>());
    case 4: return by(std::integral_constant<Size, 4>());
    case 5: return by(std::integral_constant<Size, 5>());
    case 6: return by(std::integral_constant<Size, 6>());
    default: return by(std::integral_constant<Size, 7>());
  }
}

// The sums of the speeds of neighbouring rows, of as many rows.
void sum_speeds(float *target, const float *values, Size rows, Size count) {
  on_cpu([=](auto) {
    for (Size i = 0; i < count; ++i) {
      float total = values[i];
      for (int speed = 1; speed < SPEEDS; ++speed) total += values[speed * rows + i];
      target[i] = total;
    }
  });
}

// Scales a future by the highest of its numbers: products with those of another frame stay finite.
void scale_future(Future &future, double high) {
  if (high <= HIGH && high >= 1 / HIGH) return;
  future.unit = 1 / high;
  for (double *value : {&future.elsewhere, &future.unmapped, &future.any_row}) *value /= high;
}

// Of values and what they have in common, each times a factor.
void mix(float *target, const float *values, float factor, const float *common, float part, Size count) {
  on_cpu([=](auto) { for (Size i = 0; i < count; ++i) target[i] = factor * values[i] + part * common[i]; });
}

// Makes a future of what steps lead to, times a factor, and of what is common to all speeds; adds its products with a
// belief to the smoothed ones; and weighs it: the sum.
double look_back(float *future, const float *moved, float factor, const float *common, const float *belief,
                 float *smoothed, const float *likely, Size count) {
  on_cpu([=](auto) {
    for (Size i = 0; i < count; ++i) {
      const float later = factor * moved[i] + common[i];
      smoothed[i] += belief[i] * later;
      future[i] = later * likely[i];
    }
  });
  return quick_sum(future, count);
}

// Memory for neighbouring rows of a drive, and those that steps lead to or from: by speed what comes from a list.
struct Window {
  struct Part {
    Size at, place, count;  // in the window, and in the list
  };

  std::vector<Part> parts;
  Floats values, all, moved;

  bool is_full() const { return parts.size() == 1 && parts.front().count == static_cast<Size>(values.size()); }
};

// Takes what comes to neighbouring rows of a drive from the listed rows of a belief, by speed: values before steps, and
// the probabilities of the steps.
template <typename Take>
void arrive(const Belief &before, Size way, const Drives &drives, const Steps &steps, const Motion &motion,
            const Run &to, Window &window, Take take) {
  const Size size = to.last - to.first, first = to.first - steps.last, width = size + steps.last - steps.first;
  const float *mapped = before.mapped.data() + way * SPEEDS * before.rows.count;
  const double stays = (1 - motion.jump) * before.unit;
  window.parts.clear();
  visit(
      first, first + width, to.drive, before.rows, drives,
      [&](Size row, Size place, Size count) { window.parts.push_back({row - first, place, count}); },
      [](Size, Size) {}, [](Size, Size) {});
  for (Floats *numbers : {&window.values, &window.all}) {
    numbers->resize(static_cast<std::size_t>(width));
    if (!window.is_full()) std::fill(numbers->begin(), numbers->end(), 0.0F);
  }
  for (const auto &[at, place, count] : window.parts)
    sum_speeds(window.all.data() + at, mapped + place, before.rows.count, count);
  for (int number = 0; number < SPEEDS; ++number) {
    const Steps::Speed &speed = steps.of[number];
    for (const auto &[at, place, count] : window.parts)
      mix(window.values.data() + at, mapped + number * before.rows.count + place,
          static_cast<float>(stays * (1 - motion.change)), window.all.data() + at,
          static_cast<float>(stays * motion.change * PRIOR[number]), count);
    take(number, window.values.data() + steps.last - speed.last(), speed.reversed);
  }
}

// What is found from neighbouring rows of a drive, by a future, from a list, from rows that are not listed, and outside
// the drive; and from all speeds by a change of it.
void depart(const Future &future, const Rows &later, double outside, const Drives &drives,
            const Steps &steps, const Motion &motion, const Run &from, Window &window) {
  const Size size = from.last - from.first, first = from.first + steps.first,
             width = size + steps.last - steps.first;
  const float *mapped = future.mapped.data();
  window.parts.clear();
  window.values.resize(static_cast<std::size_t>(width));
  window.all.assign(static_cast<std::size_t>(size), static_cast<float>(motion.jump * outside));
  window.moved.resize(static_cast<std::size_t>(SPEEDS * size));
  const auto fill = [&](Size row, Size count, double value) {
    std::fill_n(window.values.begin() + row - first, count, static_cast<float>(value / future.unit));
  };
  visit(
      first, first + width, from.drive, later, drives,
      [&](Size row, Size place, Size count) { window.parts.push_back({row - first, place, count}); },
      [&](Size row, Size count) { fill(row, count, future.elsewhere); },
      [&](Size row, Size count) { fill(row, count, outside); });
  for (int number = 0; number < SPEEDS; ++number) {
    const Steps::Speed &speed = steps.of[number];
    const float *values =
        window.is_full() ? mapped + number * later.count + window.parts.front().place : window.values.data();
    for (const auto &[at, place, count] : window.parts)
      if (!window.is_full()) std::copy_n(mapped + number * later.count + place, count, window.values.begin() + at);
    float *moved = window.moved.data() + number * size;
    const auto changes = static_cast<float>((1 - motion.jump) * motion.change * PRIOR[number] * future.unit);
    slide(values + speed.first - steps.first, size, speed.chances,
          [=, all = window.all.data()](Size at, float total) { moved[at] = total, all[at] += changes * total; });
  }
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

Steps::Steps(double rate, int way) {
  const double whole = std::floor(rate);
  for (int speed = 0; speed < SPEEDS; ++speed) {
    Size least_step = 0;
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
      least_step += least;
      chances = after;
    }
    while (chances.front() == 0) chances.erase(chances.begin()), ++least_step;
    if (way == BACKWARDS) {
      std::reverse(chances.begin(), chances.end());
      least_step = 1 - least_step - static_cast<Size>(chances.size());
    }
    of[speed] = {least_step, {chances.begin(), chances.end()}, {chances.rbegin(), chances.rend()}};
    first = speed ? std::min(first, least_step) : least_step;
    last = speed ? std::max(last, of[speed].last()) : of[speed].last();
  }
}

void likelihoods(const float *near, Size count, double weight, double level, const Spread &spread, float *likely) {
  const double least = spread.mean + level * spread.deviation, factor = weight / spread.deviation;
  on_cpu([=, limits = Limits()](auto) {
    for (Size i = 0; i < count; ++i) {
      const double emission = (static_cast<double>(near[i]) - least) * factor;
      const double capped = emission < limits.most ? emission : limits.most;
      likely[i] = static_cast<float>(exp_of<10>(near[i] == NONE ? limits.none : capped));
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
    if (const double away = static_cast<double>(near[place]) - mean; near[place] != NONE)
      squares += weights[place] * away * away;
  return {mean, std::max(MIN_SPREAD, std::sqrt(squares / number))};
}

Floats Belief::of_rows(Floats memory) const {
  memory.resize(static_cast<std::size_t>(rows.count));
  sum_speeds(memory.data(), mapped.data(), rows.count, rows.count);
  scale(memory.data(), static_cast<float>(unit), rows.count);
  return memory;
}

// -------------------------------------------------------------------------------------------- filter

Filter::Filter(const Drives &drives, const Motion &motion, const std::vector<int> &ways)
    : drives_(drives), motion_(motion) {
  for (const int way : ways) ways_.emplace_back(motion.rate, way);
}

std::pair<Size, Size> Filter::reach() const {
  Size least = 0, most = 0;
  for (const Steps &steps : ways_) least = std::min(least, steps.first), most = std::max(most, steps.last);
  return {least, most};
}

Size Filter::places() const {
  return std::max<Size>(1, drives_.rows) * static_cast<Size>(ways_.size());
}

double Filter::unmapped_at_start() const { return drives_.rows ? motion_.unmapped : 1.0; }

double Filter::any_row(double mapped, double elsewhere, const Rows &rows) const {
  const auto others = static_cast<double>((drives_.rows - rows.count) * static_cast<Size>(ways_.size()));
  return (mapped + others * elsewhere) / static_cast<double>(places());
}

Belief Filter::start(const Rows &rows, Floats memory) const {
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

Belief Filter::extended(const Belief &belief, const Rows &rows, Floats memory) const {
  memory.assign(ways_.size() * SPEEDS * static_cast<std::size_t>(rows.count), 0);
  Belief more{rows, std::move(memory), belief.elsewhere, belief.unmapped, belief.unit};
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

// What comes from the rows of a belief to rows that are not listed, and out of its drive.
Filter::Passing Filter::passing(const Belief &before, const Rows &rows) const {
  Passing passing;
  Window window;
  for (std::size_t way = 0; way < ways_.size(); ++way) {
    const Steps &steps = ways_[way];
    const Run *previous = nullptr;
    for (const Run &run : before.rows.runs) {
      const auto add_to = [&](double &total) {
        return [&](Size row, Size count) {
          in_pieces({row, row + count, 0, run.drive}, [&](const Run &to) {
            const Size size = to.last - to.first;
            window.moved.resize(static_cast<std::size_t>(SPEEDS * size));
            arrive(before, static_cast<Size>(way), drives_, steps, motion_, to, window,
                   [&](int speed, const float *values, const std::vector<float> &chances) {
                     slide(values, size, chances,
                           [=, moved = window.moved.data() + speed * size](Size at, float sum) { moved[at] = sum; });
                   });
            total += quick_sum(window.moved.data(), SPEEDS * size);
          });
        };
      };
      Size first = run.first + steps.first;
      if (previous && previous->drive == run.drive) first = std::max(first, previous->last + steps.last);
      visit(
          first, run.last + steps.last, run.drive, rows, drives_, [](Size, Size, Size) {},
          add_to(passing.unlisted), add_to(passing.outside));
      previous = &run;
    }
  }
  return passing;
}

std::pair<Belief, double> Filter::after(const Belief &before, const Rows &rows, const Likelihood &likelihood,
                                        Floats memory) const {
  if (!drives_.rows) return {Belief{rows, {}, 0, 1}, 0.0};
  const Size here = before.rows.count, there = rows.count;
  const auto ways = static_cast<Size>(ways_.size());
  const Passing passing = this->passing(before, rows);
  const double lost = passing.outside + motion_.jump * (1 - before.unmapped);
  Size fresh = 0;  // listed now, but not before
  visit_others(rows, before.rows, drives_, [&](Size, Size count) { fresh += count; });
  const double stayed = before.elsewhere * (1 - motion_.jump);
  const double came = stayed * static_cast<double>(fresh) /
                      static_cast<double>(std::max<Size>(1, drives_.rows - here));
  const double by_chance = (lost * (1 - motion_.unmapped) + before.unmapped * (1 - motion_.stay)) /
                           static_cast<double>(places());
  const double at_fresh = fresh ? came / static_cast<double>(fresh * ways) : 0;
  Belief after{rows, std::move(memory)};
  after.mapped.resize(static_cast<std::size_t>(ways * SPEEDS * there));
  after.unmapped = lost * motion_.unmapped + before.unmapped * motion_.stay;
  after.elsewhere = passing.unlisted + stayed - came + by_chance * static_cast<double>((drives_.rows - there) * ways);
  double mapped = 0;
  Window window;
  Floats from_others;
  for (Size way = 0; way < ways; ++way)
    for (const Run &run : rows.runs)
      in_pieces(run, [&](const Run &to) {
        const Size size = to.last - to.first;
        from_others.assign(static_cast<std::size_t>(size), static_cast<float>(by_chance));
        if (at_fresh > 0)
          visit(
              to.first, to.last, to.drive, before.rows, drives_, [](Size, Size, Size) {},
              [&](Size row, Size count) {
                raise(from_others.data() + row - to.first, static_cast<float>(at_fresh), count);
              },
              [](Size, Size) {});
        arrive(before, way, drives_, ways_[static_cast<std::size_t>(way)], motion_, to, window,
               [&](int speed, const float *values, const std::vector<float> &chances) {
                 float *target = after.mapped.data() + (way * SPEEDS + speed) * there + to.at;
                 slide(values, size, chances,
                       [=, others = from_others.data(), prior = static_cast<float>(PRIOR[speed]),
                        likely = likelihood.rows.data() + to.at](Size at, float moved) {
                         target[at] = (moved + prior * others[at]) * likely[at];
                       });
                 mapped += quick_sum(target, size);
               });
      });
  const double total = mapped + after.elsewhere * likelihood.elsewhere + after.unmapped;
  if (total >= LEAST_TOTAL) {
    const double gain = take(total, after, likelihood);
    return {std::move(after), gain};
  }
  after = start(rows, std::move(after.mapped));
  const double gain = update(after, likelihood);
  return {std::move(after), gain};
}

// Multiplies a belief by likelihoods, but for what is elsewhere: the sum of all.
double Filter::weigh(Belief &belief, const Likelihood &likelihood) const {
  const Size count = belief.rows.count;
  double mapped = 0;
  for (std::size_t state = 0; state < ways_.size() * SPEEDS; ++state)
    mapped += multiply(belief.mapped.data() + static_cast<Size>(state) * count, likelihood.rows.data(), count);
  return belief.unit * mapped + belief.elsewhere * likelihood.elsewhere + belief.unmapped;
}

// Makes probabilities of a belief that was weighed, by the sum of all: the logarithm of how much likelier the
// frame is so than alone.
double Filter::take(double total, Belief &belief, const Likelihood &likelihood) const {
  belief.unit /= total;
  belief.elsewhere *= likelihood.elsewhere / total;
  belief.unmapped /= total;
  const Size count = belief.rows.count, others = drives_.rows - count;
  const double mean = (sum(likelihood.rows.data(), count) + static_cast<double>(others) * likelihood.elsewhere) /
                      static_cast<double>(std::max<Size>(1, drives_.rows));
  const double unmapped = unmapped_at_start();
  return log_of(total / ((1 - unmapped) * mean + unmapped));
}

double Filter::update(Belief &belief, const Likelihood &likelihood) const {
  const auto anew = [&] { belief = start(Rows(belief.rows), std::move(belief.mapped)); };
  double total = weigh(belief, likelihood);
  if (total < LEAST_TOTAL) anew(), total = weigh(belief, likelihood);
  if (total >= LEAST_TOTAL) return take(total, belief, likelihood);
  anew();
  return 0;
}

Future Filter::last(const Belief &belief, const Likelihood &likelihood) const {
  Future future{{}, likelihood.elsewhere};
  for (int speed = 0; speed < SPEEDS; ++speed)
    future.mapped.insert(future.mapped.end(), likelihood.rows.begin(), likelihood.rows.begin() + belief.rows.count);
  const double mapped = sum(likelihood.rows.data(), belief.rows.count);
  future.any_row = any_row(mapped, likelihood.elsewhere, belief.rows);
  scale_future(future, std::max({future.unmapped, future.elsewhere, mapped}));
  return future;
}

std::pair<Future, Smoothed> Filter::before(const Belief &belief, const Likelihood &likelihood, const Rows &later,
                                           const Future &future, Floats memory) const {
  const Size here = belief.rows.count, there = later.count;
  const double stays = 1 - motion_.jump;
  const double lost = (1 - motion_.unmapped) * future.any_row + motion_.unmapped * future.unmapped;
  Size fresh = 0;
  double at_fresh = 0;
  visit_others(later, belief.rows, drives_, [&](Size place, Size count) {
    fresh += count;
    for (int speed = 0; speed < SPEEDS; ++speed)
      at_fresh += PRIOR[speed] * future.unit * sum(future.mapped.data() + speed * there + place, count);
  });
  const double part =
      static_cast<double>(fresh) / static_cast<double>(std::max<Size>(1, drives_.rows - here));
  const double come = fresh ? part * at_fresh / static_cast<double>(fresh) : 0;
  const double elsewhere = stays * (come + (1 - part) * future.elsewhere) + motion_.jump * lost;
  Future earlier{std::move(memory), elsewhere * likelihood.elsewhere,
                 motion_.stay * future.unmapped + (1 - motion_.stay) * future.any_row};
  earlier.mapped.resize(static_cast<std::size_t>(SPEEDS * here));
  Smoothed smoothed{Floats(static_cast<std::size_t>(here), 0.0F), belief.unmapped * earlier.unmapped};
  double mapped = 0;
  Window window;
  for (const Run &run : belief.rows.runs)
    in_pieces(run, [&](const Run &from) {
      const Size size = from.last - from.first;
      depart(future, later, lost, drives_, ways_.front(), motion_, from, window);
      const auto same_speed = static_cast<float>(stays * (1 - motion_.change) * future.unit);
      for (int speed = 0; speed < SPEEDS; ++speed) {
        const Size place = speed * here + from.at;
        const double found = look_back(earlier.mapped.data() + place, window.moved.data() + speed * size, same_speed,
                                       window.all.data(), belief.mapped.data() + place,
                                       smoothed.rows.data() + from.at, likelihood.rows.data() + from.at, size);
        mapped += PRIOR[speed] * found;
      }
    });
  const double total = belief.unit * sum(smoothed.rows.data(), here) + belief.elsewhere * elsewhere + smoothed.unmapped;
  if (total < LEAST_TOTAL) {
    smoothed = {belief.of_rows(), belief.unmapped};
  } else {
    scale(smoothed.rows.data(), static_cast<float>(belief.unit / total), here);
    smoothed.unmapped /= total;
  }
  earlier.any_row = any_row(mapped, earlier.elsewhere, belief.rows);
  const double high = std::max({earlier.unmapped, earlier.elsewhere, mapped});
  if (high < LEAST_TOTAL) return {last(belief, likelihood), std::move(smoothed)};
  scale_future(earlier, high);
  return {std::move(earlier), std::move(smoothed)};
}

}  // namespace places
