// Products of vectors in single precision. Each is summed in the order of the numbers by fused
// multiply-adds, which round once: the same bits on every processor.

#ifndef SSRVLAD_PRODUCTS_HPP
#define SSRVLAD_PRODUCTS_HPP

#include <vector>

#include "numbers.hpp"

namespace places {

// Items of one or several vectors, packed to be multiplied with many rows.
class Panels {
 public:
  Panels() = default;
  // `count` items of `anchors` vectors of `length` numbers each. Zero vectors are left out, unless
  // all vectors of an item are zero: then its products are 0.
  Panels(const float *vectors, Size count, Size anchors, Size length);

  Size count() const { return count_; }
  // For each item the highest of the products of its vectors with each of `rows` rows:
  // scores[item * pitch + row].
  void best(const float *rows, Size count, float *scores, Size pitch) const;

 private:
  Size count_ = 0, length_ = 0;
  Size items_ = 1, lanes_ = 1, panels_ = 0;  // of a group: items, lanes of each, and panels
  std::vector<float> packed_;
};

}  // namespace places

#endif
