// Bits that differ, counted by the fastest instruction of the processor.

#ifndef SSRVLAD_BITS_HPP
#define SSRVLAD_BITS_HPP

#include "numbers.hpp"

namespace places {

using Word = std::uint64_t;

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

using BitCounter = Word (*)(const Word *, const Word *, const Word *, Size);

inline Word count_plain(const Word *query, const Word *mask, const Word *row, Size words) {
  return differing_bits(query, mask, row, words);
}

#if defined(__x86_64__) && defined(__GNUC__)
__attribute__((target("popcnt"))) inline Word count_by_word(const Word *query, const Word *mask,
                                                            const Word *row, Size words) {
  return differing_bits(query, mask, row, words);
}

__attribute__((target("avx512f,avx512vpopcntdq"))) inline Word count_by_vector(
    const Word *query, const Word *mask, const Word *row, Size words) {
  return differing_bits(query, mask, row, words);
}

inline bool counts_by_vector() {
  __builtin_cpu_init();
  return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vpopcntdq");
}

inline BitCounter bit_counter() {
  if (counts_by_vector()) return count_by_vector;
  return __builtin_cpu_supports("popcnt") ? count_by_word : count_plain;
}
#else
inline BitCounter bit_counter() { return count_plain; }
#endif

}  // namespace places

#endif
