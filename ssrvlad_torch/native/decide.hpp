// From the scores of one drive to a decision: is it followed along the map, and how; which rows are the
// best candidates of each query; how sure is the first.
//
//   places::Drives map{{0, 4000}, 9000};              // two drives, 9000 rows
//   places::AllRows evidence(scores);                 // a places::Scores of these rows
//   auto found = places::decide(map, evidence, places::Mode::OFFLINE, 0, 5);
//   found.rows[query * found.top];                    // the first candidate, -1 for none
//   found.right[query];                               // the probability that it is right
//
// recognition/reference.py says the same plainly.

#ifndef SSRVLAD_DECIDE_HPP
#define SSRVLAD_DECIDE_HPP

#include <memory>
#include <vector>

#include "confidence.hpp"
#include "filter.hpp"
#include "progress.hpp"
#include "scores.hpp"

namespace places {

constexpr double HIGHEST_SCORE = 1.001;  // that rounding can give

// Scores are NaN or higher than HIGHEST_SCORE.
struct WrongScores {};

// Each query alone; by the queries before it, and `delay` later ones; by all queries.
enum class Mode { ALONE = 0, ONLINE = 1, OFFLINE = 2 };

// How queries run a map: the way, the rate of `Motion`, and as how many streams whose frames alternate.
struct Course {
  int way = FORWARDS;
  double rate = 1;
  Size streams = 1;
};

// What is known of one query: the listed rows of a map, the scores of the query there, and the number of
// rows of the map that could match, less than 0 for those that have a score.
struct Sight {
  Rows rows;
  std::vector<float> scores;
  Size matching = -1;
  Likelihood likelihood;  // if the query is followed
  std::vector<float> z;   // beside a row: by how many deviations each is nearer than the mean of all
};

// The queries of one drive, and how they fit a map. Not to be shared by threads.
class Evidence {
 public:
  virtual ~Evidence() = default;
  virtual Size queries() const = 0;
  // Of a query alone.
  virtual std::shared_ptr<const Sight> alone(const Drives &drives, Size query) const = 0;
  // Of a query that follows a belief, or is the first.
  virtual std::shared_ptr<const Sight> after(const Filter &filter, const Belief *before,
                                             Size query) const = 0;
  // Of a query alone, with the rows within NEAR of one listed; 0 deviations where there is no score.
  virtual std::shared_ptr<const Sight> beside(const Drives &drives, Size query, Size row) const = 0;
  // The scores of a query that was seen alone at rows that represent all, the same for each query.
  virtual std::vector<float> profile(const Sight &alone, Size query) const = 0;
};

// By the scores of all rows.
class AllRows : public Evidence {
 public:
  explicit AllRows(const Scores &scores) : scores_(scores) {}
  Size queries() const override { return scores_.queries(); }
  std::shared_ptr<const Sight> alone(const Drives &drives, Size query) const override;
  std::shared_ptr<const Sight> after(const Filter &filter, const Belief *before,
                                     Size query) const override;
  std::shared_ptr<const Sight> beside(const Drives &drives, Size query, Size row) const override;
  std::vector<float> profile(const Sight &alone, Size query) const override;

 private:
  const Scores &scores_;
  mutable std::shared_ptr<const Sight> last_;  // of the query, weight and level
  mutable Size query_ = -1;
  mutable double weight_ = 0, level_ = 0;
};

// Finds candidates for queries in a map that is too large to score every row, and scores any row.
class Search {
 public:
  virtual ~Search() = default;
  virtual Size queries() const = 0;
  // In any order, each once.
  virtual std::vector<Size> candidates(Size query) const = 0;
  // Fills the scores of rows, NONE where there can be no match.
  virtual void of(Size query, const std::vector<Size> &rows, float *scores) const = 0;
  // Of the nearness of all rows.
  virtual Spread spread(Size query) const = 0;
  // Rows that represent all rows, the same for each query, and their scores.
  virtual std::pair<std::vector<Size>, std::vector<float>> sample(Size query) const = 0;
};

// By the candidates of a search, and the rows to which those that were believed may have moved.
class Candidates : public Evidence {
 public:
  explicit Candidates(const Search &search) : search_(search) {}
  Size queries() const override { return search_.queries(); }
  std::shared_ptr<const Sight> alone(const Drives &drives, Size query) const override;
  std::shared_ptr<const Sight> after(const Filter &filter, const Belief *before,
                                     Size query) const override;
  std::shared_ptr<const Sight> beside(const Drives &drives, Size query, Size row) const override;
  std::vector<float> profile(const Sight &alone, Size query) const override;

 private:
  const Search &search_;
};

// Candidates of Q queries, (Q, top): scores, falling, NONE for none, and rows, -1 for none.
struct Matches {
  Size top;
  std::vector<float> scores;
  std::vector<Size> rows;

  Matches(Size queries, Size top);
};

// Where the queries of a drive are that is followed: scores are the probabilities of the rows; `near` is
// that of the rows within NEAR of the first, `unmapped` that of a place that the map lacks.
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
  bool followed = false;
  Course course;    // that was taken, or would have been
  double gain = 0;  // a query of the course; 0 without one

  using Matches::Matches;
};

// The numbers of queries that follow one another: 0, 1, ...
std::vector<Size> in_order(Size count);

// A motion, way, mode, delay or top out of range is not looked for. An `Evidence` may throw.
Decision decide(const Drives &drives, const Evidence &evidence, Mode mode, Size delay, Size top);

// Follows some queries as one stream in a way that the motion of the filter has.
Places follow(const Filter &filter, const Evidence &evidence, const std::vector<Size> &queries,
              Mode mode, Size delay, Size top);

// How much likelier queries are as a stream than each alone, as a logarithm.
double gain(const Filter &filter, const Evidence &evidence, const std::vector<Size> &queries);

}  // namespace places

#endif
