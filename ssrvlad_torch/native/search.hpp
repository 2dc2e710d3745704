// The nearest rows by one channel: exactly, and roughly. See ssrvlad_map.h and ssrvlad.h.

#ifndef SSRVLAD_SEARCH_HPP
#define SSRVLAD_SEARCH_HPP

#include "numbers.hpp"
#include "ssrvlad_map.h"

namespace places {

void match(const ssrvlad_rows &given, const float *queries, Size count, Size top, int threads,
           float *scores, std::int64_t *rows);

void scan_vectors(const float *weights, const float *offsets, Size count, Size anchors,
                  const std::int8_t *codes, Size blocks, Size length, int threads, float *scores);

}  // namespace places

#endif
