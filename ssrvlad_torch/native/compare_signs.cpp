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

constexpr Size ROWS_AT_ONCE = 64;      // rows that stay in the cache while queries pass by
constexpr float LEAST = 1e-3F;         // of the product of two lengths

std::size_t place(Size at) { return static_cast<std::size_t>(at); }

// How signs are stored: cells of whole words, of which some bytes count.
struct Shape {
  Size columns, rows, bytes;

  Size cells() const { return columns * rows; }
  Size bits() const { return 8 * bytes; }
  SignGrid grid(bool swept) const { return SignGrid::of(columns, rows, bytes, swept); }
};

Words packed(const std::uint8_t *signs, Size count, const Shape &shape) {
  const Size words = shape.grid(false).words, cells = count * shape.cells();
  Words packed(place(cells * words));
  for (Size cell = 0; cell < cells; ++cell)
    std::memcpy(packed.data() + cell * words, signs + cell * shape.bytes, place(shape.bytes));
  return packed;
}

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

// Rows as they are compared: the mean of each, and by move and row the length of the cells that overlap
// without it.
struct Held {
  std::vector<Shared> shared;  // rows of one mean
  std::vector<SignMean> means;
  Floats lengths;
};

// Signs of queries against those of rows, for each move.
class SignComparison : public Comparison {
 public:
  // `mean` is of the queries.
  SignComparison(Words queries, Size count, const Word *signs, Size rows, const SignGrid &grid, Size bits,
                 const Held &held, const SignMean &mean, int threads)
      : Comparison(count, rows), queries_(std::move(queries)), signs_(signs), held_(held), grid_(grid), threads_(threads),
        of_mean_(of_moves(rows)), lengths_(of_moves(count)), levels_(held.means.size(), of_moves(count)) {
    over_blocks(mean.count() ? rows : 0, ROWS_AT_ONCE, threads, [&](Size first, Size last) {
      Floats some(of_moves(last - first));
      products(mean, row(first), last - first, bits, grid, some.data());
      for (Size move = 0; move < grid.moves(); ++move)
        std::copy_n(some.data() + move * (last - first), last - first, of_mean_.data() + move * rows + first);
    });
    std::vector<Doubles> of_means;
    for (const SignMean &other : held.means) of_means.push_back(products(mean, other, bits, grid));
    over_blocks(count, 1, threads, [&](Size query, Size) {
      const Word *words = queries_.data() + query * grid.size();
      const Floats without = lengths(squares(words, mean, bits, grid), grid, true);
      std::copy(without.begin(), without.end(), lengths_.begin() + query * grid.moves());
      for (std::size_t number = 0; number < held.means.size(); ++number) {
        const Doubles less = products(words, held.means[number], bits, grid);
        for (Size move = 0; move < grid.moves(); ++move)
          levels_[number][at(query, move)] = static_cast<float>(
              of_means[number][place(move)] - less[place(move)] + static_cast<double>(bits * grid.overlap(move).cells()));
      }
    });
  }

  const SignGrid &grid() const { return grid_; }
  const Word *row(Size row) const { return signs_ + row * grid_.size(); }
  // Of all rows in a move: their products with the mean of the queries, and their lengths without their mean.
  const float *of_mean(Size move) const { return of_mean_.data() + move * rows(); }
  const float *row_lengths(Size move) const { return held_.lengths.data() + move * rows(); }

 protected:
  void compute(Size first, Size last, float *scores) const override {
    over_blocks(rows(), ROWS_AT_ONCE, threads_, [&](Size start, Size end) {
      std::vector<std::int32_t> differing(place(grid_.moves() * (end - start)));
      for (Size query = first; query < last; ++query) {
        float *best = scores + (query - first) * rows();
        std::fill(best + start, best + end, NONE);
        count_moves(queries_.data() + query * grid_.size(), row(start), end - start, grid_, differing.data());
        for (std::size_t number = 0; number < held_.shared.size(); ++number) {
          const Size from = std::max(start, held_.shared[number].first), to = std::min(end, held_.shared[number].last);
          for (Size move = 0; from < to && move < grid_.moves(); ++move)
            raise(best + from, differing.data() + move * (end - start) + from - start, of_mean(move) + from,
                  row_lengths(move) + from, levels_[number][at(query, move)], lengths_[at(query, move)], to - from);
        }
      }
    });
  }

 private:
  Floats of_moves(Size count) const { return Floats(place(grid_.moves() * count)); }
  std::size_t at(Size query, Size move) const { return place(query * grid_.moves() + move); }

  Words queries_;
  const Word *signs_;
  const Held &held_;
  SignGrid grid_;
  int threads_;
  Floats of_mean_, lengths_;    // by move and row; by query and move
  std::vector<Floats> levels_;  // by mean: by query and move, what is added to minus twice the bits that differ
};

// Signs that come one by one. Their mean is that of those so far, and of `before` frames like the mean of the
// map; its products are sums that grow with each query.
class LiveSignComparison : public LiveComparison {
 public:
  // `before` compares no queries without the mean of the map, `prior`, or nothing.
  LiveSignComparison(std::unique_ptr<SignComparison> before, const SignMean &prior, const Shape &shape, const Held &held)
      : before_(std::move(before)), shape_(shape), bits_(shape.bits()), held_(held) {
    if (!prior.count()) return;
    for (const double number : numbers(prior, bits_, grid())) sums_.push_back(frames_ * number);
    for (Size move = 0; move < grid().moves(); ++move)
      for (Size row = 0; row < before_->rows(); ++row) with_rows_.push_back(frames_ * static_cast<double>(before_->of_mean(move)[row]));
    for (const SignMean &mean : held.means)
      for (const double product : products(prior, mean, bits_, grid())) with_means_.push_back(frames_ * product);
  }

  void next(const void *query, int threads, float *scores) override {
    const Size moves = grid().moves(), rows = before_->rows();
    const Words words = packed(static_cast<const std::uint8_t *>(query), 1, shape_);
    std::vector<std::int32_t> differing(place(moves * rows));
    over_blocks(rows, ROWS_AT_ONCE, threads, [&](Size first, Size last) {
      std::vector<std::int32_t> some(place(moves * (last - first)));
      count_moves(words.data(), before_->row(first), last - first, grid(), some.data());
      for (Size move = 0; move < moves; ++move)
        std::copy_n(some.data() + move * (last - first), last - first, differing.data() + move * rows + first);
    });
    Doubles of_means;
    for (const SignMean &mean : held_.means)
      for (const double product : products(words.data(), mean, bits_, grid())) of_means.push_back(product);
    if (!sums_.empty()) add(words, differing, of_means);
    const Floats own = lengths(squares_of(words), grid(), true);
    Floats of_mean(place(rows));
    std::fill_n(scores, rows, NONE);
    for (Size move = 0; move < moves; ++move) {
      for (Size row = 0; row < rows && !sums_.empty(); ++row)
        of_mean[place(row)] = static_cast<float>(with_rows_[place(move * rows + row)] / frames_);
      for (std::size_t number = 0; number < held_.means.size(); ++number) {
        const auto [first, last, from, to] = held_.shared[number];
        const std::size_t at = number * place(moves) + place(move);
        const double both = sums_.empty() ? 0 : with_means_[at] / frames_;
        const double level = both - of_means[at] + bits_of(move);
        raise(scores + first, differing.data() + move * rows + first, of_mean.data() + first,
              before_->row_lengths(move) + first, static_cast<float>(level), own[place(move)], last - first);
      }
    }
  }

  void keep(Archive &archive) override {
    const std::size_t bits = sums_.size(), rows = with_rows_.size(), means = with_means_.size();
    archive(frames_), archive(sums_), archive(with_rows_), archive(with_means_);
    require(sums_.size() == bits && with_rows_.size() == rows && with_means_.size() == means);
  }

 private:
  const SignGrid &grid() const { return before_->grid(); }
  double bits_of(Size move) const { return static_cast<double>(bits_ * grid().overlap(move).cells()); }

  void add(const Words &words, const std::vector<std::int32_t> &differing, const Doubles &of_means) {
    ++frames_;
    for (std::size_t bit = 0; bit < sums_.size(); ++bit) sums_[bit] += sign(words, static_cast<Size>(bit));
    for (std::size_t at = 0; at < with_means_.size(); ++at) with_means_[at] += of_means[at];
    std::size_t at = 0;
    for (Size move = 0; move < grid().moves(); ++move)
      for (Size row = 0; row < before_->rows(); ++row, ++at) with_rows_[at] += bits_of(move) - 2.0 * differing[at];
  }

  // The squared lengths of the cells of a query without the mean so far.
  Doubles squares_of(const Words &words) const {
    Doubles squares(place(grid().columns * grid().rows), static_cast<double>(bits_));
    if (sums_.empty()) return squares;
    std::fill(squares.begin(), squares.end(), 0);
    for (std::size_t bit = 0; bit < sums_.size(); ++bit) {
      const double less = sign(words, static_cast<Size>(bit)) - sums_[bit] / frames_;
      squares[bit / place(bits_)] += less * less;
    }
    return squares;
  }

  double sign(const Words &words, Size bit) const {
    const Size cell = bit / bits_, in_cell = bit % bits_;
    return words[place(cell * grid().words + in_cell / 64)] >> in_cell % 64 & 1 ? 1 : -1;
  }

  std::unique_ptr<SignComparison> before_;
  Shape shape_;
  Size bits_;
  const Held &held_;
  double frames_ = static_cast<double>(MODEL.before);
  Doubles sums_, with_rows_, with_means_;  // of the numbers, and of their products, by move, with rows and with means
};

class SignChannel : public Channel {
 public:
  SignChannel(const std::uint8_t *rows, const Shape &shape, const Listing &listing, const float *means)
      : shape_(shape), drives_(listing.drives), means_(means), signs_(reinterpret_cast<const Word *>(rows)) {
    if (shape.bytes % 8 == 0 && reinterpret_cast<std::uintptr_t>(rows) % sizeof(Word) == 0) return;
    own_ = packed(rows, drives_.rows, shape);
    signs_ = own_.data();
  }

  std::unique_ptr<Comparison> compare(const Queries &queries, bool standardised, bool swept,
                                      int threads) override {
    const SignGrid grid = shape_.grid(swept);
    Words words = packed(static_cast<const std::uint8_t *>(queries.descriptors), queries.count, shape_);
    SignMean mean;
    if (standardised) mean = SignMean::of(words.data(), queries.count, shape_.bits(), grid);
    return std::make_unique<SignComparison>(std::move(words), queries.count, signs_, drives_.rows, grid, shape_.bits(),
                                            held(standardised, swept, threads), mean, threads);
  }

  std::unique_ptr<LiveComparison> live(Size, bool standardised, bool swept, int threads) override {
    const SignGrid grid = shape_.grid(swept);
    SignMean prior;
    if (standardised) prior = SignMean::of(signs_, drives_.rows, shape_.bits(), grid);
    const Held &rows = held(standardised, swept, threads);
    auto before = std::make_unique<SignComparison>(Words(), 0, signs_, drives_.rows, grid, shape_.bits(), rows, prior, threads);
    return std::make_unique<LiveSignComparison>(std::move(before), prior, shape_, rows);
  }

 private:
  const Held &held(bool standardised, bool swept, int threads) {
    const std::lock_guard<Mutex> hold(mutex_);
    auto &found = held_[2 * standardised + swept];
    if (found) return *found;
    const SignGrid grid = shape_.grid(swept);
    const Size bits = shape_.bits(), rows = drives_.rows;
    auto fresh = std::make_unique<Held>();
    const float *given = standardised ? means_ : nullptr;
    if (standardised) fresh->shared = given ? each_alone(drives_) : sharing(drives_);
    if (fresh->shared.empty()) fresh->shared = {{0, rows, 0, 0}};
    fresh->lengths.resize(place(grid.moves() * rows));
    SignMean of_all;
    for (const Shared &shared : fresh->shared) {
      const bool all = !given && shared.to - shared.from == rows;
      SignMean mean;
      if (given) {
        mean = SignMean::near(given, bits, grid);
        given += shape_.cells() * bits;
      } else if (!(all && of_all.count())) {
        mean = SignMean::of(signs_ + shared.from * grid.size(), shared.to - shared.from, bits, grid);
      }
      if (all) mean = of_all = of_all.count() ? of_all : mean;
      over_blocks(shared.last - shared.first, ROWS_AT_ONCE, threads, [&](Size first, Size last) {
        for (Size row = shared.first + first; row < shared.first + last; ++row) {
          const Floats without = lengths(squares(signs_ + row * grid.size(), mean, bits, grid), grid, false);
          for (Size move = 0; move < grid.moves(); ++move) fresh->lengths[place(move * rows + row)] = without[place(move)];
        }
      });
      fresh->means.push_back(std::move(mean));
    }
    found = std::move(fresh);
    return *found;
  }

  Shape shape_;
  const Drives &drives_;  // of the list
  const float *means_;
  Words own_;
  const Word *signs_;
  Mutex mutex_;
  std::array<std::unique_ptr<Held>, 4> held_;  // standardised or not, swept or not
};

}  // namespace

std::unique_ptr<Channel> channel_of_signs(const std::uint8_t *rows, Size columns, Size height, Size bytes,
                                          const Listing &listing, const float *means) {
  return std::make_unique<SignChannel>(rows, Shape{columns, height, bytes}, listing, means);
}

}  // namespace places
