// The live stream of loops.hpp, and the functions of ssrvlad_loops.h.

#include "loops.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <iterator>

#include "fusion.hpp"

namespace places {

namespace {
constexpr Size RECENT = 10;  // least age of an excluded frame that can be the present place
constexpr Size STRIDE = 50;  // the previous frame is one before where so many are excluded
constexpr std::size_t NEIGHBOURS = 1000;
constexpr double EVIDENCE = 3, LEVEL_FRACTION = 0.9;
constexpr double LEAST_PLACE = 0.01;

constexpr std::size_t FITS = 20, LEAST_FITS = 5;  // how well loops fit
constexpr double FIT = 0.5, FIT_WEIGHT = 2;

constexpr double REPEAT_MARGIN = 1.2;
constexpr Size DISTANT = 5;
constexpr std::size_t TRACK = 15;

constexpr float SMOOTHING = 0.93F;  // tracks
constexpr double EXPLAINED = 0.9;
constexpr float BY_CHANCE = 1.5F, CLEAR = 0.12F, SAME = 0.75F, LEAST_CLOSENESS = 0.02F;
constexpr std::size_t USUAL = 100, EARLIER = 1000, LEAST_BY_CHANCE = 5;
constexpr Size WAIT = 25, TRACKED = 50, BESIDE = 10;

constexpr double GAP = 600, TIMES = 10;  // stretches
constexpr Size LAST_FRAMES = 50, LEAST_FRAMES = 20, LAST = 3, APART = 10;
constexpr double LIKE = 0.5, SPREADS = 3;

constexpr Size LATEST = 50;  // large memories
constexpr double SAMPLED_PART = 0.04, CHOSEN_PART = 0.01;

constexpr Motion MOTION = {0.01, 0.01, 0.3, 0.97, 0.25, 0.5, 1};

std::size_t place(Size at) { return static_cast<std::size_t>(at); }

// The quantile between two values, as NumPy's.
double quantile(std::vector<double> values, double part) {
  const double at = part * static_cast<double>(values.size() - 1), whole = std::floor(at);
  const auto lower = values.begin() + static_cast<std::ptrdiff_t>(whole);
  std::nth_element(values.begin(), lower, values.end());
  if (lower + 1 == values.end()) return *lower;
  const double next = *std::min_element(lower + 1, values.end());
  return *lower + (next - *lower) * (at - whole);
}

template <class Number>
void keep(std::deque<Number> &values, Number value, std::size_t most) {
  values.push_back(value);
  if (values.size() > most) values.pop_front();
}

// How many deviations the nearest row is ahead of the nearest elsewhere; rows without a score are at the
// mean.
double lead(const float *near, Size count, const Spread &spread) {
  if (count <= 2 * MODEL.elsewhere + 1) return 0;
  std::vector<double> values(near, near + count);
  std::replace(values.begin(), values.end(), static_cast<double>(NONE), spread.mean);
  const auto [best, other] = leading(values.data(), count, [&](Size row) {
    return std::make_pair(std::max<Size>(0, row - MODEL.elsewhere), std::min(row + MODEL.elsewhere + 1, count));
  });
  return (best - other) / std::max(spread.deviation, MIN_SPREAD);
}

// Gives rows without nearness what their rough nearness lets expect: on the straight line through some
// rows whose nearness is known.
void expect(const std::vector<float> &rough, const std::vector<float> &known_rough,
            const std::vector<float> &near_of_rows, std::vector<float> &near) {
  const auto count = static_cast<Size>(near_of_rows.size());
  const Spread from = plain_spread(known_rough.data(), count), to = plain_spread(near_of_rows.data(), count);
  double both = 0;
  for (std::size_t row = 0; row < near_of_rows.size(); ++row)
    both += (static_cast<double>(known_rough[row]) - from.mean) *
            (static_cast<double>(near_of_rows[row]) - to.mean);
  const double least = std::max(from.deviation, MIN_SPREAD);
  const double slope = both / static_cast<double>(std::max<Size>(1, count)) / (least * least);
  for (std::size_t row = 0; row < near.size(); ++row)
    if (near[row] == NONE)
      near[row] = static_cast<float>(to.mean + slope * (static_cast<double>(rough[row]) - from.mean));
}

// How much likelier a frame is at rows than at a new place, by their nearness.
void likelihoods(const float *near, Size count, double weight, double level,
                 const Spread &spread, float *likely) {
  on_cpu([=, &spread](auto) {
    const double least = spread.mean + level * spread.deviation, factor = weight / spread.deviation;
    for (Size i = 0; i < count; ++i)
      likely[i] =
          static_cast<float>(exp_of(std::min((static_cast<double>(near[i]) - least) * factor, MODEL.most_log)));
  });
}

// How alike the last of some frames is to those just before it, by their cosines: 0 as different places,
// 1 as one frame and the next.
double likeness(const std::vector<double> &cosines, Size count) {
  const auto near = [&](Size one, Size other) { return nearness(cosines[place(one * count + other)]); };
  std::vector<double> others, steps;
  double step = -std::numeric_limits<double>::infinity(), sum = 0, squares = 0;
  for (Size row = 0; row + 1 < count; ++row)
    for (Size other = 0; other <= row - APART; ++other) others.push_back(near(row, other));
  for (Size row = 1; row + 1 < count; ++row) steps.push_back(near(row, row - 1));
  for (Size back = 1; back <= LAST; ++back) step = std::max(step, near(count - 1, count - 1 - back));
  for (const double value : others) sum += value;
  const double mean = sum / static_cast<double>(others.size()), elsewhere = median(others);
  for (const double value : others) squares += (value - mean) * (value - mean);
  const double deviation = std::sqrt(squares / static_cast<double>(others.size()));
  return (step - elsewhere) / std::max({median(steps) - elsewhere, SPREADS * deviation, ROUNDING});
}

bool is_gap(const std::deque<double> &stamps, double stamp) {
  std::vector<double> stamped, steps;
  std::copy_if(stamps.begin(), stamps.end(), std::back_inserter(stamped),
               [](double stamp_before) { return !std::isnan(stamp_before); });
  if (static_cast<Size>(stamped.size()) < LEAST_FRAMES || !(stamp - stamped.back() > GAP)) return false;
  for (std::size_t row = 1; row < stamped.size(); ++row) steps.push_back(stamped[row] - stamped[row - 1]);
  return stamp - stamped.back() > TIMES * median(steps);
}
}  // namespace

// ------------------------------------------------------------------------------------------- repeats

Repeats::Repeats(Size exclude) : nearest_(std::max<Size>(1, exclude / DISTANT)), farthest_(exclude) {}

void Repeats::after(const float *near, Size count) {
  highest_.resize(place(count + 1), NONE);
  const Size rows = std::max<Size>(0, std::min(farthest_, count) + 1 - nearest_);
  const Size first = count - nearest_;  // the row at the least distance; others come before it
  // as many distances as there are, and one that is beside the last
  const Size distances = std::max<Size>(0, std::min(farthest_ + 1 - nearest_, rows + 1));
  std::vector<float> seen(place(distances + 2), NONE), widest(place(distances));
  for (Size far = 0; far < rows; ++far) seen[place(far + 1)] = near[first - far];
  for (std::size_t far = 0; far < widest.size(); ++far)
    widest[far] = std::max({seen[far], seen[far + 1], seen[far + 2]});
  keep(last_, widest, TRACK);
  std::size_t shared = place(rows);
  for (const auto &row_of_distances : last_) shared = std::min(shared, row_of_distances.size());
  if (last_.size() < TRACK || !shared) return;
  std::vector<float> track(shared);
  for (const auto &row_of_distances : last_) add(track.data(), row_of_distances.data(), 1, static_cast<Size>(shared));
  for (float &value : track) value /= static_cast<float>(TRACK);
  const float most = *std::max_element(track.begin(), track.end());
  for (std::size_t back = 0; back < std::min(TRACK, highest_.size()); ++back) {
    float &high = highest_[highest_.size() - 1 - back];
    high = std::max(high, most);
  }
  for (Size age = 0; age < static_cast<Size>(TRACK); ++age)
    for (Size far = 0; far < static_cast<Size>(shared) && first - far >= age; ++far) {
      float &high = highest_[place(first - far - age)];
      high = std::max(high, track[place(far)]);
    }
}

// -------------------------------------------------------------------------------------------- tracks

Tracks::Tracks(Size exclude, bool alone) : exclude_(exclude), alone_(alone), since_(WAIT) {}

bool Tracks::tells() const { return by_chance_.size() >= LEAST_BY_CHANCE; }

float Tracks::step() const {
  const double usual = median(std::vector<float>(steps_.begin(), steps_.end())) -
                       median(std::vector<float>(others_.begin(), others_.end()));
  return std::max(LEAST_CLOSENESS, static_cast<float>(usual));
}

double Tracks::explained() const {
  if (!alone_ || !tells()) return 0;
  return quantile({by_chance_.begin(), by_chance_.end()}, EXPLAINED) * static_cast<double>(step());
}

void Tracks::after(const float *near, Size count, Size old) {
  std::vector<float> before(place(count));
  before.swap(closeness_);
  if (count < 2 * BESIDE || near[count - 1] == NONE) return;
  const std::vector<float> seen(near + std::max<Size>(0, count - TRACKED), near + count - BESIDE);
  keep(steps_, near[count - 1], USUAL);
  keep(others_, static_cast<float>(median(seen)), USUAL);
  const Spread spread = plain_spread(near, old);
  if (std::all_of(near, near + old, [](float value) { return value == NONE; })) return;
  const auto later = count - static_cast<Size>(before.size());
  const float usual = step();
  for (Size row = 0; row < count; ++row) {
    const float close = near[row] == NONE ? 0 : (near[row] - static_cast<float>(spread.mean)) / usual;
    closeness_[place(row)] = (row >= later ? SMOOTHING * before[place(row - later)] : 0) + (1 - SMOOTHING) * close;
  }
  closest_ = *std::max_element(closeness_.begin(), closeness_.begin() + old);
  densest_ = 0;
  for (Size row = old; row < count - exclude_ / 2; ++row)
    densest_ = std::max(densest_, closeness_[place(row)]);
}

void Tracks::decided(bool accepted) {
  held_ = returning() && !accepted ? held_ + 1 : 0;
  if (0 < held_ && held_ <= 2 * WAIT) return;
  const bool apart = accepted || densest_ >= SAME;
  since_ = apart ? 0 : since_ + 1;
  if (apart) waiting_.clear();
  if (apart || since_ <= WAIT || closest_ == 0) return;
  waiting_.push_back(closest_);
  if (static_cast<Size>(waiting_.size()) <= WAIT) return;
  keep(by_chance_, waiting_.front(), EARLIER);
  waiting_.pop_front();
}

bool Tracks::returning() const {
  if (alone_ || !tells()) return false;
  const float highest = *std::max_element(by_chance_.begin(), by_chance_.end());
  const bool is_clear = highest <= CLEAR && BY_CHANCE * highest <= closest_;
  return is_clear && densest_ <= closest_ && closest_ < SAME;
}

// -------------------------------------------------------------------------------------------- stream

Stream::Stream(const ssrvlad_loops_settings &settings, const ssrvlad_loops_channel *channels, int count)
    : exclude_(settings.exclude),
      threshold_(settings.threshold),
      scan_above_(settings.scan_above),
      leads_(static_cast<std::size_t>(count)),
      filter_(drives_, MOTION, {FORWARDS, BACKWARDS}),
      repeats_(exclude_),
      // label maps alone have tracks by chance as close as returns
      tracks_(exclude_, count == 1) {
  for (int number = 0; number < count; ++number) {
    const auto &[kind, shape, trust] = channels[number];
    if (kind == SSRVLAD_VECTORS) channels_.push_back(std::make_unique<LiveVectors>(shape[0]));
    else channels_.push_back(std::make_unique<LiveSigns>(shape[0], shape[1] * shape[2], shape[2]));
    trust_.push_back(trust);
  }
}

std::vector<double> Stream::weights() const {
  std::vector<double> weights;
  double sum = 0, trust = 0;
  for (std::size_t channel = 0; channel < leads_.size(); ++channel) {
    weights.push_back(trust_[channel] * leads_[channel]);
    sum += weights.back();
    trust += trust_[channel];
  }
  for (std::size_t channel = 0; channel < leads_.size(); ++channel)  // where none leads, trust decides
    weights[channel] = sum > 0 ? weights[channel] / sum : trust_[channel] / trust;
  return weights;
}

bool Stream::breaks(const void *const *centres, double stamp) const {
  if (!is_gap(stamps_, stamp)) return false;
  const Size before = static_cast<Size>(stamps_.size()), count = before + 1;
  double sum = 0;
  for (std::size_t number = 0; number < channels_.size(); ++number) {
    const LiveChannel &channel = *channels_[number];
    std::vector<std::uint8_t> frames(place(count * channel.bytes()));
    channel.copy(rows() - before, rows(), frames.data());
    std::memcpy(frames.data() + before * channel.bytes(), centres[number], place(channel.bytes()));
    const auto frame = [&](Size row) { return frames.data() + row * channel.bytes(); };
    std::vector<double> cosines(place(count * count));
    for (Size one = 0; one < count; ++one)
      for (Size other = 0; other < one; ++other)
        cosines[place(one * count + other)] = channel.cosine(frame(one), frame(other));
    sum += likeness(cosines, count);
  }
  return sum / static_cast<double>(channels_.size()) < LIKE;
}

void Stream::start_stretch() {
  for (auto &channel : channels_) channel->start_stretch();
  if (!starts_.empty()) explained_.push_back(tracks_.explained());
  starts_.push_back(rows());
  stamps_.clear();
  neighbours_.clear();
  fits_.clear();
  repeats_ = Repeats(exclude_);
  tracks_ = Tracks(exclude_, channels_.size() == 1);
  grow();
  belief_ = filter_.start(drives_.all());
  probable_ = belief_.of_rows();
  starting_ = true;
}

Size Stream::without_last(Size frames) const { return std::max(starts_.back(), rows() - frames); }

void Stream::grow() {
  const Size last = without_last(std::min(RECENT, exclude_));
  for (; drives_.rows < last; ++drives_.rows)
    if (std::binary_search(starts_.begin(), starts_.end(), drives_.rows))
      drives_.starts.push_back(drives_.rows);
}

void Stream::enlarge() {
  if (!large_.empty() || rows() - exclude_ <= scan_above_) return;
  for (std::size_t number = 0; number < channels_.size(); ++number)
    if (auto large = channels_[number]->large()) {
      channels_[number] = std::move(large);
      large_.push_back(number);
    }
}

void Stream::store(const void *const *centres, double stamp) {
  described_.push_back(!channels_[0]->empty(centres[0]));
  known_ += described_.back();
  keep(stamps_, stamp, place(LAST_FRAMES));
}

void Stream::extend(const void *const *descriptors, double stamp, bool starts) {
  if (starts_.empty() || starts || breaks(descriptors, stamp)) start_stretch();
  grow();
  enlarge();
  store(descriptors, stamp);
  for (std::size_t number = 0; number < channels_.size(); ++number)
    channels_[number]->extend(descriptors[number]);
}

ssrvlad_loop Stream::update(const void *const *descriptors, const Size *anchors, double stamp,
                            bool starts, int threads) {
  std::vector<const void *> centres;
  for (std::size_t number = 0; number < channels_.size(); ++number) {
    const Size middle = anchors ? anchors[number] / 2 : 0;
    centres.push_back(static_cast<const std::uint8_t *>(descriptors[number]) +
                      middle * channels_[number]->bytes());
  }
  if (starts_.empty() || starts || breaks(centres.data(), stamp)) start_stretch();
  grow();
  enlarge();
  const ssrvlad_loop loop = step(descriptors, centres.data(), anchors, threads);
  store(centres.data(), stamp);
  for (std::size_t number = 0; number < channels_.size(); ++number)
    channels_[number]->append(centres[number]);
  return loop;
}

ssrvlad_loop Stream::step(const void *const *swept, const void *const *centres, const Size *anchors,
                          int threads) {
  ssrvlad_loop none{};
  none.candidate = -1;
  none.reason = SSRVLAD_EMPTY_FRAME;
  for (const Size old = without_last(exclude_); old_ < old; ++old_)
    old_known_ += described_[place(old_)];
  const bool empty = channels_[0]->empty(centres[0]), too_few = old_known_ < 2;
  if (empty) {
    if (!too_few) filter(std::vector<float>(place(drives_.rows), 1.0F));
    return none;
  }
  none.reason = known_ ? SSRVLAD_TOO_RECENT : SSRVLAD_NO_CANDIDATE;
  if (!known_) return none;
  std::vector<float> scored = scores(swept, anchors, threads, too_few ? 0 : old_);
  for (std::size_t row = 0; row < scored.size(); ++row)
    if (!described_[row]) scored[row] = NONE;
  std::vector<float> near(scored.size());
  nearness(scored.data(), rows(), near.data());
  repeats_.after(near.data() + starts_.back(), rows() - starts_.back());
  if (too_few) return none;
  const std::vector<float> usual_near = usual(near, old_);
  const Spread spread = Spread::of(usual_near.data(), static_cast<Size>(usual_near.size()));
  filter(likelihood(near, spread));
  const ssrvlad_loop loop = result(scored);
  if (loop.reason == SSRVLAD_ACCEPTED && spread.deviation > MIN_SPREAD)
    keep(fits_, spread.z(near[place(loop.candidate)]), FITS);
  return loop;
}

// Scores of a frame by all channels, scaled by those of the old frames, if there are any.
std::vector<float> Stream::scores(const void *const *swept, const Size *anchors, int threads, Size old) {
  std::vector<std::vector<float>> near(channels_.size());
  std::vector<float> scores(place(rows())), fused(scores.size(), NONE);
  std::vector<Spread> spreads;
  const Size counted = old ? old : rows();
  Chosen chosen;
  const auto score = [&](std::size_t number) {
    channels_[number]->scores(swept[number], anchors ? anchors[number] : 1, threads, chosen,
                              scores.data());
  };
  if (channels_.size() == 1 && large_.empty()) return score(0), scores;
  std::vector<std::vector<float>> rough(large_.size());
  for (std::size_t large = 0; large < large_.size(); ++large) {
    score(large_[large]);
    rough[large].resize(scores.size());
    nearness(scores.data(), rows(), rough[large].data());
  }
  for (const auto &near_roughly : rough) choose(near_roughly, counted, chosen);
  for (std::size_t number = 0; number < channels_.size(); ++number) {
    score(number);
    near[number].resize(scores.size());
    nearness(scores.data(), rows(), near[number].data());
    const std::vector<float> usual_near = usual(near[number], counted);
    spreads.push_back(plain_spread(usual_near.data(), static_cast<Size>(usual_near.size())));
    const auto large = std::find(large_.begin(), large_.end(), number) - large_.begin();
    if (large < static_cast<std::ptrdiff_t>(large_.size())) {
      expect(rough[place(large)], usual(rough[place(large)], counted), usual_near, near[number]);
      scores = rough[place(large)];  // of every row
    }
    leads_[number] += std::max(0.0, lead(near[number].data(), old, spreads.back()));
    for (std::size_t row = 0; row < fused.size(); ++row) fused[row] = std::max(fused[row], scores[row]);
  }
  std::vector<double> z(scores.size());
  double mean = 0, deviation = 0;
  const std::vector<double> weight = weights();
  for (std::size_t number = 0; number < channels_.size(); ++number) {
    const auto [usual_mean, spread] = spreads[number];
    add_scaled(near[number].data(), rows(), usual_mean, weight[number] / std::max(spread, MIN_SPREAD),
               z.data());
    mean += weight[number] * usual_mean;
    deviation += weight[number] * spread;
  }
  as_cosines(z.data(), rows(), mean, deviation, fused.data());
  return fused;
}

Size Stream::stride(Size old) const {
  if (large_.empty()) return 1;
  const double most = std::max<double>(LATEST, SAMPLED_PART * static_cast<double>(scan_above_));
  return std::max<Size>(1, static_cast<Size>(std::ceil(static_cast<double>(old) / most)));
}

std::vector<float> Stream::usual(const std::vector<float> &near, Size old) const {
  std::vector<float> usual_near;
  for (Size row = 0, step = stride(old); row < old; row += step) usual_near.push_back(near[place(row)]);
  return usual_near;
}

// Chooses the nearest rows by the rough scores of a channel, the last ones, a sample, and those that are
// more probable than by guessing, and their neighbours.
void Stream::choose(const std::vector<float> &rough, Size old, Chosen &chosen) const {
  const std::vector<float> usual_near = usual(rough, old);
  const double least = quantile({usual_near.begin(), usual_near.end()}, 1 - CHOSEN_PART);
  chosen.resize(rough.size());
  for (std::size_t row = 0; row < rough.size(); ++row)
    chosen[row] |= static_cast<double>(rough[row]) >= least;
  for (Size row = 0; row < old; row += stride(old)) chosen[place(row)] = 1;
  const auto mark = [&](Size first, Size last) {
    std::fill(chosen.begin() + std::max<Size>(0, first), chosen.begin() + std::min(last, rows()), 1);
  };
  mark(std::min(old, rows() - LATEST), rows());
  for (std::size_t row = 0; row < probable_.size(); ++row)
    if (static_cast<double>(probable_[row]) * static_cast<double>(drives_.rows) > 1)
      mark(static_cast<Size>(row) - SSRVLAD_RADIUS, static_cast<Size>(row) + SSRVLAD_RADIUS + 1);
}

// How likely a frame of another stretch is: once some loops show how well the right rows fit, a row that
// fits half as well is as likely as a new place. Label maps alone fit too unevenly.
Stream::Fit Stream::fit() const {
  const bool enough = channels_.size() > 1 && fits_.size() >= LEAST_FITS;
  const double level = enough ? FIT * median(std::vector<double>(fits_.begin(), fits_.end())) : 0;
  if (level <= MOTION.level) return {MOTION.weight, MOTION.level};
  return {FIT_WEIGHT * MOTION.weight, level};
}

// How much likelier a frame is at each row than at a new place. The level of rows of the same stretch is
// the higher, the more alike neighbouring frames are and the more their street repeats.
std::vector<float> Stream::likelihood(const std::vector<float> &near, const Spread &spread) {
  std::vector<float> likely(near.size(), 1.0F);
  if (spread.deviation <= MIN_SPREAD) return likely;
  const Size start = starts_.back(), count = rows() - start,
             candidates = std::max<Size>(0, count - exclude_);
  const Size previous = count - std::max<Size>(1, exclude_ / STRIDE);
  if (previous >= 0 && near[place(start + previous)] != NONE)
    keep(neighbours_, spread.z(near[place(start + previous)]), NEIGHBOURS);
  const double usual =
      neighbours_.empty() ? 0.0 : quantile({neighbours_.begin(), neighbours_.end()}, 0.25);
  const double by_chance = std::sqrt(2 * log_of(static_cast<double>(std::max<Size>(2, rows()))));
  const double level = std::max({MOTION.level, LEVEL_FRACTION * usual, by_chance});
  const double weight = EVIDENCE / level;
  tracks_.after(near.data() + start, count, candidates);
  const Fit fits = fit();
  for (std::size_t stretch = 0; stretch < explained_.size(); ++stretch) {
    const double explained = std::max(fits.level, explained_[stretch] / spread.deviation);
    const Size first = starts_[stretch], count = starts_[stretch + 1] - first;
    likelihoods(near.data() + first, count, fits.weight, explained, spread, likely.data() + first);
  }
  likelihoods(near.data() + start, candidates, fits.weight, fits.level, spread, likely.data() + start);
  const bool is_returning = tracks_.returning();
  std::vector<float> same(place(count));
  likelihoods(near.data() + start, count, weight, level, spread, same.data());
  for (Size row = 0; row < count; ++row) {
    float &here = likely[place(start + row)];
    const float others = here;
    here = same[place(row)];
    if (row >= candidates) continue;
    const double repeats = (static_cast<double>(repeats_.highest()[place(row)]) - spread.mean) *
                               (REPEAT_MARGIN / spread.deviation) -
                           level;
    if (repeats > 0) here *= static_cast<float>(exp_of(-weight * repeats));
    if (is_returning) here = std::max(here, others);
  }
  return likely;
}

void Stream::filter(std::vector<float> likely) {
  likely.resize(place(drives_.rows));
  const Rows rows = drives_.all();
  belief_ = starting_ ? filter_.extended(belief_, rows) : filter_.predicted(belief_, rows);
  filter_.update(belief_, {std::move(likely), 0});
  probable_ = belief_.of_rows();
  starting_ = false;
}

ssrvlad_loop Stream::result(const std::vector<float> &scored) {
  std::vector<float> rows = probable_;
  Size candidate = -1;
  for (Size row = 0; row < old_; ++row)
    if (scored[place(row)] != NONE && (candidate < 0 || rows[place(row)] > rows[place(candidate)]))
      candidate = row;
  const double old = sum(rows.data(), old_), recent = sum(rows.data() + old_, drives_.rows - old_);
  const auto near = [&](Size row) {
    return std::make_pair(std::max<Size>(0, row - SSRVLAD_RADIUS), std::min(row + SSRVLAD_RADIUS + 1, old_));
  };
  const auto [first, last] = near(candidate);
  ssrvlad_loop loop{};
  loop.candidate = candidate;
  loop.score = static_cast<double>(scored[place(candidate)]);
  loop.probability = std::min(1.0, sum(rows.data() + first, last - first));
  const Size drive = drives_.of(candidate);
  loop.first = std::max(first, drives_.starts[place(drive)]);
  loop.rows = static_cast<std::int32_t>(std::min(last, drives_.last(drive)) - loop.first);
  for (Size row = 0; row < loop.rows; ++row)
    loop.probabilities[row] = static_cast<double>(rows[place(loop.first + row)]);
  loop.reason = SSRVLAD_BELOW_THRESHOLD;
  if (loop.probability >= threshold_) loop.reason = SSRVLAD_ACCEPTED;
  else if (recent > std::max(old, 1 - old - recent)) loop.reason = SSRVLAD_TOO_RECENT;
  else if (old >= threshold_) loop.reason = SSRVLAD_AMBIGUOUS;
  tracks_.decided(loop.reason == SSRVLAD_ACCEPTED);
  for (Size row = candidate; loop.places < SSRVLAD_PLACES; ++loop.places) {
    const auto [from, to] = near(row);
    const double probability = std::min(1.0, sum(rows.data() + from, to - from));
    if (probability < LEAST_PLACE) break;
    loop.best[loop.places] = {row, probability};
    std::fill(rows.begin() + from, rows.begin() + to, 0.0F);
    row = std::max_element(rows.begin(), rows.begin() + old_) - rows.begin();
  }
  return loop;
}

}  // namespace places
