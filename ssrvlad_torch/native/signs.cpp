// The signs of signs.hpp.

#include "signs.hpp"

#if defined(__x86_64__) && defined(__GNUC__)
#include <immintrin.h>
#endif

#include "parallel.hpp"

namespace places {

namespace {

constexpr Size SCANNED_ROWS = 1024;

SSRVLAD_INLINE int ones(Word word) {
#if defined(__GNUC__)
  return __builtin_popcountll(word);
#else
  int bits = 0;
  for (; word; word &= word - 1) ++bits;
  return bits;
#endif
}

// The bits in which some words differ from others.
SSRVLAD_INLINE Word differing_bits(const Word *some, const Word *others, Size words) {
  Word sums[4] = {};
  Size i = 0;
  for (; i + 4 <= words; i += 4)
    for (int lane = 0; lane < 4; ++lane) sums[lane] += static_cast<Word>(ones(some[i + lane] ^ others[i + lane]));
  for (; i < words; ++i) sums[0] += static_cast<Word>(ones(some[i] ^ others[i]));
  return sums[0] + sums[1] + sums[2] + sums[3];
}

#if defined(__x86_64__) && defined(__GNUC__)
// The same by vectors of four words: bits of half bytes from a table, summed in bytes, then in words.
__attribute__((target("avx2,popcnt"))) inline Word bits_by_table(const Word *some, const Word *others,
                                                                 Size words) {
  constexpr Size AT_ONCE = 4, IN_A_BYTE = 31 * AT_ONCE;
  const __m256i low = _mm256_set1_epi8(15);
  const __m256i table = _mm256_broadcastsi128_si256(
      _mm_setr_epi8(0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3, 4));
  __m256i sums = _mm256_setzero_si256();
  Size i = 0;
  for (const Size whole = words - words % AT_ONCE; i < whole;) {
    __m256i bytes = _mm256_setzero_si256();
    for (const Size last = std::min(whole, i + IN_A_BYTE); i < last; i += AT_ONCE) {
      const __m256i one = _mm256_loadu_si256(reinterpret_cast<const __m256i *>(some + i));
      const __m256i other = _mm256_loadu_si256(reinterpret_cast<const __m256i *>(others + i));
      const __m256i bits = _mm256_xor_si256(one, other);
      const __m256i high = _mm256_and_si256(_mm256_srli_epi16(bits, 4), low);
      bytes = _mm256_add_epi8(bytes, _mm256_shuffle_epi8(table, _mm256_and_si256(bits, low)));
      bytes = _mm256_add_epi8(bytes, _mm256_shuffle_epi8(table, high));
    }
    sums = _mm256_add_epi64(sums, _mm256_sad_epu8(bytes, _mm256_setzero_si256()));
  }
  const __m128i two = _mm_add_epi64(_mm256_castsi256_si128(sums), _mm256_extracti128_si256(sums, 1));
  Word bits = static_cast<Word>(_mm_cvtsi128_si64(two) + _mm_extract_epi64(two, 1));
  for (; i < words; ++i) bits += static_cast<Word>(ones(some[i] ^ others[i]));
  return bits;
}
#endif

template <typename Count>
SSRVLAD_INLINE void differing_moves(Count count_bits, const Word *query, const Word *rows, Size count,
                                    const SignGrid &grid, std::int32_t *differing) {
  for (Size row = 0; row < count; ++row, rows += grid.size())
    for (Size move = 0; move < grid.moves(); ++move)
      differing[move * count + row] = static_cast<std::int32_t>(
          count_bits(query + grid.ours(move) * grid.words, rows + grid.theirs(move) * grid.words,
                     grid.overlapping(move) * grid.words));
}

// The score of each row by the best move, where `bits` bits of a column count.
template <typename Count>
SSRVLAD_INLINE void best_moves(Count count_bits, const Word *query, const Word *rows, Size count, const SignGrid &grid,
                               Size bits, float *scores) {
  for (Size row = 0; row < count; ++row, rows += grid.size()) {
    float best = -1;
    for (Size move = -grid.reach; move <= grid.reach; ++move) {
      const Size left = std::max<Size>(0, -move), right = std::max<Size>(0, move);
      const Size kept = grid.columns - left - right;
      const auto other = static_cast<float>(count_bits(
          query + left * grid.words, rows + right * grid.words, kept * grid.words));
      best = std::max(best, 1 - 2 * other / static_cast<float>(kept * bits));
    }
    scores[row] = best;
  }
}

struct BitsByWord {
  SSRVLAD_INLINE Word operator()(const Word *some, const Word *others, Size words) const {
    return differing_bits(some, others, words);
  }
};
constexpr BitsByWord bits_by_word;

// The loops that count bits, for one kind of processor.
struct BitCounters {
  void (*moves)(const Word *, const Word *, Size, const SignGrid &, std::int32_t *);
  void (*best)(const Word *, const Word *, Size, const SignGrid &, Size, float *);
};

#define SSRVLAD_COUNTERS(name, target, count_bits)                                                              \
  target void moves_##name(const Word *query, const Word *rows, Size count, const SignGrid &grid,   \
                           std::int32_t *differing) {                                               \
    differing_moves(count_bits, query, rows, count, grid, differing);                                           \
  }                                                                                                 \
  target void best_##name(const Word *query, const Word *rows, Size count, const SignGrid &grid,    \
                          Size bits, float *scores) {                                               \
    best_moves(count_bits, query, rows, count, grid, bits, scores);                                             \
  }                                                                                                 \
  constexpr BitCounters name = {moves_##name, best_##name};

SSRVLAD_COUNTERS(plainly, , bits_by_word)
#if defined(__x86_64__) && defined(__GNUC__)
SSRVLAD_COUNTERS(by_word, __attribute__((target("popcnt"))), bits_by_word)
SSRVLAD_COUNTERS(by_table, __attribute__((target("avx2,popcnt"))), bits_by_table)
SSRVLAD_COUNTERS(by_vector, __attribute__((target("avx512f,avx512vpopcntdq"))), bits_by_word)
#endif

BitCounters counters() {
#if defined(__x86_64__) && defined(__GNUC__)
  __builtin_cpu_init();
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vpopcntdq"))
    return by_vector;
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("popcnt")) return by_table;
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

void scan_signs(const Word *queries, Size count, const Word *rows, Size references,
                const SignGrid &grid, Size bits, int threads, float *scores) {
  const BitCounters counter = counters();
  over_blocks(references, SCANNED_ROWS, threads, [&](Size first, Size last) {
    for (Size query = 0; query < count; ++query)
      counter.best(queries + query * grid.size(), rows + first * grid.size(), last - first, grid, bits,
                   scores + query * references + first);
  });
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
