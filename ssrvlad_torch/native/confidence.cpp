// The rivals and the confidence of confidence.hpp.

#include "confidence.hpp"

#include <functional>

namespace places {

namespace {
constexpr float LEAST_BELIEF = 1e-38F;

// The quantile of the normal distribution of a probability from 1e-11 to 1/2 (Wichura, Applied
// Statistics 37, 1988, AS 241).
double quantile(double probability) {
  const auto ratio = [](const double (&over)[8], const double (&under)[8], double r) {
    double top = 0, bottom = 0;
    for (int place = 7; place >= 0; --place) {
      top = top * r + over[place];
      bottom = bottom * r + under[place];
    }
    return top / bottom;
  };
  static const double MIDDLE[][8] = {
      {3.3871328727963666080, 1.3314166789178437745e2, 1.9715909503065514427e3,
       1.3731693765509461125e4, 4.5921953931549871457e4, 6.7265770927008700853e4,
       3.3430575583588128105e4, 2.5090809287301226727e3},
      {1.0, 4.2313330701600911252e1, 6.8718700749205790830e2, 5.3941960214247511077e3,
       2.1213794301586595867e4, 3.9307895800092710610e4, 2.8729085735721942674e4,
       5.2264952788528545610e3}};
  static const double TAIL[][8] = {
      {1.42343711074968357734, 4.63033784615654529590, 5.76949722146069140550,
       3.64784832476320460504, 1.27045825245236838258, 2.41780725177450611770e-1,
       2.27238449892691845833e-2, 7.74545014278341407640e-4},
      {1.0, 2.05319162663775882187, 1.67638483018380384940, 6.89767334985100004550e-1,
       1.48103976427480074590e-1, 1.51986665636164571966e-2, 5.47593808499534494600e-4,
       1.05075007164441684324e-9}};
  const double q = probability - 0.5;
  if (q >= -0.425) return q * ratio(MIDDLE[0], MIDDLE[1], 0.180625 - q * q);
  return -ratio(TAIL[0], TAIL[1], std::sqrt(-log_of(probability)) - 1.6);
}

// The mean steps between the highest of so many normal values (Blom, 1958).
std::vector<double> mean_steps(double places) {
  std::vector<double> means, steps;
  for (Size rank = 1; rank <= std::min(MODEL.most_places, static_cast<Size>(places)); ++rank)
    means.push_back(quantile((static_cast<double>(rank) - 0.375) / (places + 0.25)));
  for (std::size_t rank = 1; rank < means.size(); ++rank)
    steps.push_back(means[rank] - means[rank - 1]);
  return steps;
}

struct Peak {
  float value;
  Size row;

  bool operator<(const Peak &other) const {
    return value > other.value || (value == other.value && row < other.row);
  }
};

constexpr Size BLOCK = 128;  // values, of which none is a peak if their highest is too low

// The highest of each block of values.
std::vector<float> highs_of(const float *values, Size count) {
  std::vector<float> highs;
  for (Size first = 0; first < count; first += BLOCK)
    highs.push_back(highest(values + first, std::min(BLOCK, count - first)));
  return highs;
}

// The rows that are at least so high and not lower than their neighbours.
std::vector<Peak> peaks_of(const float *values, const std::vector<float> &highs, const Rows &rows, float least) {
  std::vector<Peak> peaks;
  for (auto run = rows.runs.begin(); run != rows.runs.end();) {
    const Size first = run->at, row = run->first;
    Size last = run->last;
    for (++run; run != rows.runs.end() && run->first == last; ++run) last = run->last;
    const Size end = first + last - row;
    for (Size place = first; place < end; ++place) {
      if (highs[static_cast<std::size_t>(place / BLOCK)] < least) {
        place = (place / BLOCK + 1) * BLOCK - 1;
        continue;
      }
      const float value = values[place];
      if (value >= least && value > NONE && !(place > first && values[place - 1] > value) &&
          !(place + 1 < end && values[place + 1] > value))
        peaks.push_back({value, row + place - first});
    }
  }
  return peaks;
}

// What the highest of several blocks of values are not lower than: most of the best places are above it.
float high_level(std::vector<float> highs) {
  constexpr Size BLOCKS = 2 * MODEL.most_places;
  if (static_cast<Size>(highs.size()) <= BLOCKS) return NONE;
  std::nth_element(highs.begin(), highs.begin() + BLOCKS, highs.end(), std::greater<float>());
  return highs[BLOCKS];
}

// The best of peaks that are apart, falling.
std::vector<Peak> best_of(std::vector<Peak> peaks) {
  std::vector<Peak> best;
  const auto most = static_cast<std::ptrdiff_t>(MODEL.most_places * (2 * MODEL.elsewhere + 1));
  if (static_cast<std::ptrdiff_t>(peaks.size()) > most) {  // no others can be among the best
    std::nth_element(peaks.begin(), peaks.begin() + most, peaks.end());
    peaks.resize(static_cast<std::size_t>(most));
  }
  std::sort(peaks.begin(), peaks.end());
  for (const Peak &peak : peaks) {
    if (static_cast<Size>(best.size()) == MODEL.most_places) break;
    if (std::all_of(best.begin(), best.end(), [&](const Peak &other) {
          return std::max(peak.row, other.row) - std::min(peak.row, other.row) > MODEL.elsewhere;
        }))
      best.push_back(peak);
  }
  return best;
}

std::vector<Peak> best_places(const float *values, const Rows &rows) {
  const std::vector<float> highs = highs_of(values, rows.count);
  const float high = high_level(highs);
  std::vector<Peak> best = best_of(peaks_of(values, highs, rows, high));
  const bool are_all = high == NONE || static_cast<Size>(best.size()) == MODEL.most_places;
  return are_all ? best : best_of(peaks_of(values, highs, rows, NONE));
}

// `unit` turns numbers that rise with the values into values.
template <typename Unit>
Chance compared(const float *numbers, const Rows &rows, Size matching, Unit unit) {
  const std::vector<Peak> best = best_places(numbers, rows);
  Chance result;
  if (best.size() > 1) result.rival = best[1].row;
  if (matching < 0) matching = std::count_if(numbers, numbers + rows.count, [](float value) { return value > NONE; });
  const double places = static_cast<double>(matching) / MODEL.rows_a_place;
  const Size count = std::min(static_cast<Size>(best.size()) - 1, static_cast<Size>(places) - 1);
  if (count < 2) return result;
  const std::vector<double> means = mean_steps(places);
  double ahead = 0, below = 0;
  for (Size step = 0; step < count; ++step) {
    const double height = unit(best[step].value) - unit(best[step + 1].value);
    (step ? below : ahead) += height / means[step];
  }
  const double ratio = 1 + ahead / std::max(below, MODEL.rounding);
  result.chance = 1;
  for (Size step = 1; step < count; ++step) result.chance /= ratio;
  return result;
}
}  // namespace

Chance chance_of_scores(const float *scores, const Rows &rows, Size matching) {
  Floats numbers(static_cast<std::size_t>(rows.count));
  on_cpu([=, to = numbers.data(), count = rows.count](auto) {
    for (Size place = 0; place < count; ++place)
      to[place] = 1 - static_cast<double>(scores[place]) < ROUNDING ? 1 : scores[place];
  });
  return compared(numbers.data(), rows, matching,
                  [](float score) { return nearness(static_cast<double>(score)); });
}

Chance chance_of_beliefs(const float *beliefs, const float *scores, const Rows &rows,
                         Size matching) {
  Floats numbers(static_cast<std::size_t>(rows.count));
  scored(numbers.data(), beliefs, LEAST_BELIEF, scores, rows.count);
  return compared(numbers.data(), rows, matching,
                  [](float belief) { return log_of(static_cast<double>(belief)); });
}

Chance chance_of(const float *values, const Rows &rows, Size matching) {
  return compared(values, rows, matching, [](float value) { return static_cast<double>(value); });
}

std::vector<double> rivals_together(const std::vector<double> &chances, const std::vector<Size> &rivals) {
  std::vector<double> together(chances.size());
  std::vector<std::size_t> run;
  const auto end_run = [&] {
    for (const std::size_t query : run) together[query] = static_cast<double>(run.size());
    run.clear();
  };
  for (std::size_t query = 0; query < chances.size(); ++query) {
    if (std::isnan(chances[query])) continue;
    if (!run.empty() && std::abs(rivals[query] - rivals[run.back()]) > MODEL.near) end_run();
    run.push_back(query);
  }
  end_run();
  return together;
}

double answers_together(const std::vector<double> &rivals_together) {
  double total = 0, answers = 0;
  for (const double together : rivals_together) total += together, answers += together > 0;
  return answers > 0 ? total / answers : 1;
}

// ---------------------------------------------------------------------------------------- confidence

namespace {
constexpr double NEGLIGIBLE = 1e-15;  // weight of a point
constexpr double LEAST_CHANCE = 1e-3;  // less is as sure
constexpr double LEAST_AHEAD = 1.000500333583534e-3;  // -log of 1 - 1e-3

// A point of the prior: the fraction of wrong answers where the map has the places; of the gamma density of
// right ones the rate, the shape less 1 and the factor; the logarithm of the weight.
struct Point {
  double wrong, rate, shape, factor, log_weight;

  Point(double fraction, double slope, double more, double weight)
      : wrong(fraction), rate(slope), shape(more), log_weight(log_of(weight)) {
    factor = (1 + more) * log_of(slope);  // gamma functions of both shapes are 1
  }
};

constexpr int SHAPES = 2;  // 1 and 2

std::vector<Point> points_of_prior() {
  const auto away = [](int step) { return -MODEL.most_away + 2 * MODEL.most_away * step / (MODEL.points - 1); };
  std::vector<Point> points;
  double weights = 0;
  for (int step = 0; step < MODEL.points; ++step) weights += exp_of(-away(step) * away(step) / 2);
  for (int fraction = 0; fraction < MODEL.points; ++fraction)
    for (int step = 0; step < MODEL.points; ++step)
      for (int more = 0; more < SHAPES; ++more) {
        const double rate = 1 / (1 + exp_of(log_of(1 / MODEL.slope - 1) - MODEL.deviation * away(step)));
        const double weight =
            exp_of(-away(step) * away(step) / 2) / (weights * MODEL.points * SHAPES);
        points.emplace_back((fraction + 0.5) / MODEL.points, rate, more, weight);
      }
  return points;
}

const std::vector<Point> &prior() {
  static const std::vector<Point> points = points_of_prior();
  return points;
}

// The queries that have an answer.
std::vector<std::size_t> answered(const std::vector<double> &numbers) {
  std::vector<std::size_t> queries;
  for (std::size_t query = 0; query < numbers.size(); ++query)
    if (!std::isnan(numbers[query])) queries.push_back(query);
  return queries;
}

// The answers of a drive: the queries that have one, how far each is ahead, and the logarithm of that.
struct Answers {
  std::vector<std::size_t> queries;
  std::vector<double> ahead, logs;

  explicit Answers(const std::vector<double> &chances) : queries(answered(chances)) {
    for (const std::size_t query : queries) {
      const double chance = chances[query];
      const double far = chance > 0 ? -log_of(std::max(chance, 1e-300)) : MODEL.most_log;
      ahead.push_back(std::min(std::max(far, LEAST_AHEAD), MODEL.most_log));
      logs.push_back(log_of(ahead.back()));
    }
  }

  Size count() const { return static_cast<Size>(queries.size()); }
};

// How much likelier each answer is as one of the right ones than as any where the map lacks the place, at a
// point of the prior.
void compare(const Point &point, const Answers &answers, double *likelier) {
  on_cpu([=, &point, &answers](auto) {
    for (Size answer = 0; answer < answers.count(); ++answer)
      likelier[answer] =
          (1 - point.wrong) * exp_of(point.factor + point.shape * answers.logs[answer] +
                                     (1 - point.rate) * answers.ahead[answer]);
  });
}

// The logarithm of how likely answers are all in all, each of which counts so much.
double log_of_all(const double *likelier, const double *counts, Size number) {
  return on_cpu([=](auto) {
    double log = 0;
    for (Size answer = 0; answer < number; ++answer) log += counts[answer] * log_of(likelier[answer]);
    return log;
  });
}

// Makes logarithms weights of the sum 1.
void normalise(std::vector<double> &weights) {
  const double highest = *std::max_element(weights.begin(), weights.end());
  double total = 0;
  for (double &weight : weights) total += weight = exp_of(weight - highest);
  for (double &weight : weights) weight /= total;
}

// A drive in stretches whose places the map has or lacks.
class Stretches {
 public:
  explicit Stretches(Size count)
      : mapped_(static_cast<std::size_t>(count)), likely_(mapped_), once_(mapped_.size(), 1) {}

  // The forward algorithm: the logarithm of how likely queries are, each so many times `likelier` where
  // the map has its place as where it lacks it.
  double learn(const double *likelier, Size count) {
    double before = 1 - MODEL.unmapped;
    for (Size query = 0; query < count; ++query) {
      likely_[query] = before * likelier[query] + (1 - before);
      mapped_[query] = before * likelier[query] / likely_[query];
      before = STAY * mapped_[query] + (1 - STAY) * (1 - mapped_[query]);
    }
    return log_of_all(likely_.data(), once_.data(), count);
  }

  // The backward algorithm: the probabilities that the map has the places.
  const std::vector<double> &smooth(const double *likelier, Size count) {
    double future = 0.5;  // of the queries after one, where the map has its place and where it lacks it
    for (Size query = count - 1; query >= 0; --query) {
      const double both = mapped_[query] * future;
      mapped_[query] = both / (both + (1 - mapped_[query]) * (1 - future));
      const double here = likelier[query] * future, sum = here + (1 - future);
      future = (STAY * here + (1 - STAY) * (1 - future)) / sum;
    }
    return mapped_;
  }

 private:
  static constexpr double STAY = 1 - 1.0 / MODEL.stretch;

  std::vector<double> mapped_, likely_, once_;
};

// The probability that the map has the place of each of the queries: the mean over points, each weighed by how
// likely it makes the queries. `compare` tells how much likelier they are at a point where the map has the place.
template <typename Compare>
std::vector<double> mapped_at(const std::vector<double> &log_weights, const std::vector<std::size_t> &queries,
                              std::size_t all, Compare compare) {
  const Size count = static_cast<Size>(queries.size());
  std::vector<double> likelier(queries.size()), weights, result(all);
  Stretches stretches(count);
  for (std::size_t point = 0; point < log_weights.size(); ++point) {
    compare(point, likelier.data());
    weights.push_back(log_weights[point] + stretches.learn(likelier.data(), count));
  }
  normalise(weights);
  for (std::size_t point = 0; point < weights.size(); ++point) {
    if (weights[point] < NEGLIGIBLE) continue;
    compare(point, likelier.data());
    stretches.learn(likelier.data(), count);
    const std::vector<double> &smoothed = stretches.smooth(likelier.data(), count);
    for (std::size_t answer = 0; answer < queries.size(); ++answer)
      result[queries[answer]] += weights[point] * smoothed[answer];
  }
  for (double &value : result) value = std::min(value, 1.0);
  return result;
}
}  // namespace

std::vector<double> mapped(const std::vector<double> &chances, double together) {
  const Answers answers(chances);
  std::vector<double> log_weights;
  for (const Point &point : prior()) log_weights.push_back(point.log_weight);
  return mapped_at(log_weights, answers.queries, chances.size(), [&](std::size_t number, double *likelier) {
    const Point &point = prior()[number];
    on_cpu([=, &point, &answers](auto) {
      compare(point, answers, likelier);
      for (Size answer = 0; answer < answers.count(); ++answer)
        likelier[answer] = exp_of(log_of(point.wrong + likelier[answer]) / together);
    });
  });
}

std::vector<double> mapped_along(const std::vector<double> &nearer, const std::vector<double> &together) {
  const std::vector<std::size_t> queries = answered(nearer);
  const std::vector<double> log_weights(static_cast<std::size_t>(MODEL.points));
  return mapped_at(log_weights, queries, nearer.size(), [&](std::size_t number, double *likelier) {
    const double level = MODEL.chance_nearer + MODEL.most_nearer * static_cast<double>(number) / (MODEL.points - 1);
    for (std::size_t answer = 0; answer < queries.size(); ++answer) {
      const double away = nearer[queries[answer]] - level, by_chance = nearer[queries[answer]] - MODEL.chance_nearer;
      const double log = std::min((by_chance * by_chance - away * away) / 2, MODEL.most_log);
      likelier[answer] = exp_of(log / std::max(MODEL.least_together, together[queries[answer]]));
    }
  });
}

bool are_hardly_less_ahead(const std::vector<double> &followed, const std::vector<double> &alone) {
  const auto ahead = [](double chance) { return -log_of(std::max(chance, LEAST_CHANCE)); };
  double gained = 0;
  for (std::size_t query = 0; query < followed.size(); ++query)
    if (!std::isnan(followed[query])) gained += ahead(followed[query]) - ahead(alone[query]);
  return gained > -MODEL.behind * static_cast<double>(followed.size());
}

Confidence Confidence::of(const std::vector<double> &chances, const std::vector<double> &mapped,
                          double together, bool followed) {
  const Answers answers(chances);
  const Size count = answers.count();
  std::vector<double> right(answers.ahead), likelier(right), mean(right.size()), square(right.size());
  std::vector<double> counts;
  for (const std::size_t query : answers.queries) counts.push_back(mapped[query] / together);

  std::vector<double> weights;
  for (const Point &point : prior()) {
    compare(point, answers, likelier.data());
    for (double &value : likelier) value += point.wrong;
    weights.push_back(point.log_weight + log_of_all(likelier.data(), counts.data(), count));
    if (followed) weights.back() += MODEL.few * log_of(1 - point.wrong);
  }
  normalise(weights);

  for (std::size_t number = 0; number < weights.size(); ++number) {
    const Point &point = prior()[number];
    if (weights[number] < NEGLIGIBLE) continue;
    compare(point, answers, right.data());
    for (std::size_t answer = 0; answer < mean.size(); ++answer) {
      right[answer] /= point.wrong + right[answer];
      mean[answer] += weights[number] * right[answer];
      square[answer] += weights[number] * right[answer] * right[answer];
    }
  }

  Confidence sure{std::vector<float>(chances.size()), std::vector<float>(chances.size())};
  for (std::size_t answer = 0; answer < mean.size(); ++answer) {
    const std::size_t query = answers.queries[answer];
    const double has = mapped[query], of_all = has * mean[answer];
    sure.right[query] = static_cast<float>(of_all);
    sure.spread[query] =
        static_cast<float>(std::sqrt(std::max(0.0, has * square[answer] - of_all * of_all)));
  }
  return sure;
}

}  // namespace places
