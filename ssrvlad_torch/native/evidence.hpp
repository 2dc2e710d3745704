// The queries of a sequence, and how they fit a map: what decisions are made of.

#ifndef SSRVLAD_EVIDENCE_HPP
#define SSRVLAD_EVIDENCE_HPP

#include <deque>
#include <memory>
#include <tuple>
#include <utility>
#include <vector>

#include "confidence.hpp"
#include "decide.hpp"
#include "filter.hpp"
#include "progress.hpp"

namespace places {

// The numbers from 0 on.
std::vector<Size> in_order(Size count);

// What is known of one query: its scores at the listed rows, and how many rows of the map could match, less
// than 0 for those that have a score.
struct Sight {
  const Rows &rows;
  Floats scores;
  float highest;
  Size matching;
  Floats near;  // if it is followed; and the spread of all rows
  Spread spread;
  Floats z;  // beside others: by how many deviations each row is nearer than the mean of all
};

// The queries of one sequence, and how they fit a map. Not to be shared by threads.
class Evidence {
 public:
  // Keeps what is known of so many queries, and else of the last one.
  Evidence(const Listing &listing, const Scores &scores, Size kept = 0);

  Size queries() const { return scores_.queries(); }
  const Drives &map() const { return listing_.map; }

  // A query by itself.
  std::shared_ptr<const Sight> alone(Size query) const { return known(query).sight; }
  // A query with others; 0 deviations where there is no score.
  std::shared_ptr<const Sight> beside(Size query) const;
  // How likely a query is that is followed.
  std::shared_ptr<const Likelihood> likelihood(const Motion &motion, Size query) const;
  // The scores of a query at rows that represent all, the same for each query.
  std::vector<float> profile(const Sight &sight) const;

 private:
  // A query; how likely it is by each weight and level that was asked for.
  struct Known {
    Size query = -1;
    std::shared_ptr<Sight> sight;
    std::vector<std::tuple<double, double, std::shared_ptr<const Likelihood>>> likelihoods;
  };

  Sight sight_of(Size query) const;
  Known &known(Size query) const;
  Known &near(Size query) const;

  const Listing &listing_;
  const Scores &scores_;
  std::vector<Size> compared_;
  mutable std::vector<Known> known_;
};

// A query, and the belief after it.
struct Seen {
  std::shared_ptr<const Sight> sight;
  std::shared_ptr<const Likelihood> likelihood;
  std::shared_ptr<Belief> belief;

  // Writes or reads the belief in some rows, if there is one.
  template <typename Archive>
  void keep(Archive &archive, const Rows &rows) {
    bool exists = belief != nullptr;
    archive(exists);
    if (!exists) return;
    Belief all = belief ? *belief : Belief{rows, {}, 0, 1};
    archive(all.mapped), archive(all.elsewhere), archive(all.unmapped), archive(all.unit);
    if (archive.reads()) belief = std::make_shared<Belief>(std::move(all));
  }
};

// The forward algorithm.
struct Walk {
  const Filter &filter;
  Seen now;
  Floats spare{};              // of a belief that nothing keeps
  std::vector<Seen> past{};    // so far, if it is kept

  // Takes the next query: the logarithm of how much likelier it is so than alone.
  double step(const Evidence &evidence, Size query) {
    const std::shared_ptr<Belief> before = std::move(now.belief);
    now = {evidence.alone(query), evidence.likelihood(filter.motion(), query), nullptr};
    const Rows &rows = now.sight->rows;
    if (!before) {
      now.belief = std::make_shared<Belief>(filter.start(rows));
      return filter.update(*now.belief, *now.likelihood);
    }
    auto [after, gain] = filter.after(*before, rows, *now.likelihood, std::move(spare));
    now.belief = std::make_shared<Belief>(std::move(after));
    if (before.use_count() == 1) spare = std::move(before->mapped);
    return gain;
  }
};

// Puts the highest of values above NONE among the candidates of a query, of equals the first one first.
void put(const Floats &values, const Rows &rows, Size query, Matches &matches);

// Of one query by the beliefs in its listed rows. Rows without a score are no candidates, unless none has
// one: any row may be the place of an empty query.
void place(const Filter &filter, const Sight &sight, const Smoothed &beliefs, Size query, Places &places);

// How the row of an answer compares with its rivals by the sights of the neighbouring queries of a stream, as far
// as no step between the rows of their answers is longer than the filter can make: `around` earlier ones, and so
// many later. The value of a row is the sum of the deviations of these queries along the same path, moved to it.
// 1 if a row elsewhere is better. And by how many deviations the place of the answer is nearer to the query.
std::pair<double, double> chances_around(const Filter &filter, const std::deque<std::shared_ptr<const Sight>> &sights,
                                         const std::vector<Size> &rows, Size at, Size later);

// The courses that are tried.
std::vector<Course> courses();

// Courses that are tried at once, so that each query is scored once.
class Trial {
 public:
  // Keeps what was seen at each stride of the streams if that takes at most so many numbers.
  Trial(const Drives &drives, const std::vector<Course> &courses, Size most = 0, Size stride = 1)
      : left_(most), stride_(stride), gains_(courses.size()) {
    for (const Course &course : courses) {
      Motion motion;
      motion.rate = course.rate;
      filters_.push_back(std::make_unique<Filter>(drives, motion, std::vector<int>{course.way}));
      walks_.emplace_back(course.streams, Walk{*filters_.back(), {}});
    }
    counts_.resize(courses.size());
  }

  // Takes a query into all courses, the next that it lacks into one.
  void step(const Evidence &evidence, Size query) {
    for (std::size_t course = 0; course < walks_.size(); ++course) step(evidence, query, course);
  }
  void step(const Evidence &evidence, Size query, std::size_t course) {
    std::vector<Walk> &streams = walks_[course];
    const Size count = counts_[course]++, number = static_cast<Size>(streams.size());
    Walk &walk = streams[static_cast<std::size_t>(count % number)];
    const double gain = walk.step(evidence, query);
    gains_[course] += number > 1 ? MODEL.of_two * gain : gain;
    if (left_ > 0 && count / number % stride_ == 0) remember(walk);
  }

  // Of the queries by each course: the logarithm of how much likelier they are so than alone; what counts of it.
  const std::vector<double> &gains() const { return gains_; }
  // How many queries a course has taken.
  Size count(std::size_t course) const { return counts_[course]; }
  // What was seen by each stream of a course at each stride; empty if that is not kept.
  std::vector<std::vector<Seen>> past(std::size_t course) const {
    std::vector<std::vector<Seen>> past;
    for (const Walk &walk : walks_[course]) past.push_back(walk.past);
    return past;
  }

  template <typename Archive>
  void keep(Archive &archive, const Rows &rows) {
    archive(counts_), archive(gains_);
    for (std::vector<Walk> &streams : walks_)
      for (Walk &walk : streams) walk.now.keep(archive, rows);
  }

 private:
  void remember(Walk &walk) {
    left_ -= static_cast<Size>(walk.now.belief->mapped.size());
    walk.past.push_back(walk.now);
    if (left_ > 0) return;
    for (std::vector<Walk> &streams : walks_)
      for (Walk &other : streams) other.past = {};
  }

  Size left_;  // of the numbers that may be kept
  Size stride_;
  std::vector<Size> counts_;
  std::vector<double> gains_;
  std::vector<std::unique_ptr<Filter>> filters_;
  std::vector<std::vector<Walk>> walks_;
};

// The gain of so many queries by a course that is taken.
double least_gain(Size queries);

// The number of the likeliest of the courses.
std::size_t likeliest(const std::vector<double> &gains);

}  // namespace places

#endif
