// A sequence whose queries come one by one, in a map that stays as it is. The answer to a query depends on the
// queries before it, and on so many later ones as it waits for.
//
// What decide.hpp knows of a whole sequence is known here of the queries so far: the mean of the descriptors,
// the width of the sweep, the weights of the channels, the course, and how many answers are wrong.

#ifndef SSRVLAD_TRACKER_HPP
#define SSRVLAD_TRACKER_HPP

#include <deque>
#include <memory>
#include <optional>
#include <random>
#include <vector>

#include "evidence.hpp"
#include "map.hpp"

namespace places {

// The scores of the last queries.
class Recent : public Scores {
 public:
  explicit Recent(Size rows) : rows_(rows) {}

  void push(std::vector<float> scores, Size most);
  Size first() const { return first_; }
  Size queries() const override { return first_ + static_cast<Size>(scores_.size()); }
  Size rows() const override { return rows_; }
  void of(Size query, float *scores) const override;

 private:
  Size rows_, first_ = 0;
  std::deque<std::vector<float>> scores_;
};

// What is decided of one query: `Decision` of this query, and the steps that were taken.
struct Answer : Decision {
  Size query = 0, width = 0;
  std::vector<double> weights;

  using Decision::Decision;
};

class Tracker {
 public:
  // The map must outlive it. `top`, `delay` and the rows that are `allowed` are those of the steps.
  Tracker(const Map &map, const ssrvlad_steps &steps, int threads);

  // Takes the next query, by its descriptors by each channel of the map; `excluded` are the first row that is no
  // candidate and the one after the last, or NULL.
  void update(const ssrvlad_queries *queries, const Size *excluded);
  // How many queries have no answer yet.
  Size waiting() const { return count_ - answered_; }
  Size delay() const { return delay_; }
  // The answer to the first query that waits for one.
  Answer answer();

 private:
  // A query in a stream of the course: the belief after it, and the row of its answer so far.
  struct Place {
    Size query;
    Seen seen;
    std::shared_ptr<const Sight> sight;
    Size row;
  };

  // The sequence as it runs the map by a course.
  struct Way {
    Course course;
    Filter filter;
    std::vector<std::deque<Place>> streams;
  };

  // Each of the last queries that have an answer, by itself and as it is followed.
  struct History {
    std::deque<double> alone, followed, by_itself;  // chances, NaN without an answer
    std::deque<Size> rivals;
  };

  void score(const ssrvlad_queries *queries, const Size *excluded);
  void choose_course();
  void follow(Size query);
  Places place_of(Size query);
  void judge(Answer &answer, const Chance &chance);

  const Map &map_;
  const Listing &listing_;
  Size top_, delay_;
  bool standardised_, swept_;
  int threads_;
  std::vector<std::uint8_t> allowed_;
  std::vector<std::unique_ptr<Running>> channels_;
  std::vector<double> leads_, weights_;
  Size width_ = 0, count_ = 0, answered_ = 0;
  Recent recent_;
  Evidence evidence_;
  Likeness likeness_;
  std::vector<Course> courses_;
  Trial trial_, shuffled_;
  std::vector<Size> pending_;  // queries that the random order has not reached
  std::mt19937 random_{0};
  double gain_ = 0;  // of the course, a query
  std::unique_ptr<Way> way_;
  std::deque<Answer> alone_;  // of the queries that wait, each judged by itself
  std::deque<Chance> chances_;
  std::deque<Size> rows_alone_;  // of the first candidates of the last queries
  History history_;
};

}  // namespace places

#endif
