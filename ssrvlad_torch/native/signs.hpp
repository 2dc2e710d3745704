// Descriptors of signs, packed in bits: how many differ, and what they weigh.

#ifndef SSRVLAD_SIGNS_HPP
#define SSRVLAD_SIGNS_HPP

#include <cstdint>

#include "numbers.hpp"

namespace places {

using Word = std::uint64_t;

constexpr Size NIBBLES = 16;

// Signs on a grid of `columns` columns of `words` words, moved by up to `reach` columns to each side.
struct SignGrid {
  Size columns, words, reach;

  Size size() const { return columns * words; }
  Size moves() const { return 2 * reach + 1; }
  // The first column of the query and of the row that overlap in a move, and their number.
  Size ours(Size move) const { return std::max<Size>(0, reach - move); }
  Size theirs(Size move) const { return std::max<Size>(0, move - reach); }
  Size overlapping(Size move) const { return columns - ours(move) - theirs(move); }
};

// Counts the bits of the columns that overlap in which a query differs from each of `count` rows:
// differing[move * count + row].
void count_moves(const Word *query, const Word *rows, Size count, const SignGrid &grid,
                 std::int32_t *differing);

// Sums, for each of `groups` groups of the bytes of a row, the weights (bytes, 2, NIBBLES) of their low
// and high nibbles.
void weigh(const std::uint8_t *row, Size bytes, Size groups, const float *weights, float *sums);

}  // namespace places

#endif
