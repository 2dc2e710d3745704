// A live stream: has this place been seen before? The functions of ssrvlad_loops.h. tests/oracles/loops.py says the
// same plainly, and model.hpp what its constants mean.

#include <algorithm>
#include <cmath>
#include <cstring>
#include <deque>
#include <iterator>

#include "filter.hpp"
#include "fusion.hpp"
#include "interface.hpp"
#include "live.hpp"
#include "ssrvlad_loops.h"

namespace places {

namespace {
constexpr std::uint8_t NEAREST = 2;  // chosen so: these rows do not show what is usual

constexpr Motion MOTION = {LOOPS.change, MODEL.jump, LOOPS.unmapped, LOOPS.stay, LOOPS.weight, MODEL.level, 1};

// The quantile between two values, as NumPy's.
double quantile(std::vector<double> values, double part) {
  const double at = part * static_cast<double>(values.size() - 1), whole = std::floor(at);
  const auto lower = values.begin() + static_cast<std::ptrdiff_t>(whole);
  std::nth_element(values.begin(), lower, values.end());
  if (lower + 1 == values.end()) return *lower;
  const double next = *std::min_element(lower + 1, values.end());
  return *lower + (next - *lower) * (at - whole);
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
            const std::vector<float> &known_near, std::vector<float> &near) {
  const auto fitted = std::count_if(known_near.begin(), known_near.end(), [](float value) { return value != NONE; });
  const auto count = static_cast<Size>(known_near.size());
  const Spread from = plain_spread(known_rough.data(), count), to = plain_spread(known_near.data(), count);
  double both = 0;
  for (std::size_t row = 0; row < known_near.size(); ++row)
    if (known_near[row] != NONE)
      both += (static_cast<double>(known_rough[row]) - from.mean) * (static_cast<double>(known_near[row]) - to.mean);
  const double least = std::max(from.deviation, MIN_SPREAD);
  const double slope = both / static_cast<double>(std::max<Size>(1, static_cast<Size>(fitted))) / (least * least);
  for (std::size_t row = 0; row < near.size(); ++row)
    if (near[row] == NONE)
      near[row] = static_cast<float>(to.mean + slope * (static_cast<double>(rough[row]) - from.mean));
}

// How alike the last of some frames is to those just before it, by their cosines: 0 as different places,
// 1 as one frame and the next.
double likeness(const std::vector<double> &cosines, Size count) {
  const auto near = [&](Size one, Size other) { return nearness(cosines[one * count + other]); };
  std::vector<double> others, steps;
  double step = -std::numeric_limits<double>::infinity(), sum = 0, squares = 0;
  for (Size row = 0; row + 1 < count; ++row)
    for (Size other = 0; other <= row - MODEL.elsewhere; ++other) others.push_back(near(row, other));
  for (Size row = 1; row + 1 < count; ++row) steps.push_back(near(row, row - 1));
  for (Size back = 1; back <= MODEL.near; ++back) step = std::max(step, near(count - 1, count - 1 - back));
  for (const double value : others) sum += value;
  const double mean = sum / static_cast<double>(others.size()), elsewhere = median(others);
  for (const double value : others) squares += (value - mean) * (value - mean);
  const double deviation = std::sqrt(squares / static_cast<double>(others.size()));
  return (step - elsewhere) / std::max({median(steps) - elsewhere, LOOPS.spreads * deviation, ROUNDING});
}

bool is_gap(const std::deque<double> &stamps, double stamp) {
  std::vector<double> stamped, steps;
  std::copy_if(stamps.begin(), stamps.end(), std::back_inserter(stamped),
               [](double stamp_before) { return !std::isnan(stamp_before); });
  if (static_cast<Size>(stamped.size()) < MODEL.min_frames || !(stamp - stamped.back() > LOOPS.gap)) return false;
  for (std::size_t row = 1; row < stamped.size(); ++row) steps.push_back(stamped[row] - stamped[row - 1]);
  return stamp - stamped.back() > LOOPS.gap_steps * median(steps);
}

// How self-similar the street is around each frame of a stretch, from frames too recent to be loops.
class Repeats {
 public:
  explicit Repeats(Size exclude) : nearest_(std::max<Size>(1, exclude / LOOPS.distant)), farthest_(exclude) {}

  void reserve(Size frames) { highest_.reserve(frames); }

  void start_stretch() {
    last_.clear();
    highest_.clear();
  }

  // Takes the nearness of the next frame to all earlier ones of the stretch.
  void after(const float *near, Size count) {
    highest_.resize(count + 1, NONE);
    const Size rows = std::max<Size>(0, std::min(farthest_, count) + 1 - nearest_);
    const Size first = count - nearest_;  // the row at the least distance; others come before it
    // as many distances as there are, and one that is beside the last
    const Size distances = std::max<Size>(0, std::min(farthest_ + 1 - nearest_, rows + 1));
    std::vector<float> seen(distances + 2, NONE), widest(distances);
    for (Size far = 0; far < rows; ++far) seen[far + 1] = near[first - far];
    for (std::size_t far = 0; far < widest.size(); ++far)
      widest[far] = std::max({seen[far], seen[far + 1], seen[far + 2]});
    push(last_, widest, LOOPS.track);
    std::size_t shared = rows;
    for (const auto &row_of_distances : last_) shared = std::min(shared, row_of_distances.size());
    if (static_cast<Size>(last_.size()) < LOOPS.track || !shared) return;
    std::vector<float> track(shared);
    for (const auto &row_of_distances : last_) add(track.data(), row_of_distances.data(), 1, static_cast<Size>(shared));
    for (float &value : track) value /= static_cast<float>(LOOPS.track);
    const float most = *std::max_element(track.begin(), track.end());
    for (Size row = std::max<Size>(0, count + 1 - LOOPS.track); row <= count; ++row)
      highest_[row] = std::max(highest_[row], most);
    for (Size age = 0; age < LOOPS.track; ++age)
      for (Size far = 0; far < static_cast<Size>(shared) && first - far >= age; ++far) {
        float &high = highest_[first - far - age];
        high = std::max(high, track[far]);
      }
  }

  // Of the earlier frames; NONE where nothing is known.
  const std::vector<float> &highest() const { return highest_; }

 private:
  Size nearest_, farthest_;
  std::deque<std::vector<float>> last_;
  std::vector<float> highest_;
};

// How closely the frames of a stretch before each earlier frame run beside the last ones.
class Tracks {
 public:
  // By label maps alone, tracks by chance are as close as those of returns.
  Tracks(Size exclude, bool alone) : exclude_(exclude), alone_(alone), since_(LOOPS.wait) {}

  void reserve(Size frames) {
    closeness_.reserve(frames);
    before_.reserve(frames);
  }

  void start_stretch() {
    Tracks fresh(exclude_, alone_);
    fresh.closeness_.swap(closeness_), fresh.closeness_.clear();
    fresh.before_.swap(before_);
    *this = std::move(fresh);
  }

  // Takes the nearness of the next frame to all earlier ones of the stretch, of which the first are old.
  void after(const float *near, Size count, Size old) {
    before_.swap(closeness_);
    closeness_.assign(count, 0);
    if (count < 2 * MODEL.elsewhere || near[count - 1] == NONE) return;
    const std::vector<float> seen(near + std::max<Size>(0, count - LOOPS.usual), near + count - MODEL.elsewhere);
    push(steps_, near[count - 1], LOOPS.usual);
    push(others_, static_cast<float>(median(seen)), LOOPS.usual);
    const Spread spread = plain_spread(near, old);
    if (std::all_of(near, near + old, [](float value) { return value == NONE; })) return;
    const auto later = count - static_cast<Size>(before_.size());
    const float usual = step();
    for (Size row = 0; row < count; ++row) {
      const float close = near[row] == NONE ? 0 : (near[row] - static_cast<float>(spread.mean)) / usual;
      closeness_[row] = (row >= later ? LOOPS.smoothing * before_[row - later] : 0) + (1 - LOOPS.smoothing) * close;
    }
    closest_ = *std::max_element(closeness_.begin(), closeness_.begin() + old);
    densest_ = 0;
    for (Size row = old; row < count - exclude_ / 2; ++row)
      densest_ = std::max(densest_, closeness_[row]);
  }

  // Takes whether the frame closes a loop: tracks around one are not by chance, nor are those of a camera
  // that stands, nor is, for a while, a return that may still become a loop.
  void decided(bool accepted) {
    held_ = returning() && !accepted ? held_ + 1 : 0;
    if (0 < held_ && held_ <= 2 * LOOPS.wait) return;
    const bool apart = accepted || densest_ >= LOOPS.same;
    since_ = apart ? 0 : since_ + 1;
    if (apart) waiting_.clear();
    if (apart || since_ <= LOOPS.wait || closest_ == 0) return;
    waiting_.push_back(closest_);
    if (static_cast<Size>(waiting_.size()) <= LOOPS.wait) return;
    push(by_chance_, waiting_.front(), LOOPS.memory);
    waiting_.pop_front();
  }

  // Whether the last frames run beside old ones in another light.
  bool returning() const {
    if (alone_ || !tells()) return false;
    const float highest = *std::max_element(by_chance_.begin(), by_chance_.end());
    const bool is_clear = highest <= LOOPS.clear && LOOPS.by_chance * highest <= closest_;
    return is_clear && densest_ <= closest_ && closest_ < LOOPS.same;
  }

  // How much nearer than the mean an old frame can be at a new place; 0 where that is not known.
  double explained() const {
    if (!alone_ || !tells()) return 0;
    return quantile({by_chance_.begin(), by_chance_.end()}, LOOPS.explained) * static_cast<double>(step());
  }

 private:
  // Whether enough tracks by chance were seen.
  bool tells() const { return static_cast<Size>(by_chance_.size()) >= LOOPS.least_known; }

  // How much nearer than different places a frame is to the next.
  float step() const {
    const double usual = median(std::vector<float>(steps_.begin(), steps_.end())) -
                         median(std::vector<float>(others_.begin(), others_.end()));
    return static_cast<float>(std::max(MODEL.rounding, usual));
  }

  Size exclude_;
  bool alone_;
  std::vector<float> closeness_, before_;
  std::deque<float> steps_, others_, waiting_, by_chance_;
  Size since_, held_ = 0;
  float closest_ = 0, densest_ = 0;  // of old frames, and of the older half of the excluded ones
};

class Stream {
 public:
  Stream(const ssrvlad_loops_settings &settings, const ssrvlad_loops_channel *channels, int count)
      : exclude_(settings.exclude),
        threshold_(settings.threshold),
        scan_above_(settings.scan_above),
        leads_(count),
        filter_(drives_, MOTION, {FORWARDS, BACKWARDS}),
        repeats_(exclude_),
        // label maps alone have tracks by chance as close as returns
        tracks_(exclude_, count == 1) {
    for (int number = 0; number < count; ++number) {
      channels_.push_back(channel_of(channels[number]));
      trust_.push_back(channels[number].trust);
      if (channels_.back()->has_part()) rough_.push_back(number);
    }
    of_rows_.of_channels.resize(channels_.size());
    of_rows_.rough.resize(channels_.size());
  }

  Stream(const Stream &) = delete;

  Size rows() const { return static_cast<Size>(described_.size()); }
  const std::vector<std::unique_ptr<LiveChannel>> &channels() const { return channels_; }

  ssrvlad_loop update(const void *const *descriptors, const Size *anchors, double stamp, bool starts, int threads) {
    std::vector<const void *> centres;
    for (std::size_t number = 0; number < channels_.size(); ++number) {
      const Size middle = anchors ? anchors[number] / 2 : 0;
      centres.push_back(static_cast<const std::uint8_t *>(descriptors[number]) + middle * channels_[number]->bytes());
    }
    append(centres.data(), stamp, starts);
    const ssrvlad_loop loop = step(descriptors, centres.data(), anchors, threads);
    store(centres.data(), stamp, loop.reason == SSRVLAD_ACCEPTED ? shown_[loop.candidate] : rows());
    return loop;
  }

  void extend(const void *const *descriptors, double stamp, bool starts) {
    append(descriptors, stamp, starts);
    store(descriptors, stamp, rows());
  }

  // Memory for so many frames: no step asks for more that grows with their number.
  void reserve(Size frames) {
    for (auto &channel : channels_) channel->reserve(frames);
    described_.reserve(frames);
    shown_.reserve(frames);
    repeats_.reserve(frames);
    tracks_.reserve(frames);
    OfRows &all = of_rows_;
    for (auto *numbers : {&all.scores, &all.fused, &all.near, &all.usual, &all.same}) numbers->reserve(frames);
    for (auto *numbers : {&all.left, &all.likelihood.rows, &probable_}) numbers->reserve(frames);
    for (auto *by_channel : {&all.of_channels, &all.rough})
      for (auto &numbers : *by_channel) numbers.reserve(frames);
    for (auto *states : {&all.belief, &belief_.mapped}) states->reserve(2 * SPEEDS * frames);
    all.z.reserve(frames);
    all.chosen.reserve(frames);
  }

  // After frames that are known: the next one is then as quick as others.
  void settle() {
    Chosen &chosen = of_rows_.chosen;
    chosen.assign(rows(), 0);
    for (Size row = 0; row < rows(); row += stride(rows())) chosen[row] = 1;
    for (auto &channel : channels_) channel->settle(chosen);
  }

  std::vector<double> weights() const { return weights_of(trust_, leads_); }

 private:
  struct Fit {
    double weight, level;
  };

  bool breaks(const void *const *centres, double stamp) const {
    if (!is_gap(stamps_, stamp)) return false;
    const Size before = static_cast<Size>(stamps_.size()), count = before + 1;
    double sum = 0;
    for (std::size_t number = 0; number < channels_.size(); ++number) {
      const LiveChannel &channel = *channels_[number];
      std::vector<std::uint8_t> frames(count * channel.bytes());
      channel.copy(rows() - before, rows(), frames.data());
      std::memcpy(frames.data() + before * channel.bytes(), centres[number], channel.bytes());
      const auto frame = [&](Size row) { return frames.data() + row * channel.bytes(); };
      std::vector<double> cosines(count * count);
      for (Size one = 0; one < count; ++one)
        for (Size other = 0; other < one; ++other)
          cosines[one * count + other] = channel.cosine(frame(one), frame(other));
      sum += likeness(cosines, count);
    }
    return sum / static_cast<double>(channels_.size()) < LOOPS.like;
  }

  void start_stretch() {
    for (auto &channel : channels_) channel->start_stretch();
    if (!starts_.empty()) explained_.push_back(tracks_.explained());
    starts_.push_back(rows());
    stamps_.clear();
    neighbours_.clear();
    fits_.clear();
    repeats_.start_stretch();
    tracks_.start_stretch();
    grow();
    belief_ = filter_.start(drives_.all(), std::move(belief_.mapped));
    probable_ = belief_.of_rows(std::move(probable_));
    starting_ = true;
  }

  // The rows but so many last frames of the present stretch: those of others are never recent.
  Size without_last(Size frames) const { return std::max(starts_.back(), rows() - frames); }

  // States of the filter, one for each frame but the most recent.
  void grow() {
    const Size last = without_last(std::min(MODEL.elsewhere, exclude_));
    for (; drives_.rows < last; ++drives_.rows)
      if (std::binary_search(starts_.begin(), starts_.end(), drives_.rows)) drives_.starts.push_back(drives_.rows);
  }

  void append(const void *const *centres, double stamp, bool starts) {
    if (starts_.empty() || starts || breaks(centres, stamp)) start_stretch();
    grow();
    for (std::size_t number = 0; number < channels_.size(); ++number) channels_[number]->append(centres[number]);
  }

  void store(const void *const *centres, double stamp, Size shown) {
    shown_.push_back(shown);
    described_.push_back(!channels_[0]->empty(centres[0]));
    known_ += described_.back();
    push(stamps_, stamp, LOOPS.usual);
  }

  ssrvlad_loop step(const void *const *swept, const void *const *centres, const Size *anchors, int threads) {
    ssrvlad_loop none{};
    none.candidate = -1;
    none.reason = SSRVLAD_EMPTY_FRAME;
    for (const Size old = without_last(exclude_); old_ < old; ++old_) old_known_ += described_[old_];
    const bool empty = channels_[0]->empty(centres[0]), too_few = old_known_ < 2;
    if (empty) {
      of_rows_.likelihood.rows.assign(drives_.rows, 1.0F);
      if (!too_few) filter();
      return none;
    }
    none.reason = known_ ? SSRVLAD_TOO_RECENT : SSRVLAD_NO_CANDIDATE;
    if (!known_) return none;
    std::vector<float> &scored = scores(swept, anchors, threads, too_few ? 0 : old_);
    for (std::size_t row = 0; row < scored.size(); ++row)
      if (!described_[row]) scored[row] = NONE;
    std::vector<float> &near = of_rows_.near;
    near.resize(scored.size());
    nearness(scored.data(), rows(), near.data());
    repeats_.after(near.data() + starts_.back(), rows() - starts_.back());
    if (too_few) return none;
    usual(near, old_, of_rows_.usual);
    const Spread spread = Spread::of(of_rows_.usual.data(), static_cast<Size>(of_rows_.usual.size()));
    compute_likelihood(spread);
    filter();
    const ssrvlad_loop loop = result(scored);
    if (loop.reason == SSRVLAD_ACCEPTED && spread.deviation > MIN_SPREAD)
      push(fits_, spread.z(near[loop.candidate]), LOOPS.fits);
    return loop;
  }

  // Scores of a frame by all channels, scaled by those of the old frames, if there are any.
  std::vector<float> &scores(const void *const *swept, const Size *anchors, int threads, Size old) {
    auto &scores = of_rows_.scores, &fused = of_rows_.fused, &usual_near = of_rows_.usual,
         &rough_usual = of_rows_.rough_usual;
    auto &near = of_rows_.of_channels, &rough = of_rows_.rough;
    auto &z = of_rows_.z;
    auto &chosen = of_rows_.chosen;
    scores.resize(rows());
    fused.resize(scores.size());
    chosen.clear();
    std::vector<Spread> spreads;
    const Size counted = old ? old : rows();
    const auto score = [&](std::size_t number) {
      channels_[number]->scores(swept[number], anchors ? anchors[number] : 1, threads, chosen, scores.data());
    };
    const bool is_rough = stride(counted) > 1;
    if (channels_.size() == 1 && !is_rough) return score(0), scores;
    for (const std::size_t number : rough_) {
      if (!is_rough) continue;
      channels_[number]->rough_scores(threads, scores.data());
      rough[number].resize(scores.size());
      nearness(scores.data(), rows(), rough[number].data());
      choose(rough[number], counted);
    }
    for (std::size_t number = 0; number < channels_.size(); ++number) {
      score(number);
      near[number].resize(scores.size());
      nearness(scores.data(), rows(), near[number].data());
      usual(near[number], counted, usual_near);
      spreads.push_back(plain_spread(usual_near.data(), static_cast<Size>(usual_near.size())));
      if (is_rough && channels_[number]->has_part()) {
        usual(rough[number], counted, rough_usual);
        expect(rough[number], rough_usual, usual_near, near[number]);
      }
      leads_[number] += std::max(0.0, lead(near[number].data(), old, spreads.back()));
    }
    fuse(near, spreads, weights(), z, fused.data());
    return fused;
  }

  // Between old rows that show what is usual, and are compared anyhow. A power of two: as frames come, these stay.
  Size stride(Size old) const {
    Size stride = 1;
    while (!rough_.empty() && old / stride > scan_above_) stride *= 2;
    return stride;
  }

  // The nearness of these.
  void usual(const std::vector<float> &near, Size old, std::vector<float> &usual) const {
    usual.clear();
    const Chosen &chosen = of_rows_.chosen;
    for (Size row = 0, step = stride(old); row < old; row += step)
      usual.push_back(step > 1 && chosen[row] & NEAREST ? NONE : near[row]);
  }

  // Chooses the nearest rows by the rough scores of a channel, the last ones, a sample, and those that are
  // more probable than by guessing, and their neighbours.
  void choose(const std::vector<float> &rough, Size old) {
    Chosen &chosen = of_rows_.chosen;
    std::vector<double> sample;
    for (Size row = 0; row < old; row += stride(old)) sample.push_back(static_cast<double>(rough[row]));
    const double least = quantile(std::move(sample), 1 - LOOPS.chosen);
    chosen.resize(rough.size());
    for (std::size_t row = 0; row < rough.size(); ++row)
      if (static_cast<double>(rough[row]) >= least) chosen[row] |= NEAREST;
    for (Size row = 0; row < old; row += stride(old)) chosen[row] |= 1;
    const auto mark = [&](Size first, Size last) {
      for (Size row = std::max<Size>(0, first); row < std::min(last, rows()); ++row) chosen[row] |= 1;
    };
    mark(std::min(old, rows() - LOOPS.usual), rows());
    for (std::size_t row = 0; row < probable_.size(); ++row)
      if (static_cast<double>(probable_[row]) * static_cast<double>(drives_.rows) > 1)
        mark(static_cast<Size>(row) - SSRVLAD_RADIUS, static_cast<Size>(row) + SSRVLAD_RADIUS + 1);
  }

  // How likely a frame of another stretch is: once some loops show how well the right rows fit, a row that
  // fits half as well is as likely as a new place. Label maps alone fit too unevenly.
  Fit fit() const {
    const bool enough = channels_.size() > 1 && static_cast<Size>(fits_.size()) >= LOOPS.least_known;
    const double level = enough ? LOOPS.fit * median(std::vector<double>(fits_.begin(), fits_.end())) : 0;
    if (level <= MOTION.level) return {MOTION.weight, MOTION.level};
    return {LOOPS.fit_weight * MOTION.weight, level};
  }

  // How much likelier a frame is at each row than at a new place. The level of rows of the same stretch is
  // the higher, the more alike neighbouring frames are and the more their street repeats.
  void compute_likelihood(const Spread &spread) {
    const std::vector<float> &near = of_rows_.near;
    Floats &likely = of_rows_.likelihood.rows;
    std::vector<float> &same = of_rows_.same;
    likely.assign(near.size(), 1.0F);
    if (spread.deviation <= MIN_SPREAD) return;
    const Size start = starts_.back(), count = rows() - start, candidates = std::max<Size>(0, count - exclude_);
    const Size previous = count - std::max<Size>(1, exclude_ / LOOPS.stride);
    if (previous >= 0 && near[start + previous] != NONE)
      push(neighbours_, spread.z(near[start + previous]), LOOPS.memory);
    const double usual = neighbours_.empty() ? 0.0 : quantile({neighbours_.begin(), neighbours_.end()}, 0.25);
    const double by_chance = std::sqrt(2 * log_of(static_cast<double>(std::max<Size>(2, rows()))));
    const double level = std::max({MOTION.level, LOOPS.level_fraction * usual, by_chance});
    const double weight = LOOPS.evidence / level;
    tracks_.after(near.data() + start, count, candidates);
    const Fit fits = fit();
    for (std::size_t stretch = 0; stretch < explained_.size(); ++stretch) {
      const double explained = std::max(fits.level, explained_[stretch] / spread.deviation);
      const Size first = starts_[stretch], count = starts_[stretch + 1] - first;
      likelihoods(near.data() + first, count, fits.weight, explained, spread, likely.data() + first);
    }
    likelihoods(near.data() + start, candidates, fits.weight, fits.level, spread, likely.data() + start);
    const bool is_returning = tracks_.returning();
    same.resize(count);
    likelihoods(near.data() + start, count, weight, level, spread, same.data());
    for (Size row = 0; row < count; ++row) {
      float &here = likely[start + row];
      const float others = here;
      here = same[row];
      if (row >= candidates) continue;
      const double repeats = (static_cast<double>(repeats_.highest()[row]) - spread.mean) *
                                 (LOOPS.repeat_margin / spread.deviation) - level;
      if (repeats > 0) here *= static_cast<float>(exp_of(-weight * repeats));
      if (is_returning) here = std::max(here, others);
    }
  }

  void filter() {
    of_rows_.likelihood.rows.resize(drives_.rows, 0.0F);
    Floats &memory = of_rows_.belief;
    const Rows rows = drives_.all();
    const Likelihood &likelihood = of_rows_.likelihood;
    Belief next = starting_ ? filter_.extended(belief_, rows, std::move(memory))
                            : filter_.after(belief_, rows, likelihood, std::move(memory)).first;
    memory = std::move(belief_.mapped);
    belief_ = std::move(next);
    if (starting_) filter_.update(belief_, likelihood);
    probable_ = belief_.of_rows(std::move(probable_));
    starting_ = false;
  }

  ssrvlad_loop result(const std::vector<float> &scored) {
    Floats &rows = of_rows_.left;
    rows = probable_;
    Size candidate = -1;
    for (Size row = 0; row < old_; ++row)
      if (scored[row] != NONE && (candidate < 0 || rows[row] > rows[candidate])) candidate = row;
    const double old = sum(rows.data(), old_), recent = sum(rows.data() + old_, drives_.rows - old_);
    const Size first = std::max<Size>(0, candidate - SSRVLAD_RADIUS), last = std::min(candidate + SSRVLAD_RADIUS + 1, old_);
    ssrvlad_loop loop{};
    loop.candidate = candidate;
    loop.score = static_cast<double>(scored[candidate]);
    // Calls a function for what is left of old rows that show the place of one.
    const auto showing = [&](Size row, auto function) {
      for (Size other = 0; other < old_; ++other)
        if (std::abs(other - row) <= SSRVLAD_RADIUS || std::abs(shown_[other] - shown_[row]) <= SSRVLAD_RADIUS)
          function(rows[other]);
    };
    const auto probability = [&](Size row) {
      double sum = 0;
      showing(row, [&](float probable) { sum += static_cast<double>(probable); });
      return std::min(1.0, sum);
    };
    loop.probability = probability(candidate);
    const Size drive = drives_.of(candidate);
    loop.first = std::max(first, drives_.starts[drive]);
    loop.rows = static_cast<std::int32_t>(std::min(last, drives_.last(drive)) - loop.first);
    std::copy_n(rows.begin() + loop.first, loop.rows, loop.probabilities);
    loop.reason = SSRVLAD_BELOW_THRESHOLD;
    if (loop.probability >= threshold_) loop.reason = SSRVLAD_ACCEPTED;
    else if (recent > std::max(old, 1 - old - recent)) loop.reason = SSRVLAD_TOO_RECENT;
    else if (old >= threshold_) loop.reason = SSRVLAD_AMBIGUOUS;
    tracks_.decided(loop.reason == SSRVLAD_ACCEPTED);
    for (Size row = candidate; loop.places < SSRVLAD_PLACES; ++loop.places) {
      loop.best[loop.places] = {row, probability(row)};
      if (loop.best[loop.places].probability < LOOPS.least_place) break;
      showing(row, [](float &probable) { probable = 0; });
      row = std::max_element(rows.begin(), rows.begin() + old_) - rows.begin();
    }
    return loop;
  }

  Size exclude_;
  double threshold_;
  Size scan_above_;
  std::vector<std::size_t> rough_;  // numbers of the channels that give rough scores
  std::vector<std::unique_ptr<LiveChannel>> channels_;
  std::vector<double> trust_, leads_;
  std::vector<bool> described_;
  std::vector<Size> shown_;  // of each row the first one known to show its place, by the loops that closed
  Size known_ = 0, old_known_ = 0, old_ = 0;  // frames that are not empty: of all, and of the first old
  std::vector<Size> starts_;                  // of stretches
  std::deque<double> stamps_;                 // of the last frames of the present stretch
  Drives drives_;
  Filter filter_;
  Belief belief_;
  Floats probable_;              // how probable rows are by it
  bool starting_ = true;
  std::deque<double> neighbours_, fits_;
  Repeats repeats_;
  Tracks tracks_;
  std::vector<double> explained_;  // by the tracks of each stretch but the present one

  // Of the last frame, kept for their memory.
  struct OfRows {
    std::vector<float> scores, fused, near, usual, rough_usual, same;
    Floats left, belief;
    std::vector<std::vector<float>> of_channels, rough;  // nearness by channel, empty if it is not rough
    std::vector<double> z;
    Chosen chosen;
    Likelihood likelihood;
  };
  OfRows of_rows_;
};
}  // namespace

}  // namespace places

// -------------------------------------------------------------------------------- ssrvlad_loops.h

using namespace places;

struct ssrvlad_loops : Stream {
  using Stream::Stream;
  bool is_whole = true;
};

namespace {

constexpr Size MOST_EXCLUDED = Size{1} << 62, MOST_RESERVED = Size{1} << 40;

void check(const ssrvlad_loops_channel &channel) {
  require_range("kind", channel.kind, SSRVLAD_VECTORS, SSRVLAD_SIGNS);
  require(channel.trust > 0 && channel.trust < 1e300, "a trust above 0");
  Size size = 1;
  for (const Size axis : channel.shape) {
    require(axis >= 1 && axis <= MOST_NUMBERS / size, "shapes of up to 2^31 numbers");
    size *= axis;
  }
  require(channel.kind == SSRVLAD_SIGNS || channel.shape[0] == size, "the shape of vectors: their length, 1, 1");
}

// Whether there are descriptors of one frame that can be such.
bool fits(const Stream &stream, const void *const *descriptors, const int64_t *anchors) {
  for (std::size_t number = 0; descriptors && number < stream.channels().size(); ++number)
    if (!descriptors[number] || !stream.channels()[number]->fits(descriptors[number], anchors ? anchors[number] : 1))
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
    return new ssrvlad_loops(capped, channels, count);
  });
}

void ssrvlad_loops_free(ssrvlad_loops *loops) { delete loops; }

int ssrvlad_loops_reserve(ssrvlad_loops *loops, int64_t frames) {
  return guarded([&] {
    require(loops && frames >= 0 && frames <= MOST_RESERVED, "a stream, and a number of frames up to 2^40");
    loops->reserve(frames);
  });
}

int64_t ssrvlad_loops_rows(const ssrvlad_loops *loops) { return loops ? loops->rows() : 0; }

int ssrvlad_loops_update(ssrvlad_loops *loops, const void *const *descriptors, const int64_t *anchors,
                         double stamp, int starts, int threads, ssrvlad_loop *result) {
  return changed(loops, [&] {
    require(loops && result, "a stream and memory for the result");
    require(fits(*loops, descriptors, anchors),
            "finite vectors of length 1 or 0, from an odd number of anchors, and signs from 1");
    *result = loops->update(descriptors, anchors, stamp, starts != 0, threads);
  });
}

int ssrvlad_loops_extend(ssrvlad_loops *loops, const void *const *descriptors, const double *stamps,
                         const uint8_t *starts, int64_t frames) {
  return changed(loops, [&] {
    require(loops && descriptors && starts && frames >= 0, "a stream, descriptors and starts");
    const auto &channels = loops->channels();
    const auto frame = [&](int64_t row) {
      std::vector<const void *> addresses;
      for (std::size_t number = 0; number < channels.size(); ++number)
        addresses.push_back(static_cast<const std::uint8_t *>(descriptors[number]) + row * channels[number]->bytes());
      return addresses;
    };
    for (int64_t row = 0; row < frames; ++row)
      require(fits(*loops, frame(row).data(), nullptr), "finite vectors of length 1 or 0");
    for (int64_t row = 0; row < frames; ++row) {
      const double stamp = stamps ? stamps[row] : std::numeric_limits<double>::quiet_NaN();
      loops->extend(frame(row).data(), stamp, starts[row] != 0);
    }
    if (frames && frames >= loops->rows() / 10) loops->settle();
  });
}

int ssrvlad_loops_descriptors(const ssrvlad_loops *loops, int channel, int64_t first, int64_t last,
                              void *descriptors) {
  return guarded([&] {
    require(loops && descriptors && channel >= 0 && channel < static_cast<Size>(loops->channels().size()) &&
                first >= 0 && last >= first && last <= loops->rows(),
            "a channel and rows of the stream");
    loops->channels()[channel]->copy(first, last, descriptors);
  });
}

void ssrvlad_loops_weights(const ssrvlad_loops *loops, double *weights) {
  if (!loops || !weights) return;
  for (const double weight : loops->weights()) *weights++ = weight;
}
