// The tracker of tracker.hpp.

#include "tracker.hpp"

#include "fusion.hpp"
#include "interface.hpp"

namespace places {

namespace {
constexpr Size STATE = 5;  // what a state holds, and how; it rises with every change
constexpr double NO_ANSWER = std::numeric_limits<double>::quiet_NaN();

bool same(const Course &one, const Course &other) {
  return one.way == other.way && one.rate == other.rate && one.streams == other.streams;
}
}  // namespace

void Recent::push(std::vector<float> scores, Size most) {
  scores_.push_back(std::move(scores));
  for (; static_cast<Size>(scores_.size()) > most; ++first_) scores_.pop_front();
}

void Recent::of(Size query, float *scores) const {
  const std::vector<float> &row = scores_[static_cast<std::size_t>(query - first_)];
  std::copy(row.begin(), row.end(), scores);
}

void Recent::keep(Archive &archive) {
  archive(first_), archive(scores_);
  for (const std::vector<float> &row : scores_) require(static_cast<Size>(row.size()) == rows_);
}

Tracker::Tracker(const Map &map, const ssrvlad_steps &steps)
    : map_(map), listing_(map.listing()), top_(steps.top), delay_(std::min(steps.delay, MOST_NUMBERS)),
      standardised_(steps.standardise && listing_.map.rows >= MODEL.min_frames), swept_(steps.sweep),
      leads_(static_cast<std::size_t>(map.channels())), recent_(listing_.count()), evidence_(listing_, recent_),
      courses_(courses()), trial_(listing_.map, courses_) {
  if (steps.allowed) allowed_.assign(steps.allowed, steps.allowed + listing_.count());
}

void Tracker::open(const std::vector<Size> &anchors, int threads) {
  anchors_ = anchors;
  for (Size number = 0; number < map_.channels(); ++number)
    channels_.push_back(map_.live(number, anchors[static_cast<std::size_t>(number)], standardised_, swept_, threads));
}

std::vector<float> Tracker::scores_of(const ssrvlad_queries *queries, const Size *excluded, int threads) {
  std::vector<std::vector<float>> scores;
  width_ = 0;
  for (const auto &channel : channels_) {
    std::vector<float> of_channel(static_cast<std::size_t>(listing_.count()));
    channel->next(queries[scores.size()].descriptors, threads, of_channel.data());
    mask(listing_, allowed_.empty() ? nullptr : allowed_.data(), excluded, of_channel.data());
    width_ = std::max(width_, channel->width);
    scores.push_back(std::move(of_channel));
  }
  weights_ = {1};
  if (channels_.size() == 1) return std::move(scores.front());
  const Fusion fusion(std::move(scores), listing_);
  const std::vector<double> leads = fusion.leads();
  for (std::size_t number = 0; number < leads.size(); ++number) leads_[number] += leads[number];
  weights_ = weights_of(map_.trust(), count_ + 1 < MODEL.min_frames ? std::vector<double>(leads.size()) : leads_);
  std::vector<float> fused(static_cast<std::size_t>(listing_.count()));
  fusion.of(weights_, fused.data());
  return fused;
}

void Tracker::update(const ssrvlad_queries *queries, const Size *excluded, int threads) {
  std::vector<Size> anchors;
  for (Size number = 0; number < map_.channels(); ++number) {
    map_.check(number, queries[number], 1);
    anchors.push_back(queries[number].anchors);
  }
  require(anchors_.empty() || anchors == anchors_, "as many anchors of each query");
  const Size around = (delay_ + MODEL.around + 1) * MODEL.streams;
  forget();
  if (channels_.empty()) open(anchors, threads);
  recent_.push(scores_of(queries, excluded, threads), MODEL.min_frames + around);
  const Size query = count_++;
  const std::shared_ptr<const Sight> alone = evidence_.alone(query);
  const Sight &sight = *alone;
  likeness_.add(evidence_.profile(sight));
  likeness_.forget(MODEL.stretch + around);
  Answer answer(top_);
  answer.query = query;
  answer.width = width_;
  answer.weights = weights_;
  put(sight.scores, sight.rows, 0, answer);
  const bool empty = answer.rows.front() < 0;
  chance_.push_back(empty ? Chance{NO_ANSWER, -1} : chance_of_scores(sight.scores.data(), sight.rows, sight.matching));
  push(row_alone_, answer.rows.front(), MODEL.stretch + delay_);
  alone_.push_back(std::move(answer));
  trial_.step(evidence_, query);
  choose_course();
  if (course_) follow(query);
}

// The likeliest course so far; none if there is hardly any gain.
void Tracker::choose_course() {
  const std::size_t best = likeliest(trial_.gains());
  const double gain = trial_.gains()[best];
  gain_ = gain / static_cast<double>(count_);
  if (gain <= least_gain(count_)) {
    course_ = nullptr;
  } else if (!course_ || !same(course_->course, courses_[best])) {
    set_course(courses_[best]);
    for (Size query = recent_.first(); query + 1 < count_; ++query) follow(query);
  }
}

void Tracker::set_course(const Course &course) {
  course_.reset(new FollowedCourse{course, Filter(listing_.map, Motion().at(course.rate), {course.way}), {}});
  course_->streams.resize(static_cast<std::size_t>(course.streams));
}

void Tracker::follow(Size query) {
  std::deque<Place> &stream = course_->stream(query);
  Walk walk{course_->filter, stream.empty() ? Seen{} : stream.back().seen};
  walk.step(evidence_, query);
  Places places(1, 1);
  place(course_->filter, *walk.now.sight, {walk.now.belief->of_rows(), walk.now.belief->unmapped}, 0, places);
  evidence_.beside(query);
  stream.push_back({query, places.rows.front(), walk.now});
  while (stream.front().query + (delay_ + MODEL.around) * course_->course.streams < query) stream.pop_front();
}

// The places of a query by its course and the later queries.
Places Tracker::place_of(Size query) {
  std::deque<Place> &stream = course_->stream(query);
  const Filter &filter = course_->filter;
  const auto here = std::find_if(stream.begin(), stream.end(), [&](const Place &place) { return place.query == query; });
  const Seen &newest = stream.back().seen;
  Future future = filter.last(*newest.belief, *newest.likelihood);
  Smoothed beliefs{newest.belief->of_rows(), newest.belief->unmapped};
  for (auto later = std::prev(stream.end()); later != here; --later) {
    const Seen &seen = std::prev(later)->seen;
    std::tie(future, beliefs) = filter.before(*seen.belief, *seen.likelihood, later->seen.sight->rows, future);
  }
  Places places(1, top_);
  place(filter, *here->seen.sight, beliefs, 0, places);
  here->row = places.rows.front();
  return places;
}

bool Tracker::lingers(Size query, const std::vector<Size> &queries, const std::vector<Size> &rows) const {
  const auto at = std::find(queries.begin(), queries.end(), query) - queries.begin();
  return lingering(likeness_, queries, rows, std::min(MODEL.around, delay_))[static_cast<std::size_t>(at)];
}

// By the course; the answers around a query are those that its stream has so far.
Tracker::Chances Tracker::chances_of(Size query, Places &places) {
  Chances chances{chance_.front().chance, NO_ANSWER, NO_ANSWER, chance_.front().rival};
  if (!course_) return chances;
  const Size streams = course_->course.streams, first = count_ - static_cast<Size>(row_alone_.size());
  std::vector<Size> queries, rows;
  for (Size other = first + ((query - first) % streams + streams) % streams; other < count_; other += streams) {
    queries.push_back(other);
    rows.push_back(row_alone_[static_cast<std::size_t>(other - first)]);
  }
  if (lingers(query, queries, rows)) chances.alone = 1;
  places = place_of(query);
  std::deque<std::shared_ptr<const Sight>> sights;
  queries.clear(), rows.clear();
  for (const Place &place : course_->stream(query)) {
    sights.push_back(place.seen.sight);
    queries.push_back(place.query);
    rows.push_back(place.row);
  }
  const auto at = static_cast<Size>(std::find(queries.begin(), queries.end(), query) - queries.begin());
  const auto [around, nearer] = chances_around(course_->filter, sights, rows, at, std::min(MODEL.around, delay_));
  const bool stays = lingers(query, queries, rows);
  chances.around = stays ? 1 : std::max(places.chance.front(), around);
  chances.nearer = nearer;
  return chances;
}

Answer Tracker::answer() {
  forget();
  Answer answer = std::move(alone_.front());
  Places places(1, top_);
  Chances chances = chances_of(answer.query, places);
  if (answer.rows.front() < 0) chances.alone = chances.around = chances.nearer = NO_ANSWER;
  alone_.pop_front();
  chance_.pop_front();
  push(history_, chances, MODEL.stretch);
  judge(chances, places, answer);
  if (listing_.map.rows < MODEL.min_frames) answer.right = {0};
  return answer;
}

// How sure an answer is beside those before it.
void Tracker::judge(const Chances &chances, Places &places, Answer &answer) {
  std::vector<double> alone, around, nearer;
  std::vector<Size> rivals;
  for (const Chances &before : history_) {
    alone.push_back(before.alone);
    around.push_back(before.around);
    nearer.push_back(before.nearer);
    rivals.push_back(before.rival);
  }
  const std::vector<double> of_rivals = rivals_together(alone, rivals);
  double together = answers_together(of_rivals);
  const auto last = std::min<std::ptrdiff_t>(MODEL.min_frames, static_cast<std::ptrdiff_t>(history_.size()));
  answer.followed = course_ && !std::isnan(chances.alone) &&
                    are_hardly_less_ahead({around.end() - last, around.end()}, {alone.end() - last, alone.end()});
  answer.follows = {answer.followed};
  std::vector<double> has;
  if (answer.followed) {
    has = mapped_along(nearer, of_rivals);
    together = std::max(static_cast<double>(MODEL.around), together);
    answer.scores = places.scores;
    answer.rows = places.rows;
    if (places.rows.front() >= 0) answer.scores.front() = places.near.front();
  } else {
    has = mapped(alone, together);
  }
  if (course_) answer.course = course_->course, answer.gain = gain_;
  const Confidence sure = Confidence::of(answer.followed ? around : alone, has, together, answer.followed);
  answer.right = {sure.right.back()};
  answer.spread = {sure.spread.back()};
  answer.together = {static_cast<float>(together)};
}

std::uint64_t Tracker::digest_of_map() {
  if (!map_digest_) map_digest_ = map_.digest();
  return *map_digest_;
}

std::uint64_t Tracker::digest_of_steps() const {
  const Size steps[] = {top_, delay_, standardised_, swept_};
  return digest_of(allowed_.data(), allowed_.size(), digest_of(steps, sizeof steps, 0));
}

// The state, and after it the digests of the map, of the steps, and of all this.
const std::vector<std::uint8_t> &Tracker::save() {
  if (!saved_.empty()) return saved_;
  std::vector<std::uint8_t> bytes;
  Archive archive(bytes);
  keep(archive);
  std::uint64_t map = digest_of_map(), steps = digest_of_steps();
  archive(map), archive(steps);
  std::uint64_t all = digest_of(bytes.data(), bytes.size(), STATE);
  archive(all);
  return saved_ = std::move(bytes);
}

void Tracker::load(const std::uint8_t *state, Size size) {
  const char *whole = "a whole state of a tracker of this version";
  std::uint64_t digests[3];  // of the map, of the steps, and of all
  const Size bytes = size - static_cast<Size>(sizeof digests);
  require(!count_, "a tracker that has taken no frame");
  require(bytes >= 0, whole);
  std::memcpy(digests, state + bytes, sizeof digests);
  require(digests[2] == digest_of(state, static_cast<std::size_t>(size) - sizeof digests[2], STATE), whole);
  require(digests[0] == digest_of_map(), "a state of a tracker of this map");
  require(digests[1] == digest_of_steps(), "a state of a tracker with these steps");
  Archive archive(state, bytes);
  forget();
  keep(archive);
  require(!archive.left(), whole);
}

void Tracker::keep(Archive &archive) {
  archive(anchors_), archive(leads_), archive(weights_), archive(width_), archive(count_);
  require(leads_.size() == static_cast<std::size_t>(map_.channels()) &&
          (anchors_.empty() || anchors_.size() == leads_.size()));
  if (archive.reads() && !anchors_.empty()) {
    for (const Size anchors : anchors_) require(anchors >= 1 && anchors % 2 == 1 && anchors < MOST_NUMBERS);
    open(anchors_, 1);
  }
  for (const auto &channel : channels_) channel->keep(archive);
  recent_.keep(archive);
  likeness_.keep(archive);
  trial_.keep(archive, listing_.rows);
  archive(gain_), archive(chance_), archive(row_alone_), archive(history_);
  auto waiting = static_cast<Size>(alone_.size());
  archive(waiting);
  for (Size number = 0; number < waiting; ++number) {
    if (archive.reads()) alone_.emplace_back(top_);
    Answer &answer = alone_[static_cast<std::size_t>(number)];
    archive(answer.query), archive(answer.width), archive(answer.weights), archive(answer.scores), archive(answer.rows);
    require(static_cast<Size>(answer.scores.size()) == top_ && answer.rows.size() == answer.scores.size() &&
            static_cast<Size>(answer.weights.size()) == map_.channels());
  }
  bool runs = course_ != nullptr;
  archive(runs);
  if (!runs) return;
  Course course = course_ ? course_->course : Course{};
  archive(course.way), archive(course.rate), archive(course.streams);
  if (archive.reads()) {
    require(std::any_of(courses_.begin(), courses_.end(), [&](const Course &other) { return same(course, other); }));
    set_course(course);
  }
  for (std::deque<Place> &stream : course_->streams) {
    auto count = static_cast<Size>(stream.size());
    archive(count);
    for (Size number = 0; number < count; ++number) {
      Place place = archive.reads() ? Place{} : stream[static_cast<std::size_t>(number)];
      archive(place.query), archive(place.row);
      require(place.query >= recent_.first() && place.query < count_ && place.row >= -1 &&
              place.row < listing_.map.rows);
      place.seen.keep(archive, listing_.rows);
      if (!archive.reads()) continue;
      place.seen.sight = evidence_.beside(place.query);
      place.seen.likelihood = evidence_.likelihood(course_->filter.motion(), place.query);
      stream.push_back(std::move(place));
    }
  }
}

}  // namespace places
