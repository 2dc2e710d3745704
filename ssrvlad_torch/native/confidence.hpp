// How sure an answer is: beside its rivals, and among all answers of its drive.
//
// tests/oracles/recognition.py says both plainly.

#ifndef SSRVLAD_CONFIDENCE_HPP
#define SSRVLAD_CONFIDENCE_HPP

#include <vector>

#include "filter.hpp"

namespace places {

// The probability that a wrong answer is as far ahead of its rivals as the best of some rows is, and
// the row of the best rival, -1 without one.
struct Chance {
  double chance = 1;
  Size rival = -1;
};

// By the scores of listed rows; by the beliefs in them, of which those with a score may match; by values
// of any unit, NONE where there can be no match. `matching` is the number of rows of the map that could
// match; less than 0, those that are listed.
Chance chance_of_scores(const float *scores, const Rows &rows, Size matching);
Chance chance_of_beliefs(const float *beliefs, const float *scores, const Rows &rows,
                         Size matching);
Chance chance_of(const float *values, const Rows &rows, Size matching);

// How many neighbouring queries have the best rival of each, by the chances of the answers, NaN without one, and the
// rows of the rivals; 0 without an answer.
std::vector<double> rivals_together(const std::vector<double> &chances, const std::vector<Size> &rivals);
// The mean of that: how many neighbouring queries have one answer.
double answers_together(const std::vector<double> &rivals_together);

// The probability that the map has the place of each query of a sequence, by the chance of its answer by this
// query alone, NaN without an answer; so many neighbouring queries err together. 0 without an answer.
std::vector<double> mapped(const std::vector<double> &chances, double together);
// The same of a sequence that is followed, by how many deviations the place of each answer is nearer to its query
// than all rows in the mean, NaN without an answer. Where the map lacks the place, that is `chance_nearer`; how
// much nearer the right places are, the sequence shows. So many neighbouring queries have the rival of each.
std::vector<double> mapped_along(const std::vector<double> &nearer, const std::vector<double> &together);

// Whether answers of a sequence that is followed are hardly less ahead of their rivals than alone, by their chances,
// NaN without one.
bool are_hardly_less_ahead(const std::vector<double> &followed, const std::vector<double> &alone);

// Of each answer the probability that it is right, and its standard deviation; 0 without an answer.
struct Confidence {
  std::vector<float> right, spread;

  // By the chances of a drive, NaN without an answer, and the probability that the map has the place; so
  // many neighbouring queries err together. Of a drive that is followed few answers are wrong.
  static Confidence of(const std::vector<double> &chances, const std::vector<double> &mapped,
                       double together, bool followed);
};

}  // namespace places

#endif
