// The scores of the queries of one drive against all rows of a map.

#ifndef SSRVLAD_SCORES_HPP
#define SSRVLAD_SCORES_HPP

#include "numbers.hpp"

namespace places {

class Scores {
 public:
  virtual ~Scores() = default;
  virtual Size queries() const = 0;
  virtual Size rows() const = 0;
  // Fills `rows()` numbers of at most 1, as cosines are; NONE where there can be no match.
  virtual void of(Size query, float *scores) const = 0;
};

}  // namespace places

#endif
