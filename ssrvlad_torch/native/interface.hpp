// What the functions of the C headers have in common.

#ifndef SSRVLAD_INTERFACE_HPP
#define SSRVLAD_INTERFACE_HPP

#include <exception>
#include <initializer_list>

#include "decide.hpp"
#include "ssrvlad_decide.h"

namespace places {

// An argument is out of range, or a function of the caller refused.
struct Failed {
  int64_t code;
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

// Runs a function of the interface; what it throws becomes a return code.
template <typename Function>
int guarded(Function function) {
  try {
    function();
    return SSRVLAD_OK;
  } catch (const Failed &failed) {
    return static_cast<int>(failed.code);
  } catch (const WrongScores &) {
    return SSRVLAD_WRONG_ARGUMENT;
  } catch (const std::exception &) {  // bad_alloc, or length_error of sizes beyond memory
    return SSRVLAD_NO_MEMORY;
  }
}

inline Drives drives_of(const ssrvlad_drives *map) {
  require(map && map->count >= 0 && map->rows >= 0 && (map->count > 0) == (map->rows > 0) &&
          (map->starts || !map->count));
  Drives drives;
  drives.rows = map->rows;
  drives.starts.assign(map->starts, map->starts + map->count);
  for (Size drive = 0; drive < map->count; ++drive)
    require(drive ? drives.starts[drive] > drives.starts[drive - 1] : !drives.starts[drive]);
  require(!map->count || drives.starts.back() < drives.rows);
  return drives;
}

template <typename Number, typename Other>
void give(const std::vector<Number> &values, Other *target) {
  require(target || values.empty());
  std::copy(values.begin(), values.end(), target);
}

inline void give(const Decision &found, ssrvlad_decision &decision) {
  give(found.scores, decision.scores);
  give(found.rows, decision.rows);
  give(found.right, decision.right);
  give(found.spread, decision.spread);
  give(found.together, decision.together);
  decision.followed = found.followed;
  decision.way = found.course.way;
  decision.rate = found.course.rate;
  decision.streams = found.course.streams;
  decision.gain = found.gain;
}

}  // namespace places

#endif
