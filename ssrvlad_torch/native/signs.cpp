// The signs of signs.hpp.

#include "signs.hpp"

#include "parallel.hpp"

namespace places {

namespace {

constexpr Size WORD_BITS = 64;
constexpr int DIGITS = 18;  // of numbers that are no counts

SSRVLAD_INLINE int ones(Word word) { return __builtin_popcountll(word); }

// The bits in which columns of some words differ from others, which are as far apart.
template <class Processor>
SSRVLAD_INLINE Word differing_bits(Processor, const Word *one, const Word *other, Size columns, Size words, Size step) {
  constexpr Size AT_ONCE = 4;
  Word sums[AT_ONCE] = {};
  for (Size column = 0; column < columns; ++column, one += step, other += step) {
    Size i = 0;
    for (; i + AT_ONCE <= words; i += AT_ONCE)
      for (Size lane = 0; lane < AT_ONCE; ++lane) sums[lane] += static_cast<Word>(ones(one[i + lane] ^ other[i + lane]));
    for (; i < words; ++i) sums[0] += static_cast<Word>(ones(one[i] ^ other[i]));
  }
  return sums[0] + sums[1] + sums[2] + sums[3];
}

#ifdef SSRVLAD_X86
#define SSRVLAD_AVX2 __attribute__((target("avx2,popcnt"))) inline

// Four words that differ, and as many of them as are left; the others are 0.
SSRVLAD_AVX2 __m256i differing_words(const Word *one, const Word *other) {
  return _mm256_xor_si256(_mm256_loadu_si256(reinterpret_cast<const __m256i *>(one)),
                          _mm256_loadu_si256(reinterpret_cast<const __m256i *>(other)));
}
SSRVLAD_AVX2 __m256i differing_words(const Word *one, const Word *other, Size left) {
  const __m256i mask = _mm256_cmpgt_epi64(_mm256_set1_epi64x(left), _mm256_setr_epi64x(0, 1, 2, 3));
  return _mm256_xor_si256(_mm256_maskload_epi64(reinterpret_cast<const long long *>(one), mask),
                          _mm256_maskload_epi64(reinterpret_cast<const long long *>(other), mask));
}

// The bits of the words of a vector: those of half bytes from a table.
SSRVLAD_AVX2 __m256i ones(__m256i bits) {
  const __m256i low = _mm256_set1_epi8(15);
  const __m256i table = _mm256_broadcastsi128_si256(_mm_setr_epi8(0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3, 4));
  const __m256i high = _mm256_and_si256(_mm256_srli_epi16(bits, 4), low);
  const __m256i bytes = _mm256_add_epi8(_mm256_shuffle_epi8(table, _mm256_and_si256(bits, low)), _mm256_shuffle_epi8(table, high));
  return _mm256_sad_epu8(bytes, _mm256_setzero_si256());
}

// Adds two bits in each place to a sum, which keeps the lower digit; returns the upper one.
SSRVLAD_AVX2 __m256i add(__m256i &sum, __m256i one, __m256i other) {
  const __m256i odd = _mm256_xor_si256(one, other);
  const __m256i upper = _mm256_or_si256(_mm256_and_si256(one, other), _mm256_and_si256(odd, sum));
  sum = _mm256_xor_si256(odd, sum);
  return upper;
}

// The same by vectors. Of eight vectors bits are added in binary digits, of which the eights are counted (Harley,
// Seal): columns of a picture have seven or eight.
SSRVLAD_AVX2 Word differing_bits(Avx2, const Word *one, const Word *other, Size columns, Size words, Size step) {
  constexpr Size AT_ONCE = 32;
  __m256i once = _mm256_setzero_si256(), twice = once, four_times = once, eights = once, rest = once;
  for (Size column = 0; column < columns; ++column, one += step, other += step) {
    const Word *a = one, *b = other;
    Size left = words;
    for (; left >= AT_ONCE - 4; left -= AT_ONCE, a += AT_ONCE, b += AT_ONCE) {
      const __m256i two = add(once, differing_words(a, b), differing_words(a + 4, b + 4));
      const __m256i four = add(once, differing_words(a + 8, b + 8), differing_words(a + 12, b + 12));
      const __m256i six = add(once, differing_words(a + 16, b + 16), differing_words(a + 20, b + 20));
      const __m256i eight = add(once, differing_words(a + 24, b + 24), differing_words(a + 28, b + 28, left - 28));
      const __m256i fours = add(twice, two, four), more = add(twice, six, eight);
      eights = _mm256_add_epi64(eights, ones(add(four_times, fours, more)));
    }
    for (; left > 0; left -= 4, a += 4, b += 4) rest = _mm256_add_epi64(rest, ones(differing_words(a, b, left)));
  }
  const __m256i sums = _mm256_add_epi64(
      _mm256_add_epi64(_mm256_slli_epi64(eights, 3), _mm256_slli_epi64(ones(four_times), 2)),
      _mm256_add_epi64(_mm256_slli_epi64(ones(twice), 1), _mm256_add_epi64(ones(once), rest)));
  const __m128i two = _mm_add_epi64(_mm256_castsi256_si128(sums), _mm256_extracti128_si256(sums, 1));
  return static_cast<Word>(_mm_cvtsi128_si64(two) + _mm_extract_epi64(two, 1));
}
#endif

// Adds signs to a sum, as binary digits of so many words; `count` signs are then in it.
void add(const Word *signs, Size words, Size count, std::vector<Word> &digits) {
  std::vector<Word> carry(signs, signs + words);
  for (Size digit = 0; count >> digit; ++digit) {
    if (static_cast<Size>(digits.size()) < (digit + 1) * words) digits.resize((digit + 1) * words);
    Word *place = digits.data() + digit * words;
    for (Size word = 0; word < words; ++word) {
      Word &carried = carry[word];
      const Word both = carried & place[word];
      place[word] ^= carried;
      carried = both;
    }
  }
}

// The products of the cells of signs with those of a mean.
std::vector<double> products_of_cells(const Word *signs, const SignMean &mean, const SignGrid &grid) {
  std::vector<double> products(grid.cells());
  on_cpu([&, grid](auto processor) {
    const Word *other = mean.planes.data();
    for (const double weight : mean.weights) {
      const Word *cell = signs;
      for (double &product : products) {
        const auto differing = static_cast<Size>(differing_bits(processor, cell, other, 1, grid.words(), 0));
        product += weight * static_cast<double>(grid.bits() - 2 * differing);
        cell += grid.words(), other += grid.words();
      }
    }
  });
  return products;
}

void add_squares(SignMean &mean, const SignGrid &grid) {
  mean.squares.resize(grid.cells());
  for (Size plane = 0; plane < mean.count(); ++plane) {
    const auto products = products_of_cells(mean.planes.data() + plane * grid.size(), mean, grid);
    const double weight = mean.weights[plane];
    for (std::size_t cell = 0; cell < products.size(); ++cell) mean.squares[cell] += weight * products[cell];
  }
}

}  // namespace

std::vector<Word> packed(const std::uint8_t *signs, Size count, const SignGrid &grid) {
  std::vector<Word> words(count * grid.size());
  for (Size cell = 0; cell < count * grid.cells(); ++cell)
    std::memcpy(words.data() + cell * grid.words(), signs + cell * grid.bytes, grid.bytes);
  return words;
}

void count_moves(const Word *signs, const Word *rows, Size count, const SignGrid &grid, std::int32_t *differing) {
  on_cpu([=, words = grid.words(), moves = grid.moves()](auto processor) {
    const Size step = grid.rows * words, size = grid.columns * step;
    for (Size number = 0; number < count; ++number)
      for (Size move = 0; move < moves; ++move) {
        const auto [ours, our_row, theirs, their_row, columns, cells] = grid.overlap(move);
        const Size at_once = cells == grid.rows ? columns : 1;  // columns without a gap between them
        differing[move * count + number] = static_cast<std::int32_t>(differing_bits(
            processor, signs + ours * step + our_row * words, rows + number * size + theirs * step + their_row * words,
            columns / at_once, at_once * cells * words, step));
      }
  });
}

void count_in_place(const Word *signs, const Word *rows, Size count, const SignGrid &grid, std::int32_t *differing) {
  const Size width = grid.rows + 1;
  std::vector<std::int32_t> sums((grid.columns + 1) * width);  // of the cells before each
  on_cpu([=, at = sums.data()](auto) {
    const Word *row = rows;
    for (Size number = 0; number < count; ++number) {
      const Word *other = signs;
      for (Size column = 0; column < grid.columns; ++column) {
        std::int32_t *here = at + (column + 1) * width, in_column = 0;
        for (Size cell = 0; cell < grid.rows; ++cell) {
          for (Size word = 0; word < grid.words(); ++word) in_column += ones(*other++ ^ *row++);
          here[cell + 1] = here[cell + 1 - width] + in_column;
        }
      }
      for (Size move = 0; move < grid.moves(); ++move) {
        const auto overlap = grid.overlap(move);
        const std::int32_t *left = at + overlap.their_column * width + overlap.their_row, *right = left + overlap.columns * width;
        differing[move * count + number] = right[overlap.rows] - left[overlap.rows] - right[0] + left[0];
      }
    }
  });
}

SignMean SignMean::of(const Word *signs, Size count, const SignGrid &grid) {
  const Size words = grid.size();
  SignMean mean;
  bool is_one = true;
  for (Size number = 0; number < count; ++number, signs += words) {
    is_one = is_one && std::equal(signs, signs + words, signs - number * words);
    add(signs, words, number + 1, mean.planes);
  }
  if (is_one) return {};
  // A count is the sum of half the numbers 1 and -1 of each digit, and half of all their weights.
  double weight = 1, all = static_cast<double>(count);
  for (Size digit = 0; count >> digit; ++digit, weight *= 2) mean.weights.push_back(weight / all);
  mean.planes.resize(mean.planes.size() + words);  // minus ones
  mean.weights.push_back((all + 1 - weight) / all);
  add_squares(mean, grid);
  return mean;
}

SignMean SignMean::near(const float *numbers, const SignGrid &grid) {
  const float *end = numbers + grid.cells() * grid.bits();
  if (std::all_of(numbers, end, [](float number) { return std::abs(number) == 1; })) return {};
  SignMean mean = rounded(numbers, DIGITS, false, grid);
  add_squares(mean, grid);
  return mean;
}

SignMean SignMean::rounded(const float *numbers, int digits, bool up_and_down, const SignGrid &grid) {
  const double most = (1 << digits) - 1, turn = up_and_down ? 0.6180339887498949 : 0;  // the golden ratio: evenly spread
  SignMean mean;
  mean.planes.resize(digits * grid.size());
  for (int digit = 0; digit < digits; ++digit) mean.weights.push_back(static_cast<double>(1 << digit) / most);
  on_cpu([=, planes = mean.planes.data()](auto) {
    for (Size word = 0; word < grid.size(); ++word) {
      const Size in_cell = word % grid.words() * WORD_BITS, count = std::min(WORD_BITS, grid.bits() - in_cell);
      const float *number = numbers + word / grid.words() * grid.bits() + in_cell;
      std::int64_t levels[WORD_BITS] = {};
      for (Size bit = 0; bit < count; ++bit) {
        const double share = (std::clamp(static_cast<double>(number[bit]), -1.0, 1.0) + 1) / 2;
        const double up = 0.5 + turn * static_cast<double>(word + bit);
        levels[bit] = static_cast<std::int32_t>(share * most + up - static_cast<double>(static_cast<std::int64_t>(up)));
      }
      for (int digit = 0; digit < digits; ++digit) {
        Word plane = 0;
        for (Size bit = 0; bit < WORD_BITS; ++bit) plane |= static_cast<Word>(levels[bit] >> digit & 1) << bit;
        planes[digit * grid.size() + word] = plane;
      }
    }
  });
  return mean;
}

std::vector<double> products(const Word *signs, const SignMean &mean, const SignGrid &grid) {
  std::vector<double> sums(grid.moves());
  std::vector<std::int32_t> differing(grid.moves() * mean.count());
  count_moves(signs, mean.planes.data(), mean.count(), grid, differing.data());
  std::size_t at = 0;
  for (Size move = 0; move < grid.moves(); ++move)
    for (const double weight : mean.weights)
      sums[move] += weight * static_cast<double>(grid.overlapping(move) - 2 * differing[at++]);
  return sums;
}

std::vector<double> products(const SignMean &mean, const SignMean &other, const SignGrid &grid) {
  std::vector<double> sums(grid.moves());
  for (Size plane = 0; plane < mean.count(); ++plane) {
    const auto more = products(mean.planes.data() + plane * grid.size(), other, grid);
    for (std::size_t move = 0; move < sums.size(); ++move) sums[move] += mean.weights[plane] * more[move];
  }
  return sums;
}

void products(const SignMean &mean, const Word *rows, Size count, const SignGrid &grid, decltype(count_moves) count_in,
              float *products) {
  std::vector<double> sums(grid.moves() * count);
  std::vector<std::int32_t> differing(sums.size());
  for (Size plane = 0; plane < mean.count(); ++plane) {
    count_in(mean.planes.data() + plane * grid.size(), rows, count, grid, differing.data());
    const double weight = mean.weights[plane];
    for (Size move = 0; move < grid.moves(); ++move)
      for (Size at = move * count, bits = grid.overlapping(move); at < (move + 1) * count; ++at)
        sums[at] += weight * static_cast<double>(bits - 2 * differing[at]);
  }
  std::transform(sums.begin(), sums.end(), products, [](double sum) { return static_cast<float>(sum); });
}

std::vector<double> numbers(const SignMean &mean, const SignGrid &grid) {
  std::vector<double> numbers;
  for (Size cell = 0; cell < grid.cells(); ++cell)
    for (Size bit = 0; bit < grid.bits(); ++bit) {
      double number = 0;
      const Word *word = mean.planes.data() + cell * grid.words() + bit / WORD_BITS;
      for (const double weight : mean.weights) {
        number += *word >> bit % WORD_BITS & 1 ? weight : -weight;
        word += grid.size();
      }
      numbers.push_back(number);
    }
  return numbers;
}

std::vector<double> squares(const Word *signs, const SignMean &mean, const SignGrid &grid) {
  std::vector<double> squares(grid.cells(), static_cast<double>(grid.bits()));
  if (!mean.count()) return squares;
  const auto products = products_of_cells(signs, mean, grid);
  for (std::size_t cell = 0; cell < squares.size(); ++cell)
    squares[cell] = std::max(0.0, squares[cell] + mean.squares[cell] - 2 * products[cell]);
  return squares;
}

std::vector<float> lengths(const std::vector<double> &squares, const SignGrid &grid, bool is_moved) {
  const Size width = grid.rows + 1;
  std::vector<double> sums((grid.columns + 1) * width);  // of the cells before each
  const auto sum = [&](Size column, Size row) -> double & { return sums[column * width + row]; };
  for (Size column = 0; column < grid.columns; ++column)
    for (Size row = 0; row < grid.rows; ++row)
      sum(column + 1, row + 1) = sum(column, row + 1) + sum(column + 1, row) - sum(column, row) +
                                 squares[column * grid.rows + row];
  std::vector<float> lengths;
  for (Size move = 0; move < grid.moves(); ++move) {
    const auto overlap = grid.overlap(move);
    const Size left = is_moved ? overlap.our_column : overlap.their_column, right = left + overlap.columns;
    const Size top = is_moved ? overlap.our_row : overlap.their_row, bottom = top + overlap.rows;
    const double square = sum(right, bottom) - sum(left, bottom) - sum(right, top) + sum(left, top);
    lengths.push_back(static_cast<float>(std::sqrt(std::max(0.0, square))));
  }
  return lengths;
}

}  // namespace places
