// Arguments of the C functions that are out of range.

#ifndef SSRVLAD_INTERFACE_HPP
#define SSRVLAD_INTERFACE_HPP

#include <algorithm>
#include <initializer_list>

#include "numbers.hpp"
#include "ssrvlad.h"

namespace places {

// An argument is out of range, or a function of the caller refused.
struct Failed {
  std::int64_t code;
};

inline void require(bool holds) {
  if (!holds) throw Failed{SSRVLAD_WRONG_ARGUMENT};
}

// Whether an array of these sizes may be in memory, so that the product and its bytes do not overflow.
inline bool may_be(std::initializer_list<Size> sizes) {
  Size most = Size{1} << 58;
  return std::all_of(sizes.begin(), sizes.end(), [&](Size size) {
    return size >= 0 && (most /= std::max<Size>(1, size)) > 0;
  });
}

}  // namespace places

#endif
