// The scores of the queries of one drive against all rows of a map.

#ifndef SSRVLAD_SCORES_HPP
#define SSRVLAD_SCORES_HPP

#include "numbers.hpp"

namespace places {

// Of a drive that has a mean of its own, and shows which channel leads; of a map that gives confidence.
constexpr Size MIN_FRAMES = 30;
// What the first frames of a sequence have in common is their place: to their mean so many frames like what was
// before are added.
constexpr Size BEFORE = 10;

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
