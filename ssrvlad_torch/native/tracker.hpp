// A sequence whose queries come one by one, in a map that stays as it is. The answer to a query depends on the
// queries before it, and on so many later ones as it waits for.
//
// What decide.hpp knows of a whole sequence is known here of the queries so far: the mean of the descriptors,
// the width of the sweep, the weights of the channels, the course, and how many answers are wrong. A sequence
// is followed where it has a course, and that leaves its answers hardly less ahead.

#ifndef SSRVLAD_TRACKER_HPP
#define SSRVLAD_TRACKER_HPP

#include <deque>
#include <memory>
#include <optional>
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
  void of(Size query, float *scores) const override;
  void keep(Archive &archive);

 private:
  Size rows_, first_ = 0;
  std::deque<std::vector<float>> scores_;
};

// What is decided of one query, and the steps that were taken.
struct Answer : Decision {
  Size query = 0, width = 0;
  std::vector<double> weights;

  explicit Answer(Size top) : Decision(1, top) {}
};

class Tracker {
 public:
  // The map must outlive it. `standardise`, `sweep`, `delay`, `top` and `allowed` are those of the steps.
  Tracker(const Map &map, const ssrvlad_steps &steps);

  // Takes the next query, by its descriptors by each channel of the map; `excluded` are the first row that is no
  // candidate and the one after the last, or NULL.
  void update(const ssrvlad_queries *queries, const Size *excluded, int threads);
  // How many queries it has taken, and how many of them have no answer yet.
  Size count() const { return count_; }
  Size waiting() const { return static_cast<Size>(alone_.size()); }
  // The answer to the first query that waits for one.
  Answer answer();

  // Whether the first query that waits has as many later ones as the delay.
  bool waits_long_enough() const { return waiting() > delay_; }
  bool standardised() const { return standardised_; }

  // The state, which is kept until a query or an answer changes it. `load` puts it into a new tracker of the same
  // map, made with the same steps; any other is refused.
  const std::vector<std::uint8_t> &save();
  void load(const std::uint8_t *state, Size size);

 private:
  // A query in a stream of the course, and the row of its answer so far.
  struct Place {
    Size query, row;
    Seen seen;
  };

  // The sequence as it runs the map by a course.
  struct FollowedCourse {
    Course course;
    Filter filter;
    std::vector<std::deque<Place>> streams;

    std::deque<Place> &stream(Size query) { return streams[static_cast<std::size_t>(query) % streams.size()]; }
  };

  // The chances of the answer to a query, NaN without one: by the query alone, and followed by the queries around
  // it; by how many deviations the place is nearer to the query.
  struct Chances {
    double alone, around, nearer;
    Size rival;
  };

  void keep(Archive &archive);
  void forget() { std::vector<std::uint8_t>().swap(saved_); }
  std::uint64_t digest_of_map();  // of all its rows, which are read once
  std::uint64_t digest_of_steps() const;  // with the rows that are allowed
  std::vector<float> scores_of(const ssrvlad_queries *queries, const Size *excluded, int threads);
  void open(const std::vector<Size> &anchors, int threads);
  void choose_course();
  void set_course(const Course &course);
  void follow(Size query);
  Places place_of(Size query);
  bool lingers(Size query, const std::vector<Size> &queries, const std::vector<Size> &rows) const;
  Chances chances_of(Size query, Places &places);
  void judge(const Chances &chances, Places &places, Answer &answer);

  const Map &map_;
  const Listing &listing_;
  Size top_, delay_;
  bool standardised_, swept_;
  std::vector<std::uint8_t> allowed_;
  std::vector<Size> anchors_;
  std::vector<std::unique_ptr<LiveComparison>> channels_;
  std::vector<double> leads_, weights_;
  Size width_ = 0, count_ = 0;
  Recent recent_;
  Evidence evidence_;
  Likeness likeness_;
  std::vector<Course> courses_;
  Trial trial_;
  double gain_ = 0;  // of the course, a query
  std::unique_ptr<FollowedCourse> course_;
  std::deque<Answer> alone_;    // of the queries that wait, each judged by itself
  std::deque<Chance> chance_;   // and their chances
  std::deque<Size> row_alone_;  // of the first candidate of each of the last queries, judged by itself
  std::deque<Chances> history_;
  std::optional<std::uint64_t> map_digest_;
  std::vector<std::uint8_t> saved_;  // the state, if nothing has changed it
};

}  // namespace places

#endif
