// What the C functions have in common: they refuse arguments, and what is thrown becomes a return code.

#ifndef SSRVLAD_INTERFACE_HPP
#define SSRVLAD_INTERFACE_HPP

#include <algorithm>
#include <exception>
#include <initializer_list>
#include <string>

#include "numbers.hpp"
#include "ssrvlad.h"

namespace places {

// An argument is out of range; `ssrvlad_last_error` says why.
struct Refused {};

// Refuses an argument, with a reason as of printf.
[[noreturn]] __attribute__((format(printf, 1, 2))) void refuse(const char *reason, ...);

// Sets what `ssrvlad_last_error` says.
void say(const char *reason);

// Runs a function of the interface; what it throws becomes a return code.
template <typename Function>
int guarded(Function function) {
  try {
    function();
    return SSRVLAD_OK;
  } catch (const Refused &) {
    return SSRVLAD_WRONG_ARGUMENT;
  } catch (const std::exception &) {  // bad_alloc, or length_error of sizes beyond memory
    say("not enough memory");
    return SSRVLAD_NO_MEMORY;
  }
}

// Runs a function that changes an object. Where memory was short the object is not whole, and is changed no more.
template <typename Object, typename Function>
int changed(Object *object, Function function) {
  const int status = guarded([&] {
    if (object && !object->is_whole) refuse("memory was not enough for an earlier call");
    function();
  });
  if (status == SSRVLAD_NO_MEMORY) object->is_whole = false;
  return status;
}

// What a function makes for a program of this interface, or NULL.
template <typename Function>
auto made(int program, Function function) -> decltype(function()) {
  decltype(function()) result = nullptr;
  guarded([&] {
    if (program != SSRVLAD_INTERFACE)
      refuse("the library ssrvlad has interface %d, the program is of %d: compile it again",
             SSRVLAD_INTERFACE, program);
    result = function();
  });
  return result;
}

inline void require(bool holds, const char *expected = "arguments in range") {
  if (!holds) refuse("expected %s", expected);
}

inline void require_range(const char *name, double value, double lowest, double highest) {
  if (!(value >= lowest && value <= highest))
    refuse("%s: expected %.10g to %.10g, got %.10g", name, lowest, highest, value);
}

// That of `SSRVLADConfig.fingerprint`, 16 hexadecimal digits.
std::string fingerprint_of(const ssrvlad_settings &settings);

// Whether an array of these sizes may be in memory, so that the product and its bytes do not overflow.
inline bool may_be(std::initializer_list<Size> sizes) {
  Size most = Size{1} << 58;
  return std::all_of(sizes.begin(), sizes.end(), [&](Size size) {
    return size >= 0 && (most /= std::max<Size>(1, size)) > 0;
  });
}

}  // namespace places

#endif
