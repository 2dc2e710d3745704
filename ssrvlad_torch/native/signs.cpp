// The signs of signs.hpp.

#include "signs.hpp"

#include "parallel.hpp"

namespace places {

namespace {

SSRVLAD_INLINE int ones(Word word) { return __builtin_popcountll(word); }

// The bits in which some words differ from others.
template <class Processor>
SSRVLAD_INLINE Word differing_bits(Processor, const Word *words_of_one, const Word *words_of_other, Size words) {
  Word sums[4] = {};
  Size i = 0;
  for (; i + 4 <= words; i += 4)
    for (int lane = 0; lane < 4; ++lane) sums[lane] += static_cast<Word>(ones(words_of_one[i + lane] ^ words_of_other[i + lane]));
  for (; i < words; ++i) sums[0] += static_cast<Word>(ones(words_of_one[i] ^ words_of_other[i]));
  return sums[0] + sums[1] + sums[2] + sums[3];
}

#ifdef SSRVLAD_X86
// The same by vectors of four words: bits of half bytes from a table, summed in bytes, then in words.
__attribute__((target("avx2,popcnt"))) inline Word differing_bits(Avx2, const Word *words_of_one, const Word *words_of_other,
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
      const __m256i one = _mm256_loadu_si256(reinterpret_cast<const __m256i *>(words_of_one + i));
      const __m256i other = _mm256_loadu_si256(reinterpret_cast<const __m256i *>(words_of_other + i));
      const __m256i bits = _mm256_xor_si256(one, other);
      const __m256i high = _mm256_and_si256(_mm256_srli_epi16(bits, 4), low);
      bytes = _mm256_add_epi8(bytes, _mm256_shuffle_epi8(table, _mm256_and_si256(bits, low)));
      bytes = _mm256_add_epi8(bytes, _mm256_shuffle_epi8(table, high));
    }
    sums = _mm256_add_epi64(sums, _mm256_sad_epu8(bytes, _mm256_setzero_si256()));
  }
  const __m128i two = _mm_add_epi64(_mm256_castsi256_si128(sums), _mm256_extracti128_si256(sums, 1));
  Word bits = static_cast<Word>(_mm_cvtsi128_si64(two) + _mm_extract_epi64(two, 1));
  for (; i < words; ++i) bits += static_cast<Word>(ones(words_of_one[i] ^ words_of_other[i]));
  return bits;
}
#endif

}  // namespace

void count_moves(const Word *query, const Word *rows, Size count, const SignGrid &grid,
                 std::int32_t *differing) {
  on_cpu([=](auto processor) {
    const Word *row = rows;
    for (Size number = 0; number < count; ++number, row += grid.size())
      for (Size move = 0; move < grid.moves(); ++move)
        differing[move * count + number] = static_cast<std::int32_t>(differing_bits(
            processor, query + grid.ours(move) * grid.words, row + grid.theirs(move) * grid.words,
            grid.overlapping(move) * grid.words));
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
