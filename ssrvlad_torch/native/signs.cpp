// The signs of signs.hpp, and their functions of ssrvlad.h.

#include "signs.hpp"

#include "parallel.hpp"
#include "ssrvlad.h"

namespace places {

namespace {

constexpr Size ROWS_AT_ONCE = 64, SCANNED_ROWS = 1024;

SSRVLAD_INLINE int ones(Word word) {
#if defined(__GNUC__)
  return __builtin_popcountll(word);
#else
  int bits = 0;
  for (; word; word &= word - 1) ++bits;
  return bits;
#endif
}

// The bits under a mask in which a query differs from a row.
SSRVLAD_INLINE Word differing_bits(const Word *query, const Word *mask, const Word *row, Size words) {
  Word bits = 0;
  for (Size i = 0; i < words; ++i) bits += static_cast<Word>(ones((query[i] ^ row[i]) & mask[i]));
  return bits;
}

SSRVLAD_INLINE Word differing_bits(const Word *some, const Word *others, Size words) {
  Word bits = 0;
  for (Size i = 0; i < words; ++i) bits += static_cast<Word>(ones(some[i] ^ others[i]));
  return bits;
}

SSRVLAD_INLINE void differing_moves(const Word *query, const Word *rows, Size count,
                                    const SignGrid &grid, std::int32_t *differing) {
  for (Size row = 0; row < count; ++row, rows += grid.size())
    for (Size move = 0; move < grid.moves(); ++move)
      differing[move * count + row] = static_cast<std::int32_t>(
          differing_bits(query + grid.ours(move) * grid.words, rows + grid.theirs(move) * grid.words,
                         grid.overlapping(move) * grid.words));
}

// The score of each row by the best move, where `bits` bits of a column count.
SSRVLAD_INLINE void best_moves(const Word *query, const Word *rows, Size count, const SignGrid &grid,
                               Size bits, float *scores) {
  for (Size row = 0; row < count; ++row, rows += grid.size()) {
    float best = -1;
    for (Size move = -grid.reach; move <= grid.reach; ++move) {
      const Size left = std::max<Size>(0, -move), right = std::max<Size>(0, move);
      const Size kept = grid.columns - left - right;
      const auto other = static_cast<float>(differing_bits(
          query + left * grid.words, rows + right * grid.words, kept * grid.words));
      best = std::max(best, 1 - 2 * other / static_cast<float>(kept * bits));
    }
    scores[row] = best;
  }
}

// The loops that count bits, for one kind of processor.
struct BitCounters {
  Word (*differing)(const Word *, const Word *, const Word *, Size);
  void (*moves)(const Word *, const Word *, Size, const SignGrid &, std::int32_t *);
  void (*best)(const Word *, const Word *, Size, const SignGrid &, Size, float *);
};

#define SSRVLAD_COUNTERS(name, target)                                                              \
  target Word differing_##name(const Word *query, const Word *mask, const Word *row, Size words) {  \
    return differing_bits(query, mask, row, words);                                                 \
  }                                                                                                 \
  target void moves_##name(const Word *query, const Word *rows, Size count, const SignGrid &grid,   \
                           std::int32_t *differing) {                                               \
    differing_moves(query, rows, count, grid, differing);                                           \
  }                                                                                                 \
  target void best_##name(const Word *query, const Word *rows, Size count, const SignGrid &grid,    \
                          Size bits, float *scores) {                                               \
    best_moves(query, rows, count, grid, bits, scores);                                             \
  }                                                                                                 \
  constexpr BitCounters name = {differing_##name, moves_##name, best_##name};

SSRVLAD_COUNTERS(plainly, )
#if defined(__x86_64__) && defined(__GNUC__)
SSRVLAD_COUNTERS(by_word, __attribute__((target("popcnt"))))
SSRVLAD_COUNTERS(by_vector, __attribute__((target("avx512f,avx512vpopcntdq"))))
#endif

BitCounters counters() {
#if defined(__x86_64__) && defined(__GNUC__)
  __builtin_cpu_init();
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vpopcntdq"))
    return by_vector;
  if (__builtin_cpu_supports("popcnt")) return by_word;
#endif
  return plainly;
}

}  // namespace

void count_moves(const Word *query, const Word *rows, Size count, const SignGrid &grid,
                 std::int32_t *differing) {
  static const BitCounters counter = counters();
  counter.moves(query, rows, count, grid, differing);
}

void weigh(const std::uint8_t *row, Size bytes, Size groups, const float *weights, float *sums) {
  for (Size group = 0; group < groups; ++group) {
    float low = 0, high = 0;
    for (Size i = 0; i < bytes / groups; ++i, ++row, weights += 2 * NIBBLES) {
      low += weights[*row & (NIBBLES - 1)];
      high += weights[NIBBLES + *row / NIBBLES];
    }
    sums[group] = low + high;
  }
}

}  // namespace places

using namespace places;

int ssrvlad_differing(const uint64_t *queries, const uint64_t *masks, int64_t count,
                      const uint64_t *rows, int64_t references, int64_t words, int threads,
                      int32_t *differing) {
  if (!queries || !masks || !rows || !differing || count < 0 || references < 0 || words < 1)
    return SSRVLAD_WRONG_ARGUMENT;
  try {
    const BitCounters counter = counters();
    over_blocks(references, ROWS_AT_ONCE, threads, [&](Size first, Size last) {
      for (Size row = first; row < last; ++row)
        for (Size query = 0; query < count; ++query)
          differing[query * references + row] = static_cast<std::int32_t>(counter.differing(
              queries + query * words, masks + query * words, rows + row * words, words));
    });
    return SSRVLAD_OK;
  } catch (const std::bad_alloc &) {
    return SSRVLAD_NO_MEMORY;
  }
}

int ssrvlad_scan_signs(const uint64_t *queries, int64_t count, const uint64_t *rows,
                       int64_t references, int64_t columns, int64_t words, int64_t bits,
                       int64_t reach, int threads, float *scores) {
  if (!queries || !rows || !scores || count < 0 || references < 0 || words < 1 || bits < 1 ||
      reach < 0 || reach >= columns)
    return SSRVLAD_WRONG_ARGUMENT;
  try {
    const SignGrid grid{columns, words, reach};
    const BitCounters counter = counters();
    over_blocks(references, SCANNED_ROWS, threads, [&](Size first, Size last) {
      for (Size query = 0; query < count; ++query)
        counter.best(queries + query * grid.size(), rows + first * grid.size(), last - first, grid, bits,
                     scores + query * references + first);
    });
    return SSRVLAD_OK;
  } catch (const std::bad_alloc &) {
    return SSRVLAD_NO_MEMORY;
  }
}

int ssrvlad_weigh(const uint8_t *rows, int64_t references, int64_t bytes, int64_t groups,
                  const float *weights, int threads, float *sums) {
  if (!rows || !weights || !sums || references < 0 || groups < 1 || bytes < 1 || bytes % groups)
    return SSRVLAD_WRONG_ARGUMENT;
  try {
    over_blocks(references, ROWS_AT_ONCE, threads, [&](Size first, Size last) {
      for (Size row = first; row < last; ++row)
        weigh(rows + row * bytes, bytes, groups, weights, sums + row * groups);
    });
    return SSRVLAD_OK;
  } catch (const std::bad_alloc &) {
    return SSRVLAD_NO_MEMORY;
  }
}
