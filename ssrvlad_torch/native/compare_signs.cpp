// Rows of signs, compared as numbers 1 and -1 on a grid of cells.

#include <array>

#include "compare.hpp"
#include "interface.hpp"
#include "parallel.hpp"
#include "signs.hpp"

namespace places {

namespace {

using Floats = std::vector<float>;
using Doubles = std::vector<double>;
using Words = std::vector<Word>;

constexpr Size ROWS_AT_ONCE = 64;  // rows that stay in the cache while queries pass by
constexpr float LEAST = 1e-3F;     // of the product of two lengths

// Raises scores to the cosines of a move, by what differs and by the lengths of rows; `level` and the
// products with a mean make of it the product without means.
void raise(float *scores, const std::int32_t *differing, const float *of_mean,
           const float *lengths, float level, float length, Size count) {
  on_cpu([=](auto) {
    for (Size row = 0; row < count; ++row) {
      const float both = lengths[row] * length, product = level - 2 * static_cast<float>(differing[row]) - of_mean[row];
      const float score = product / (both > LEAST ? both : LEAST), capped = score < 1 ? score : 1;
      scores[row] = capped > scores[row] ? capped : scores[row];
    }
  });
}

// Rows as they are compared. Numbers by move and row are (moves, rows), by mean and move (means, moves).
struct SignRows {
  SignGrid grid;
  const Word *signs;
  Size count;
  std::vector<Shared> shared;  // rows of one mean
  std::vector<SignMean> means;
  Floats lengths;  // by move and row, of the cells that overlap, without the mean of the row

  const Word *operator[](Size row) const { return signs + row * grid.size(); }

  // Numbers by move and row that a function fills for neighbouring rows, so many from a first one on.
  template <class Number, class Function>
  std::vector<Number> by_blocks(int threads, Function fill) const {
    std::vector<Number> numbers(grid.moves() * count);
    over_blocks(count, ROWS_AT_ONCE, threads, [&](Size first, Size last) {
      std::vector<Number> block(grid.moves() * (last - first));
      fill((*this)[first], last - first, block.data());
      for (Size move = 0; move < grid.moves(); ++move)
        std::copy_n(block.data() + move * (last - first), last - first, numbers.data() + move * count + first);
    });
    return numbers;
  }

  Floats products_with(const SignMean &mean, int threads) const {
    if (!mean.count()) return Floats(grid.moves() * count);
    return by_blocks<float>(threads, [&](const Word *rows, Size some, float *numbers) {
      products(mean, rows, some, grid, count_moves, numbers);
    });
  }

  // The products of signs with each mean, by mean and move.
  Doubles products_of(const Word *words) const {
    Doubles of_means;
    for (const SignMean &mean : means)
      for (const double product : products(words, mean, grid)) of_means.push_back(product);
    return of_means;
  }

  // Raises the scores of the rows from `start` to `end`, of which so many bits differ by move and row, by the products
  // of all rows with the mean of the queries, the levels by mean and move, and the lengths of the query by move.
  void raise_scores(Size start, Size end, const std::int32_t *differing, const float *of_mean, const float *levels,
                    const float *of_query, float *scores) const {
    for (const Shared &rows : shared) {
      const Size from = std::max(start, rows.first), to = std::min(end, rows.last);
      for (Size move = 0; from < to && move < grid.moves(); ++move)
        raise(scores + from, differing + move * (end - start) + from - start, of_mean + move * count + from,
              lengths.data() + move * count + from, levels[move], of_query[move], to - from);
      levels += grid.moves();
    }
  }
};

// Signs of queries against those of rows, for each move.
class SignComparison : public Comparison {
 public:
  // `mean` is of the queries.
  SignComparison(Words queries, Size count, const SignRows &rows, const SignMean &mean, int threads)
      : Comparison(count, rows.count), queries_(std::move(queries)), rows_(rows), threads_(threads),
        of_mean_(rows.products_with(mean, threads)), lengths_(rows.grid.moves() * count),
        levels_(lengths_.size() * rows.means.size()) {
    const SignGrid &grid = rows.grid;
    const Size moves = grid.moves(), levels = moves * static_cast<Size>(rows.means.size());
    Doubles of_means;
    for (const SignMean &other : rows.means)
      for (const double product : products(mean, other, grid)) of_means.push_back(product);
    over_blocks(count, 1, threads, [&](Size query, Size) {
      const Word *words = queries_.data() + query * grid.size();
      const Floats without = lengths(squares(words, mean, grid), grid, true);
      std::copy(without.begin(), without.end(), lengths_.begin() + query * moves);
      const Doubles less = rows.products_of(words);
      for (Size at = 0; at < levels; ++at)
        levels_[query * levels + at] =
            static_cast<float>(of_means[at] - less[at] + static_cast<double>(grid.overlapping(at % moves)));
    });
  }

 protected:
  void compute(Size first, Size last, float *scores) const override {
    const SignGrid &grid = rows_.grid;
    const Size moves = grid.moves(), levels = moves * static_cast<Size>(rows_.means.size());
    over_blocks(rows(), ROWS_AT_ONCE, threads_, [&](Size start, Size end) {
      std::vector<std::int32_t> differing(moves * (end - start));
      for (Size query = first; query < last; ++query) {
        float *best = scores + (query - first) * rows();
        std::fill(best + start, best + end, NONE);
        count_moves(queries_.data() + query * grid.size(), rows_[start], end - start, grid, differing.data());
        rows_.raise_scores(start, end, differing.data(), of_mean_.data(), levels_.data() + query * levels,
                           lengths_.data() + query * moves, best);
      }
    });
  }

 private:
  Words queries_;
  const SignRows &rows_;
  int threads_;
  Floats of_mean_, lengths_, levels_;  // by move and row; by query and move; by query, mean and move
};

// Signs that come one by one. Their mean is that of those so far, and of `before` frames like the mean of the
// map, `prior`, or nothing; its products are sums that grow with each query.
class LiveSignComparison : public LiveComparison {
 public:
  LiveSignComparison(const SignRows &rows, const SignMean &prior, int threads) : rows_(rows) {
    if (!prior.count()) return;
    for (const double number : numbers(prior, rows.grid)) sums_.push_back(frames_ * number);
    for (const float product : rows.products_with(prior, threads))
      with_rows_.push_back(frames_ * static_cast<double>(product));
    for (const SignMean &mean : rows.means)
      for (const double product : products(prior, mean, rows.grid)) with_means_.push_back(frames_ * product);
  }

  void next(const void *query, int threads, float *scores) override {
    const SignGrid &grid = rows_.grid;
    const Words words = packed(static_cast<const std::uint8_t *>(query), 1, grid);
    const auto differing = rows_.by_blocks<std::int32_t>(threads, [&](const Word *rows, Size some, std::int32_t *numbers) {
      count_moves(words.data(), rows, some, grid, numbers);
    });
    const Doubles of_means = rows_.products_of(words.data());
    if (!sums_.empty()) add(words, differing, of_means);
    Floats of_mean(differing.size()), levels(of_means.size());
    for (std::size_t at = 0; at < with_rows_.size(); ++at) of_mean[at] = static_cast<float>(with_rows_[at] / frames_);
    for (std::size_t at = 0; at < levels.size(); ++at) {
      const double both = sums_.empty() ? 0 : with_means_[at] / frames_;
      levels[at] = static_cast<float>(both - of_means[at] + overlapping(at % grid.moves()));
    }
    std::fill_n(scores, rows_.count, NONE);
    rows_.raise_scores(0, rows_.count, differing.data(), of_mean.data(), levels.data(),
                       lengths(squares_of(words), grid, true).data(), scores);
  }

  void keep(Archive &archive) override {
    const std::size_t bits = sums_.size(), rows = with_rows_.size(), means = with_means_.size();
    archive(frames_), archive(sums_), archive(with_rows_), archive(with_means_);
    require(sums_.size() == bits && with_rows_.size() == rows && with_means_.size() == means);
  }

 private:
  double overlapping(Size move) const { return static_cast<double>(rows_.grid.overlapping(move)); }

  void add(const Words &words, const std::vector<std::int32_t> &differing, const Doubles &of_means) {
    ++frames_;
    for (std::size_t bit = 0; bit < sums_.size(); ++bit) sums_[bit] += sign(words, bit);
    for (std::size_t at = 0; at < with_means_.size(); ++at) with_means_[at] += of_means[at];
    for (std::size_t at = 0; at < with_rows_.size(); ++at)
      with_rows_[at] += overlapping(static_cast<Size>(at) / rows_.count) - 2.0 * differing[at];
  }

  // The squared lengths of the cells of a query without the mean so far.
  Doubles squares_of(const Words &words) const {
    const Size bits = rows_.grid.bits();
    if (sums_.empty()) return Doubles(rows_.grid.cells(), static_cast<double>(bits));
    Doubles squares(rows_.grid.cells());
    for (std::size_t bit = 0; bit < sums_.size(); ++bit) {
      const double less = sign(words, bit) - sums_[bit] / frames_;
      squares[bit / bits] += less * less;
    }
    return squares;
  }

  double sign(const Words &words, Size bit) const {
    const Size cell = bit / rows_.grid.bits(), in_cell = bit % rows_.grid.bits();
    return words[cell * rows_.grid.words() + in_cell / 64] >> in_cell % 64 & 1 ? 1 : -1;
  }

  const SignRows &rows_;
  double frames_ = static_cast<double>(MODEL.before);
  Doubles sums_, with_rows_, with_means_;  // of the numbers, and of their products, by move, with rows and with means
};

class SignChannel : public Channel {
 public:
  SignChannel(const std::uint8_t *rows, const SignGrid &grid, const Listing &listing, const float *means)
      : grid_(grid), drives_(listing.drives), means_(means), signs_(reinterpret_cast<const Word *>(rows)) {
    if (grid.bytes % 8 == 0 && reinterpret_cast<std::uintptr_t>(rows) % sizeof(Word) == 0) return;
    packed_ = packed(rows, drives_.rows, grid);
    signs_ = packed_.data();
  }

  std::unique_ptr<Comparison> compare(const ssrvlad_queries &queries, Size count, bool standardised, bool swept,
                                      int threads) override {
    Words words = packed(static_cast<const std::uint8_t *>(queries.descriptors), count, grid_);
    SignMean mean;
    if (standardised) mean = SignMean::of(words.data(), count, grid_);
    return std::make_unique<SignComparison>(std::move(words), count, rows(standardised, swept, threads), mean,
                                            threads);
  }

  std::unique_ptr<LiveComparison> live(Size, bool standardised, bool swept, int threads) override {
    SignMean prior;
    if (standardised) prior = SignMean::of(signs_, drives_.rows, grid_);
    return std::make_unique<LiveSignComparison>(rows(standardised, swept, threads), prior, threads);
  }

 private:
  const SignRows &rows(bool standardised, bool swept, int threads) {
    const std::lock_guard<Mutex> hold(mutex_);
    auto &slot = rows_[2 * standardised + swept];
    if (slot) return *slot;
    const SignGrid grid = swept ? grid_.swept() : grid_;
    auto rows = std::make_unique<SignRows>(SignRows{grid, signs_, drives_.rows, {}, {}, {}});
    if (standardised) rows->shared = sharing(drives_, means_, grid.cells() * grid.bits());
    if (rows->shared.empty()) rows->shared = {{0, rows->count, 0, 0, nullptr}};
    rows->lengths.resize(grid.moves() * rows->count);
    SignMean of_all;
    for (const auto &[start, end, from, to, fixed] : rows->shared) {
      const bool all = to - from == rows->count;
      SignMean mean;
      if (fixed) mean = SignMean::near(fixed, grid);
      else if (all && of_all.count()) mean = of_all;
      else mean = SignMean::of(signs_ + from * grid.size(), to - from, grid);
      if (all) of_all = mean;
      over_blocks(end - start, ROWS_AT_ONCE, threads, [&, start = start](Size first, Size last) {
        for (Size row = start + first; row < start + last; ++row) {
          const Floats without = lengths(squares((*rows)[row], mean, grid), grid, false);
          for (Size move = 0; move < grid.moves(); ++move) rows->lengths[move * rows->count + row] = without[move];
        }
      });
      rows->means.push_back(std::move(mean));
    }
    slot = std::move(rows);
    return *slot;
  }

  SignGrid grid_;
  const Drives &drives_;  // of the list
  const float *means_;
  Words packed_;
  const Word *signs_;
  Mutex mutex_;
  std::array<std::unique_ptr<SignRows>, 4> rows_;  // standardised or not, swept or not
};

}  // namespace

std::unique_ptr<Channel> channel_of_signs(const std::uint8_t *rows, Size columns, Size height, Size bytes,
                                          const Listing &listing, const float *means) {
  return std::make_unique<SignChannel>(rows, SignGrid{columns, height, bytes}, listing, means);
}

}  // namespace places
