// The hidden Markov model of filter.hpp, and the sums of numbers.hpp.

#include "filter.hpp"

namespace places {

namespace {
constexpr int LANES = 16;

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

// Visits the rows of a list by the rows that are `shift` farther in the same drive: those that are
// listed too, by both places and their number, and those that are not, by the place and the number.
template <typename Listed, typename Unlisted>
void visit(const Rows &from, const Rows &to, const Drives &drives, Size shift, Listed listed,
           Unlisted unlisted) {
  auto next = to.runs.begin();
  for (const Run &run : from.runs) {
    Size row = std::max(run.first + shift, drives.starts[run.drive]);
    const Size last = std::min(run.last + shift, drives.last(run.drive));
    const auto place = [&](Size target) { return run.at + target - shift - run.first; };
    while (next != to.runs.begin() && std::prev(next)->last > row) --next;
    while (row < last) {
      while (next != to.runs.end() && next->last <= row) ++next;
      const Size start = next == to.runs.end() ? last : std::min(last, next->first);
      if (row < start) {
        unlisted(place(row), start - row);
        row = start;
      }
      if (row == last) break;
      const Size end = std::min(last, next->last);
      listed(place(row), next->at + row - next->first, end - row);
      row = end;
    }
  }
}

// Calls a function with the place and the number of rows of one list that are not in another.
template <typename Function>
void visit_others(const Rows &rows, const Rows &known, const Drives &drives, Function function) {
  visit(rows, known, drives, 0, [](Size, Size, Size) {}, function);
}

}  // namespace

// ------------------------------------------------------------------------------------------- numbers

SSRVLAD_CLONES double sum(const float *values, Size count) {
  double lanes[LANES] = {};
  Size i = 0;
  for (; i + LANES <= count; i += LANES)
    for (int lane = 0; lane < LANES; ++lane) lanes[lane] += static_cast<double>(values[i + lane]);
  for (int lane = 0; i < count; ++i, ++lane) lanes[lane] += static_cast<double>(values[i]);
  for (int width = LANES / 2; width; width /= 2)
    for (int lane = 0; lane < width; ++lane) lanes[lane] += lanes[lane + width];
  return lanes[0];
}

SSRVLAD_CLONES double dot(const float *some, const float *others, Size count) {
  double lanes[LANES] = {};
  Size i = 0;
  for (; i + LANES <= count; i += LANES)
    for (int lane = 0; lane < LANES; ++lane)
      lanes[lane] += static_cast<double>(some[i + lane]) * static_cast<double>(others[i + lane]);
  for (int lane = 0; i < count; ++i, ++lane)
    lanes[lane] += static_cast<double>(some[i]) * static_cast<double>(others[i]);
  for (int width = LANES / 2; width; width /= 2)
    for (int lane = 0; lane < width; ++lane) lanes[lane] += lanes[lane + width];
  return lanes[0];
}

SSRVLAD_CLONES void add(float *target, const float *values, float factor, Size count) {
  for (Size i = 0; i < count; ++i) target[i] += factor * values[i];
}

SSRVLAD_CLONES void multiply(float *target, const float *values, Size count) {
  for (Size i = 0; i < count; ++i) target[i] *= values[i];
}

SSRVLAD_CLONES void scale(float *target, float factor, Size count) {
  for (Size i = 0; i < count; ++i) target[i] *= factor;
}

SSRVLAD_CLONES void nearness(const float *scores, Size count, float *near) {
  for (Size i = 0; i < count; ++i) {
    const double far = -log_of(std::max(1 - static_cast<double>(scores[i]), ROUNDING));
    near[i] = scores[i] == NONE ? NONE : static_cast<float>(far);
  }
}

Spread Spread::of(const float *near, Size count) {
  float least = std::numeric_limits<float>::infinity(), most = NONE;
  double total = 0;
  Size known = 0;
  for (Size i = 0; i < count; ++i)
    if (near[i] != NONE) {
      least = std::min(least, near[i]);
      most = std::max(most, near[i]);
      total += static_cast<double>(near[i]);
      ++known;
    }
  if (!known) return {};
  if (most - least <= MIN_SPREAD) return {static_cast<double>(least), MIN_SPREAD};
  const double mean = total / static_cast<double>(known);
  double squares = 0;
  for (Size i = 0; i < count; ++i)
    if (near[i] != NONE) squares += (near[i] - mean) * (near[i] - mean);
  return {mean, std::max(MIN_SPREAD, std::sqrt(squares / static_cast<double>(known)))};
}

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
    std::vector<std::pair<Size, double>> steps = {{0, 1.0}};
    for (double done = 0; done < rate; ++done) {
      const double likely = done < whole ? 1.0 : rate - whole;
      std::vector<double> after(steps.size() + 12, 0.0);
      const Size first = steps.front().first - 1;
      for (const auto &[far, chance] : steps) {
        after[static_cast<std::size_t>(far - first)] += (1 - likely) * chance;
        for (const auto &[step, part] : STEPS[speed])
          after[static_cast<std::size_t>(far + step - first)] += chance * part * likely;
      }
      steps.clear();
      for (std::size_t place = 0; place < after.size(); ++place)
        if (after[place] > 0) steps.emplace_back(first + static_cast<Size>(place), after[place]);
    }
    of[speed] = steps;
  }
}

std::vector<float> likelihoods(const float *scores, Size count, const Motion &motion,
                               const Spread &spread) {
  std::vector<float> found(static_cast<std::size_t>(count), 1.0F);
  if (spread.deviation <= MIN_SPREAD) return found;
  const double level = spread.mean + motion.level * spread.deviation;
  const double weight = motion.weight / spread.deviation;
  for (Size i = 0; i < count; ++i) {
    const double told = (nearness(static_cast<double>(scores[i])) - level) * weight;
    found[i] = static_cast<float>(exp_of(std::min(told, MAX_LOG)));
  }
  return found;
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
  Rows some;
  some.count = count;
  for (Size i = 0; i < count; ++i) {
    const Size drive = of(listed[i]);
    if (!some.runs.empty() && some.runs.back().last == listed[i] && some.runs.back().drive == drive)
      ++some.runs.back().last;
    else
      some.runs.push_back({listed[i], listed[i] + 1, i, drive});
  }
  return some;
}

std::vector<float> Belief::of_rows() const {
  std::vector<float> found(mapped.begin(), mapped.begin() + rows.count);
  for (int speed = 1; speed < SPEEDS; ++speed)
    add(found.data(), mapped.data() + speed * rows.count, 1, rows.count);
  return found;
}

// -------------------------------------------------------------------------------------------- filter

Filter::Filter(const Drives &drives, const Motion &motion, std::vector<int> ways)
    : drives_(drives), motion_(motion), steps_(motion.rate), ways_(std::move(ways)) {}

Size Filter::places() const {
  return std::max<Size>(1, drives_.rows) * static_cast<Size>(ways_.size());
}

double Filter::unmapped_at_start() const { return drives_.rows ? motion_.unmapped : 1.0; }

Belief Filter::start(const Rows &rows) const {
  Belief belief{rows, {}, 0, unmapped_at_start()};
  const double each = (1 - belief.unmapped) / static_cast<double>(places());
  belief.mapped.reserve(ways_.size() * SPEEDS * static_cast<std::size_t>(rows.count));
  for (std::size_t way = 0; way < ways_.size(); ++way)
    for (const double prior : PRIOR)
      belief.mapped.insert(belief.mapped.end(), static_cast<std::size_t>(rows.count),
                           static_cast<float>(prior * each));
  belief.elsewhere = each * static_cast<double>((drives_.rows - rows.count) * static_cast<Size>(ways_.size()));
  return belief;
}

Belief Filter::extended(const Belief &belief, const Rows &rows) const {
  Belief more{rows, {}, belief.elsewhere, belief.unmapped};
  more.mapped.resize(ways_.size() * SPEEDS * static_cast<std::size_t>(rows.count));
  visit(belief.rows, rows, drives_, 0,
        [&](Size from, Size to, Size count) {
          for (std::size_t state = 0; state < ways_.size() * SPEEDS; ++state)
            std::copy_n(belief.mapped.data() + static_cast<Size>(state) * belief.rows.count + from, count,
                        more.mapped.data() + static_cast<Size>(state) * rows.count + to);
        },
        [](Size, Size) {});
  return more;
}

Belief Filter::predicted(const Belief &before, const Rows &rows) const {
  if (!drives_.rows) return {rows, {}, 0, 1};
  const Size here = before.rows.count, there = rows.count;
  Belief after{rows, std::vector<float>(ways_.size() * SPEEDS * static_cast<std::size_t>(there)), 0, 0};
  std::vector<float> all(static_cast<std::size_t>(here)), turned(all.size());
  double left = 0;  // for rows that are not listed
  for (std::size_t way = 0; way < ways_.size(); ++way) {
    const float *from = before.mapped.data() + static_cast<Size>(way) * SPEEDS * here;
    float *to = after.mapped.data() + static_cast<Size>(way) * SPEEDS * there;
    std::copy_n(from, here, all.data());
    for (int speed = 1; speed < SPEEDS; ++speed) add(all.data(), from + speed * here, 1, here);
    for (int speed = 0; speed < SPEEDS; ++speed) {
      std::copy_n(from + speed * here, here, turned.data());
      scale(turned.data(), static_cast<float>(1 - motion_.change), here);
      add(turned.data(), all.data(), static_cast<float>(motion_.change * PRIOR[speed]), here);
      for (const auto &[step, chance] : steps_.of[speed]) {
        const double part = chance * (1 - motion_.jump);
        visit(before.rows, rows, drives_, ways_[way] * step,
              [&](Size place, Size target, Size count) {
                add(to + speed * there + target, turned.data() + place, static_cast<float>(part), count);
              },
              [&](Size place, Size count) { left += part * sum(turned.data() + place, count); });
      }
    }
  }
  Size fresh = 0;  // listed now, but not before
  visit_others(rows, before.rows, drives_, [&](Size, Size count) { fresh += count; });
  const double stayed = before.elsewhere * (1 - motion_.jump);
  const double came = stayed * static_cast<double>(fresh) / static_cast<double>(std::max<Size>(1, drives_.rows - here));
  if (fresh && came > 0) {
    const double each = came / static_cast<double>(fresh) / static_cast<double>(ways_.size());
    visit_others(rows, before.rows, drives_, [&](Size place, Size count) {
      for (std::size_t state = 0; state < ways_.size() * SPEEDS; ++state)
        for (Size i = 0; i < count; ++i)
          after.mapped[static_cast<std::size_t>(static_cast<Size>(state) * there + place + i)] +=
              static_cast<float>(PRIOR[state % SPEEDS] * each);
    });
  }
  after.elsewhere = left + stayed - came;
  const double mapped = sum(after.mapped.data(), static_cast<Size>(after.mapped.size()));
  const double lost = std::max(0.0, 1 - before.unmapped - mapped - after.elsewhere);
  const double any_row = lost * (1 - motion_.unmapped) + before.unmapped * (1 - motion_.stay);
  after.unmapped = lost * motion_.unmapped + before.unmapped * motion_.stay;
  const double each = any_row / static_cast<double>(places());
  after.elsewhere += each * static_cast<double>((drives_.rows - there) * static_cast<Size>(ways_.size()));
  for (std::size_t state = 0; state < ways_.size() * SPEEDS; ++state) {
    const float prior = static_cast<float>(PRIOR[state % SPEEDS] * each);
    float *cells = after.mapped.data() + static_cast<Size>(state) * there;
    for (Size i = 0; i < there; ++i) cells[i] += prior;
  }
  return after;
}

double Filter::update(Belief &belief, const Likelihood &likelihood) const {
  const Size count = belief.rows.count, others = drives_.rows - count;
  const std::size_t states = ways_.size() * SPEEDS;
  for (std::size_t state = 0; state < states; ++state)
    multiply(belief.mapped.data() + static_cast<Size>(state) * count, likelihood.rows.data(), count);
  belief.elsewhere *= likelihood.elsewhere;
  const double total = sum(belief.mapped.data(), static_cast<Size>(belief.mapped.size())) +
                       belief.elsewhere + belief.unmapped;
  scale(belief.mapped.data(), static_cast<float>(1 / total), static_cast<Size>(belief.mapped.size()));
  belief.elsewhere /= total;
  belief.unmapped /= total;
  const double mean = (sum(likelihood.rows.data(), count) +
                       static_cast<double>(others) * likelihood.elsewhere) /
                      static_cast<double>(std::max<Size>(1, drives_.rows));
  const double unmapped = unmapped_at_start();
  return log_of(total / ((1 - unmapped) * mean + unmapped));
}

Future Filter::none(const Belief &belief) const {
  return {std::vector<float>(belief.mapped.size(), 1.0F), 1, 1};
}

Future Filter::before(const Belief &belief, const Rows &later, const Likelihood &likelihood,
                      const Future &future) const {
  const Size here = belief.rows.count, there = later.count;
  const std::size_t ways = ways_.size();
  std::vector<float> weighted = future.mapped;
  double any_row = 0;
  for (std::size_t state = 0; state < ways * SPEEDS; ++state) {
    float *cells = weighted.data() + static_cast<Size>(state) * there;
    multiply(cells, likelihood.rows.data(), there);
    any_row += PRIOR[state % SPEEDS] * sum(cells, there);
  }
  const double elsewhere = future.elsewhere * likelihood.elsewhere;
  any_row += static_cast<double>((drives_.rows - there) * static_cast<Size>(ways)) * elsewhere;
  any_row /= static_cast<double>(places());
  const double lost = (1 - motion_.unmapped) * any_row + motion_.unmapped * future.unmapped;
  Future earlier{std::vector<float>(ways * SPEEDS * static_cast<std::size_t>(here)), 0, 0};
  earlier.unmapped = motion_.stay * future.unmapped + (1 - motion_.stay) * any_row;
  // by the speed after: what is reached, and with what probability a row of the drive
  std::vector<float> reached(SPEEDS * static_cast<std::size_t>(here)), inside(reached.size());
  std::vector<float> all(static_cast<std::size_t>(here));
  for (std::size_t way = 0; way < ways; ++way) {
    std::fill(reached.begin(), reached.end(), 0.0F);
    std::fill(inside.begin(), inside.end(), 0.0F);
    const float *from = weighted.data() + static_cast<Size>(way) * SPEEDS * there;
    for (int speed = 0; speed < SPEEDS; ++speed)
      for (const auto &[step, chance] : steps_.of[speed]) {
        const float part = static_cast<float>(chance);
        float *to = reached.data() + speed * here, *in = inside.data() + speed * here;
        visit(belief.rows, later, drives_, ways_[way] * step,
              [&](Size place, Size target, Size count) {
                add(to + place, from + speed * there + target, part, count);
                for (Size i = 0; i < count; ++i) in[place + i] += part;
              },
              [&](Size place, Size count) {
                for (Size i = 0; i < count; ++i) {
                  to[place + i] += part * static_cast<float>(elsewhere);
                  in[place + i] += part;
                }
              });
      }
    for (std::size_t place = 0; place < inside.size(); ++place)  // what leaves its drive is lost
      reached[place] += std::max(0.0F, 1 - inside[place]) * static_cast<float>(lost);
    std::fill(all.begin(), all.end(), 0.0F);
    for (int speed = 0; speed < SPEEDS; ++speed)
      add(all.data(), reached.data() + speed * here, static_cast<float>(PRIOR[speed]), here);
    for (int speed = 0; speed < SPEEDS; ++speed) {
      float *cells = earlier.mapped.data() + (static_cast<Size>(way) * SPEEDS + speed) * here;
      add(cells, reached.data() + speed * here, static_cast<float>((1 - motion_.jump) * (1 - motion_.change)), here);
      add(cells, all.data(), static_cast<float>((1 - motion_.jump) * motion_.change), here);
      for (Size i = 0; i < here; ++i) cells[i] += static_cast<float>(motion_.jump * lost);
    }
  }
  Size fresh = 0;
  double at_fresh = 0;
  visit_others(later, belief.rows, drives_, [&](Size place, Size count) {
    fresh += count;
    for (std::size_t state = 0; state < ways * SPEEDS; ++state)
      at_fresh += PRIOR[state % SPEEDS] * sum(weighted.data() + static_cast<Size>(state) * there + place, count);
  });
  const double part = static_cast<double>(fresh) / static_cast<double>(std::max<Size>(1, drives_.rows - here));
  const double come = fresh ? part * at_fresh / static_cast<double>(fresh * static_cast<Size>(ways)) : 0;
  earlier.elsewhere = (1 - motion_.jump) * (come + (1 - part) * elsewhere) + motion_.jump * lost;
  double highest = std::max(earlier.unmapped, earlier.elsewhere);
  for (const float cell : earlier.mapped) highest = std::max(highest, static_cast<double>(cell));
  scale(earlier.mapped.data(), static_cast<float>(1 / highest), static_cast<Size>(earlier.mapped.size()));
  earlier.elsewhere /= highest;
  earlier.unmapped /= highest;
  return earlier;
}

Belief Filter::smoothed(const Belief &belief, const Future &future) const {
  Belief found = belief;
  multiply(found.mapped.data(), future.mapped.data(), static_cast<Size>(found.mapped.size()));
  found.elsewhere *= future.elsewhere;
  found.unmapped *= future.unmapped;
  const double total =
      sum(found.mapped.data(), static_cast<Size>(found.mapped.size())) + found.elsewhere + found.unmapped;
  scale(found.mapped.data(), static_cast<float>(1 / total), static_cast<Size>(found.mapped.size()));
  found.elsewhere /= total;
  found.unmapped /= total;
  return found;
}

}  // namespace places
