// Descriptors of signs, packed in bits, on a grid of cells: in how many they differ, moved, and their means.

#ifndef SSRVLAD_SIGNS_HPP
#define SSRVLAD_SIGNS_HPP

#include <cstdint>
#include <vector>

#include "numbers.hpp"

namespace places {

using Word = std::uint64_t;

// Signs on a grid of cells, column after column, each of so many bytes in whole words. One side is moved by up to
// `across` columns to each side, and by up to `along` rows up and down.
struct SignGrid {
  Size columns, rows, bytes, across = 0, along = 0;

  // Swept, both sides may be up to 3 columns and 2 rows apart.
  SignGrid swept() const { return {columns, rows, bytes, std::min<Size>(3, columns - 1), std::min<Size>(2, rows - 1)}; }
  Size cells() const { return columns * rows; }
  Size bits() const { return 8 * bytes; }         // of a cell
  Size words() const { return (bytes + 7) / 8; }  // of a cell
  Size column() const { return rows * words(); }
  Size size() const { return columns * column(); }
  Size moves() const { return (2 * across + 1) * (2 * along + 1); }

  // The cells of both sides that overlap in a move: the first of the side that is moved, the first of the
  // other, and how many.
  struct Overlap {
    Size our_column, our_row, their_column, their_row, columns, rows;
  };
  Overlap overlap(Size move) const {
    const Size right = move / (2 * along + 1) - across, down = move % (2 * along + 1) - along;
    return {std::max<Size>(0, -right), std::max<Size>(0, -down), std::max<Size>(0, right), std::max<Size>(0, down),
            columns - std::abs(right), rows - std::abs(down)};
  }
  // The signs that overlap in a move.
  Size overlapping(Size move) const {
    const Overlap cells = overlap(move);
    return bits() * cells.columns * cells.rows;
  }
};

// The words of signs that are bytes of `count` frames.
std::vector<Word> packed(const std::uint8_t *signs, Size count, const SignGrid &grid);

// Counts the bits of the cells that overlap in which signs, moved, differ from each of `count` rows:
// differing[move * count + row].
void count_moves(const Word *signs, const Word *rows, Size count, const SignGrid &grid, std::int32_t *differing);

// The same of the signs where they are, over the cells of the rows that overlap in each move.
void count_in_place(const Word *signs, const Word *rows, Size count, const SignGrid &grid, std::int32_t *differing);

// Numbers from -1 to 1, one for each sign, as a weighted sum of signs 1 and -1.
struct SignMean {
  std::vector<Word> planes;     // the signs of each weight
  std::vector<double> weights;  // none if the numbers are nothing
  std::vector<double> squares;  // of the numbers of each cell

  // The mean of signs; nothing for one of signs that are all equal, of which it would leave nothing.
  static SignMean of(const Word *signs, Size count, const SignGrid &grid);
  // Numbers (columns, rows, bits), rounded to 18 binary digits; nothing if all are 1 and -1.
  static SignMean near(const float *numbers, const SignGrid &grid);
  // Numbers of whatever value, rounded to so many digits, or as often up as down, so that errors do not add up;
  // without squares.
  static SignMean rounded(const float *numbers, int digits, bool up_and_down, const SignGrid &grid);

  Size count() const { return static_cast<Size>(weights.size()); }
};

// By move, the products of signs, moved, with a mean, and of a mean, moved, with another.
std::vector<double> products(const Word *signs, const SignMean &mean, const SignGrid &grid);
std::vector<double> products(const SignMean &mean, const SignMean &other, const SignGrid &grid);
// Those of a mean with rows, moved or in place as bits are counted: products[move * count + row].
void products(const SignMean &mean, const Word *rows, Size count, const SignGrid &grid, decltype(count_moves) count_in,
              float *products);

std::vector<double> numbers(const SignMean &mean, const SignGrid &grid);

// The squared lengths of the cells of signs without a mean.
std::vector<double> squares(const Word *signs, const SignMean &mean, const SignGrid &grid);

// By move, the length of the cells that overlap, by their squares, of the side that is moved or of the other.
std::vector<float> lengths(const std::vector<double> &squares, const SignGrid &grid, bool is_moved);

}  // namespace places

#endif
