// The rows of the highest cosine, of ssrvlad_map.h.

#include <algorithm>
#include <functional>

#include "interface.hpp"
#include "parallel.hpp"
#include "products.hpp"
#include "ssrvlad_map.h"

namespace places {

namespace {

constexpr Size ROWS = 96, QUERIES = 1024;  // that are multiplied at once, at most

// Divides products by the lengths of their rows, NONE for length 0, and returns the highest score.
SSRVLAD_CLONES float divide(float *products, const float *lengths, Size count) {
  float highest = NONE;
  for (Size row = 0; row < count; ++row) {
    products[row] = lengths[row] > 0 ? products[row] / lengths[row] : NONE;
    highest = products[row] > highest ? products[row] : highest;
  }
  return highest;
}

// Puts a row among the best of a query, behind those of equal scores.
void take(float score, std::int64_t row, Size top, float *scores, std::int64_t *rows) {
  const auto at = std::upper_bound(scores, scores + top, score, std::greater<float>()) - scores;
  std::copy_backward(scores + at, scores + top - 1, scores + top);
  std::copy_backward(rows + at, rows + top - 1, rows + top);
  scores[at] = score;
  rows[at] = row;
}

void match(const ssrvlad_rows &given, const float *queries, Size first, Size last, Size top,
           float *scores, std::int64_t *rows) {
  const Panels panels(queries + first * given.length, last - first, 1, given.length);
  std::vector<float> products(static_cast<std::size_t>((last - first) * ROWS));
  for (Size start = 0; start < given.count; start += ROWS) {
    const Size count = std::min(ROWS, given.count - start);
    panels.best(given.vectors + start * given.length, count, products.data(), ROWS);
    for (Size query = first; query < last; ++query) {
      float *own = products.data() + (query - first) * ROWS, *best = scores + query * top;
      if (!(divide(own, given.lengths + start, count) > best[top - 1])) continue;
      const std::uint8_t *excluded =
          given.excluded ? given.excluded + query * given.count + start : nullptr;
      for (Size row = 0; row < count; ++row)
        if (own[row] > best[top - 1] && !(excluded && excluded[row]))
          take(own[row], given.first + start + row, top, best, rows + query * top);
    }
  }
}

}  // namespace

}  // namespace places

int ssrvlad_match(const ssrvlad_rows *given, const float *queries, int64_t count, int64_t top,
                  int threads, float *scores, int64_t *rows) {
  using namespace places;
  return guarded([&] {
    require(given && queries && scores && rows && count >= 0 && top >= 1 && given->count >= 0 &&
            given->length >= 1 && may_be({given->count, given->length}) &&
            may_be({count, given->length}) && may_be({count, top}) &&
            (!given->count || (given->vectors && given->lengths)));
    const Size share = (count + threads - 1) / std::max(1, threads);
    over_blocks(count, std::clamp<Size>(share, 1, QUERIES), threads, [&](Size first, Size last) {
      match(*given, queries, first, last, top, scores, rows);
    });
  });
}
