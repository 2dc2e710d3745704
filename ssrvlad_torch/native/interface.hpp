// Arguments of the C functions that are out of range.

#ifndef SSRVLAD_INTERFACE_HPP
#define SSRVLAD_INTERFACE_HPP

#include <algorithm>
#include <initializer_list>

#include "numbers.hpp"
#include "ssrvlad.h"

namespace places {

// An argument is out of range, or a function of the caller refused; `ssrvlad_last_error` says why.
struct Failed {
  std::int64_t code;
};

// Refuses an argument, with a reason as of printf.
[[noreturn]] __attribute__((format(printf, 1, 2))) void refuse(const char *reason, ...);

inline void require(bool holds, const char *expected = "arguments in range") {
  if (!holds) refuse("expected %s", expected);
}

inline void require_range(const char *name, double value, double lowest, double highest) {
  if (!(value >= lowest && value <= highest))
    refuse("%s: expected %.10g to %.10g, got %.10g", name, lowest, highest, value);
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
