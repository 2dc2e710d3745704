// From the scores of one drive to a decision: is it followed along the map, and how; which rows are the
// best candidates of each query; how sure is the first.
//
//   places::Listing map({{0, 4000}, 9000});           // two drives, 9000 rows
//   auto found = places::decide(map, scores, true, 2, 5);  // places::Scores of these rows; by two threads
//   found.rows[query * found.top];                    // the first candidate, -1 for none
//   found.right[query];                               // the probability that it is right

#ifndef SSRVLAD_DECIDE_HPP
#define SSRVLAD_DECIDE_HPP

#include <vector>

#include "confidence.hpp"
#include "filter.hpp"
#include "progress.hpp"

namespace places {

constexpr double HIGHEST_SCORE = 1.001;  // that rounding can give

// The scores of the queries of one drive against all rows of a map.
class Scores {
 public:
  virtual ~Scores() = default;
  virtual Size queries() const = 0;
  // Fills a number for each row, of at most 1, as cosines are; NONE where there can be no match.
  virtual void of(Size query, float *scores) const = 0;
};

// How queries run a map: the way, the rate of `Motion`, and as how many streams whose frames alternate.
struct Course {
  int way = FORWARDS;
  double rate = 1;
  Size streams = 1;
};

// Candidates of Q queries, (Q, top): scores, falling, NONE for none, and rows, -1 for none.
struct Matches {
  Size top;
  std::vector<float> scores;
  std::vector<Size> rows;

  Matches(Size queries, Size top);
};

// Where the queries of a drive are that is followed: scores are the probabilities of the rows; `near` is
// that of the rows within `near` of the first, `unmapped` that of a place that the map lacks.
struct Places : Matches {
  std::vector<float> near, unmapped;
  std::vector<double> chance;

  Places(Size queries, Size top);
};

// Scores of a query alone are the scores of its rows; of a followed one `Places::near` of the first, and
// the probabilities of the others. An empty query has no candidate. Each of `right`, `spread` and
// `together` has Q numbers: the probability that the first candidate is right, its standard deviation,
// and how many neighbouring queries err together.
struct Decision : Matches {
  std::vector<float> right, spread, together;
  bool followed = false;                // any query
  std::vector<std::uint8_t> follows;    // Q: whether each is
  Course course;    // that was taken, or would have been
  double gain = 0;  // a query of the course; 0 without one

  using Matches::Matches;
};

// The scores are those of the listed rows. Each query is judged alone, or by all queries of its sequence if it is
// to be followed. A top out of range is not looked for.
Decision decide(const Listing &listing, const Scores &scores, bool follow, int threads, Size top);

}  // namespace places

#endif
