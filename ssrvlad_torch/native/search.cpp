// The searches of search.hpp.

#include "search.hpp"

#include <algorithm>
#include <functional>

#include "parallel.hpp"
#include "products.hpp"

namespace places {

namespace {

constexpr Size ROWS = 96, QUERIES = 1024;  // that are multiplied at once, at most
constexpr Size LANES = SSRVLAD_LANES;

// Divides products by the lengths of their rows, NONE for length 0, and returns the highest score.
float divide(float *products, const float *lengths, Size count) {
  return on_cpu([=](auto) {
    float highest = NONE;
    for (Size row = 0; row < count; ++row) {
      products[row] = lengths[row] > 0 ? products[row] / lengths[row] : NONE;
      highest = products[row] > highest ? products[row] : highest;
    }
    return highest;
  });
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

// The score of each of LANES rows by the best of several vectors of weights. Number n of `length` of
// row r is numbers[n * LANES + r].
void best_anchors(const float *weights, const float *offsets, Size anchors,
                  const float *numbers, Size length, float *scores) {
  on_cpu([=](auto) {
    for (Size lane = 0; lane < LANES; ++lane) scores[lane] = -std::numeric_limits<float>::infinity();
    for (Size anchor = 0; anchor < anchors; ++anchor) {
      float sums[LANES];
      for (Size lane = 0; lane < LANES; ++lane) sums[lane] = offsets[anchor];
      for (Size n = 0; n < length; ++n) {
        const float weight = weights[anchor * length + n], *number = numbers + n * LANES;
        for (Size lane = 0; lane < LANES; ++lane) sums[lane] += weight * number[lane];
      }
      for (Size lane = 0; lane < LANES; ++lane) scores[lane] = std::max(scores[lane], sums[lane]);
    }
  });
}

}  // namespace

void match(const ssrvlad_rows &given, const float *queries, Size count, Size top, int threads,
           float *scores, std::int64_t *rows) {
  const Size share = (count + threads - 1) / std::max(1, threads);
  over_blocks(count, std::clamp<Size>(share, 1, QUERIES), threads, [&](Size first, Size last) {
    match(given, queries, first, last, top, scores, rows);
  });
}

void scan_vectors(const float *weights, const float *offsets, Size count, Size anchors,
                  const std::int8_t *codes, Size blocks, Size length, int threads, float *scores) {
  const bool done = in_parallel(blocks, threads, [&](std::atomic<Size> &next) {
    std::vector<float> numbers(static_cast<std::size_t>(length * LANES));
    for (Size block; (block = next++) < blocks;) {
      const std::int8_t *code = codes + block * length * LANES;
      for (Size i = 0; i < length * LANES; ++i) numbers[static_cast<std::size_t>(i)] = code[i];
      for (Size query = 0; query < count; ++query)
        best_anchors(weights + query * anchors * length, offsets + query * anchors, anchors,
                     numbers.data(), length, scores + (query * blocks + block) * LANES);
    }
  });
  if (!done) throw std::bad_alloc();
}

}  // namespace places
