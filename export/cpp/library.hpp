// Whether the library of the core is the one for which a program was compiled.

#pragma once

#include <stdexcept>
#include <string>

#include "ssrvlad.h"

namespace ssrvlad::detail {

inline void require_interface() {
  if (ssrvlad_interface() != SSRVLAD_INTERFACE)
    throw std::runtime_error("the library ssrvlad has interface " + std::to_string(ssrvlad_interface()) +
                             ", the program is of " + std::to_string(SSRVLAD_INTERFACE) +
                             ": compile it again");
}

}  // namespace ssrvlad::detail
