// The tracker of tracker.hpp.

#include "tracker.hpp"

#include "interface.hpp"

namespace places {

namespace {
constexpr Size MEMORY = 200;    // answers by which the others are judged
constexpr Size SHUFFLED = 30;   // queries from which a random one is taken
constexpr Size KEPT = 2 * SHUFFLED;  // queries whose scores are kept

constexpr double NO_ANSWER = std::numeric_limits<double>::quiet_NaN();

template <typename Value>
void push(std::deque<Value> &values, Value value, Size most) {
  values.push_back(value);
  if (static_cast<Size>(values.size()) > most) values.pop_front();
}
}  // namespace

void Recent::push(std::vector<float> scores, Size most) {
  scores_.push_back(std::move(scores));
  for (; static_cast<Size>(scores_.size()) > most; ++first_) scores_.pop_front();
}

void Recent::of(Size query, float *scores) const {
  const std::vector<float> &some = scores_[static_cast<std::size_t>(query - first_)];
  std::copy(some.begin(), some.end(), scores);
}

Tracker::Tracker(const Map &map, const ssrvlad_steps &steps, int threads)
    : map_(map), listing_(map.listing()), top_(steps.top), delay_(steps.delay),
      standardised_(steps.standardise && listing_.map.rows >= MIN_FRAMES), swept_(steps.sweep), threads_(threads),
      leads_(static_cast<std::size_t>(map.channels())), recent_(listing_.count()), evidence_(listing_, recent_),
      courses_(courses()), trial_(listing_.map, courses_), shuffled_(listing_.map, courses_) {
  if (steps.allowed) allowed_.assign(steps.allowed, steps.allowed + listing_.count());
}

void Tracker::score(const ssrvlad_queries *queries, const Size *excluded) {
  if (channels_.empty())
    for (Size number = 0; number < map_.channels(); ++number)
      channels_.push_back(map_.running(number, queries[number].anchors, standardised_, swept_, threads_));
  std::vector<std::vector<float>> scores;
  width_ = 0;
  for (const auto &channel : channels_) {
    map_.check(static_cast<Size>(scores.size()), queries[scores.size()], 1);
    std::vector<float> of_channel(static_cast<std::size_t>(listing_.count()));
    channel->next(queries[scores.size()].descriptors, threads_, of_channel.data());
    mask(listing_, allowed_.empty() ? nullptr : allowed_.data(), excluded, of_channel.data());
    width_ = std::max(width_, channel->width);
    scores.push_back(std::move(of_channel));
  }
  weights_ = {1};
  if (channels_.size() > 1) {
    const Fusion fusion(std::move(scores), listing_);
    const std::vector<double> leads = fusion.leads();
    for (std::size_t number = 0; number < leads.size(); ++number) leads_[number] += leads[number];
    weights_ = weights_of(map_.trust(), leads_, count_ + 1);
    scores.assign(1, std::vector<float>(static_cast<std::size_t>(listing_.count())));
    fusion.of(weights_, scores.front().data());
  }
  recent_.push(std::move(scores.front()), KEPT + (delay_ + AROUND) * Likeness::STREAMS);
}

void Tracker::update(const ssrvlad_queries *queries, const Size *excluded) {
  score(queries, excluded);
  const Size query = count_++;
  const Sight sight = evidence_.alone(query);
  likeness_.add(evidence_.profile(sight));
  Answer answer(1, top_);
  answer.query = query;
  answer.width = width_;
  answer.weights = weights_;
  put(sight.scores, sight.rows, 0, answer);
  Chance chance{NO_ANSWER, -1};
  if (answer.rows.front() >= 0) chance = chance_of_scores(sight.scores.data(), sight.rows, sight.matching);
  push(rows_alone_, answer.rows.front(), MEMORY + delay_);
  alone_.push_back(std::move(answer));
  chances_.push_back(chance);

  trial_.step(evidence_, query);
  pending_.push_back(query);
  if (pending_.front() + KEPT <= query || static_cast<Size>(pending_.size()) > std::min(SHUFFLED, query / 2)) {
    const std::size_t number =
        pending_.front() + KEPT <= query ? 0 : static_cast<std::size_t>(random_()) % pending_.size();
    shuffled_.step(evidence_, pending_[number]);
    pending_.erase(pending_.begin() + static_cast<std::ptrdiff_t>(number));
  }
  choose_course();
  if (way_) follow(query);
}

// The likeliest course so far; none if there is hardly any gain, or as much in a random order.
void Tracker::choose_course() {
  const std::size_t best = likeliest(trial_.gains());
  const double gain = trial_.gains()[best], count = static_cast<double>(count_);
  const double at_random = shuffled_.count() ? shuffled_.gains()[best] / static_cast<double>(shuffled_.count()) : 0;
  gain_ = gain / count;
  const bool runs = gain > LEAST_GAIN && at_random <= BY_ROWS * gain_;
  if (!runs) {
    way_ = nullptr;
    gain_ = 0;
    return;
  }
  const Course &course = courses_[best];
  if (way_ && way_->course.way == course.way && way_->course.rate == course.rate && way_->course.streams == course.streams)
    return;
  way_.reset(new Way{course, Filter(listing_.map, Motion().at(course.rate), {course.way}), {}});
  way_->streams.resize(static_cast<std::size_t>(course.streams));
  for (Size query = recent_.first(); query + 1 < count_; ++query) follow(query);
}

void Tracker::follow(Size query) {
  std::deque<Place> &stream = way_->streams[static_cast<std::size_t>(query) % way_->streams.size()];
  Walk walk{way_->filter, stream.empty() ? Seen{} : stream.back().seen};
  walk.step(evidence_, query);
  Places places(1, 1);
  place(way_->filter, *walk.now.sight, {walk.now.belief->of_rows(), walk.now.belief->unmapped}, 0, places);
  stream.push_back({query, walk.now, evidence_.beside(query), places.rows.front()});
  while (stream.size() > 1 && stream.front().query + (AROUND + delay_ + 1) * Likeness::STREAMS < query) stream.pop_front();
}

// Of a query by its course: places, with the chance by the queries around it; `near` and `unmapped` as always.
Places Tracker::place_of(Size query) {
  std::deque<Place> &stream = way_->streams[static_cast<std::size_t>(query) % way_->streams.size()];
  const Filter &filter = way_->filter;
  Size at = 0;
  while (stream[static_cast<std::size_t>(at)].query != query) ++at;
  const auto last = static_cast<Size>(stream.size()) - 1;
  const Seen &now = stream[static_cast<std::size_t>(at)].seen;
  Places places(1, top_);
  if (at == last) {
    place(filter, *now.sight, {now.belief->of_rows(), now.belief->unmapped}, 0, places);
  } else {
    Future future = filter.none(*stream[static_cast<std::size_t>(last)].seen.belief);
    for (Size later = last; later > at; --later) {
      const Seen &seen = stream[static_cast<std::size_t>(later)].seen;
      future = filter.before(*stream[static_cast<std::size_t>(later - 1)].seen.belief, seen.sight->rows, seen.sight->likelihood, future);
    }
    place(filter, *now.sight, filter.smoothed(*now.belief, future), 0, places);
  }
  stream[static_cast<std::size_t>(at)].row = places.rows.front();
  return places;
}

Answer Tracker::answer() {
  Answer answer = std::move(alone_.front());
  const Chance chance = chances_.front();
  alone_.pop_front();
  chances_.pop_front();
  judge(answer, chance);
  ++answered_;
  if (listing_.map.rows < MIN_FRAMES) answer.right = {0};
  return answer;
}

void Tracker::judge(Answer &answer, const Chance &chance) {
  const Size query = answer.query, later = std::min(AROUND, delay_);
  const bool is_empty = answer.rows.front() < 0;
  double alone = chance.chance, followed = NO_ANSWER, by_itself = NO_ANSWER;
  std::optional<Places> places;
  if (way_) {
    const Size streams = way_->course.streams;
    const auto lingers = [&](const auto &row_of, Size first) {
      std::vector<Size> queries, rows;
      for (Size other = query % streams; other < count_; other += streams)
        if (other >= first && (row_of(other) != -2)) queries.push_back(other), rows.push_back(row_of(other));
      const std::vector<bool> found = lingering(likeness_, queries, rows, later);
      const auto at = std::find(queries.begin(), queries.end(), query) - queries.begin();
      return static_cast<bool>(found[static_cast<std::size_t>(at)]);
    };
    const Size first = count_ - static_cast<Size>(rows_alone_.size());
    if (lingers([&](Size other) { return rows_alone_[static_cast<std::size_t>(other - first)]; }, first)) alone = 1;
    places = place_of(query);
    const std::deque<Place> &stream = way_->streams[static_cast<std::size_t>(query) % way_->streams.size()];
    std::deque<std::shared_ptr<const Sight>> sights;
    std::vector<Size> rows;
    Size at = 0;
    for (const Place &place : stream) {
      if (place.query == query) at = static_cast<Size>(rows.size());
      sights.push_back(place.sight);
      rows.push_back(place.row);
    }
    const auto [around, itself] = chances_around(way_->filter, sights, rows, at, later);
    const bool stays = lingers([&](Size other) {
      const Size offset = (other - stream.front().query) / streams;
      return offset >= 0 && offset < static_cast<Size>(rows.size()) ? rows[static_cast<std::size_t>(offset)] : -2;
    }, stream.front().query);
    followed = stays ? 1 : std::max(places->chance.front(), around);
    by_itself = stays ? 1 : itself;
  }
  if (is_empty) alone = followed = by_itself = NO_ANSWER;
  push(history_.alone, alone, MEMORY);
  push(history_.followed, followed, MEMORY);
  push(history_.by_itself, by_itself, MEMORY);
  push(history_.rivals, is_empty ? Size{-1} : chance.rival, MEMORY);

  std::vector<Size> rivals;
  for (std::size_t each = 0; each < history_.rivals.size(); ++each)
    if (!std::isnan(history_.alone[each])) rivals.push_back(history_.rivals[each]);
  const double together = answers_together(rivals);
  const std::vector<double> chances(history_.alone.begin(), history_.alone.end());
  Confidence sure = Confidence::of(chances, mapped(chances, together, 1), together, false);
  answer.together = {static_cast<float>(together)};
  if (way_) {
    answer.course = way_->course;
    answer.gain = gain_;
    const std::vector<double> chances_followed(history_.followed.begin(), history_.followed.end());
    const std::vector<double> itself(history_.by_itself.begin(), history_.by_itself.end());
    const std::vector<double> has = mapped(itself, together, BEST);
    if (!is_empty) {
      answer.followed = true;
      const double least = std::max(static_cast<double>(AROUND), together);
      sure = Confidence::of(chances_followed, has, least, true);
      answer.together = {static_cast<float>(least)};
      answer.scores = places->scores;
      answer.rows = places->rows;
      if (places->rows.front() >= 0) answer.scores.front() = places->near.front();
    }
  }
  answer.right = {sure.right.back()};
  answer.spread = {sure.spread.back()};
}

}  // namespace places
