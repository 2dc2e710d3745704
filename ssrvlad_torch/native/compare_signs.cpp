// Rows of signs, compared as vectors of 1 and -1 in columns.

#include <array>
#include <numeric>

#include "compare.hpp"
#include "interface.hpp"
#include "parallel.hpp"
#include "signs.hpp"

namespace places {

namespace {

using Floats = std::vector<float>;
using Words = std::vector<Word>;

constexpr Size REACH = 2;          // columns by which a query is moved to each side
constexpr Size ROWS_AT_ONCE = 64;  // rows that stay in the cache while queries pass by
constexpr float LEAST = 1e-3F;     // of the product of two lengths

// How signs are stored: columns of whole words, of which some bytes count.
struct Shape {
  Size columns, bytes;

  Size words() const { return (bytes + 7) / 8; }
  Size bits() const { return 8 * bytes; }
  Size size() const { return columns * words(); }
  Size weights() const { return 8 * words() * 2 * NIBBLES; }  // of a column, for `weigh`
};

const std::uint8_t *bytes_of(const Word *words) { return reinterpret_cast<const std::uint8_t *>(words); }

Words packed(const std::uint8_t *signs, Size count, const Shape &shape) {
  Words words(static_cast<std::size_t>(count * shape.size()));
  for (Size column = 0; column < count * shape.columns; ++column)
    std::memcpy(words.data() + column * shape.words(), signs + column * shape.bytes,
                static_cast<std::size_t>(shape.bytes));
  return words;
}

// A mean (columns, bits); nothing for one of frames that are all equal, of which it would leave nothing,
// and for zeros.
Floats checked(Floats mean) {
  const auto is_sign = [](float each) { return std::abs(each) == 1; };
  const auto is_zero = [](float each) { return each == 0; };
  const bool leaves = std::all_of(mean.begin(), mean.end(), is_sign) ||
                      std::all_of(mean.begin(), mean.end(), is_zero);
  return leaves ? Floats() : mean;
}

// The mean of signs as 1 and -1.
Floats mean_of(const Word *signs, Size count, const Shape &shape) {
  std::vector<std::int32_t> ones(static_cast<std::size_t>(shape.columns * shape.bits()));
  for (Size column = 0; column < count * shape.columns; ++column) {
    const std::uint8_t *bytes = bytes_of(signs + column * shape.words());
    std::int32_t *one = ones.data() + column % shape.columns * shape.bits();
    for (Size bit = 0; bit < shape.bits(); ++bit) one[bit] += bytes[bit / 8] >> bit % 8 & 1;
  }
  Floats mean;
  for (const std::int32_t one : ones)
    mean.push_back(static_cast<float>(2.0 * one / static_cast<double>(count) - 1));
  return checked(std::move(mean));
}

// What the nibbles of signs weigh by a mean: the sum of the four numbers, each plus or minus.
Floats weights_of(const Floats &mean, const Shape &shape) {
  Floats weights;
  weights.reserve(static_cast<std::size_t>(shape.columns * shape.weights()));
  for (Size column = 0; column < shape.columns; ++column)
    for (Size nibble = 0; nibble < 16 * shape.words(); ++nibble) {
      const auto of = [&](Size bit) {
        const Size at = 4 * nibble + bit;
        return at < shape.bits() ? mean[static_cast<std::size_t>(column * shape.bits() + at)] : 0;
      };
      const std::array<float, 4> low = {-of(0) - of(1), of(0) - of(1), of(1) - of(0), of(0) + of(1)};
      const std::array<float, 4> high = {-of(2) - of(3), of(2) - of(3), of(3) - of(2), of(2) + of(3)};
      for (const float upper : high)
        for (const float lower : low) weights.push_back(lower + upper);
    }
  return weights;
}

// Adds the products of one column of each of some signs with the weights of a column: these stay in the
// cache.
void add_products(const Word *column, Size count, const float *weights, const Shape &shape, float *sums) {
  for (Size each = 0; each < count; ++each, column += shape.size()) {
    float sum;
    weigh(bytes_of(column), 8 * shape.words(), 1, weights, &sum);
    sums[each] += sum;
  }
}

// The product of columns of two means; 0 if one is nothing.
double product(const Floats &some, Size first, const Floats &others, Size start, Size columns,
               const Shape &shape) {
  if (some.empty() || others.empty()) return 0;
  return dot(some.data() + first * shape.bits(), others.data() + start * shape.bits(), columns * shape.bits());
}

// The squared lengths of the columns of some signs without a mean, of which the weights are known.
void squares(const Word *signs, Size count, const Floats &mean, const Floats &weights, const Shape &shape,
             float *of) {
  const auto bits = static_cast<float>(shape.bits());
  std::fill_n(of, count * shape.columns, bits);
  for (Size column = 0; column < shape.columns && !mean.empty(); ++column) {
    Floats sums(static_cast<std::size_t>(count));
    add_products(signs + column * shape.words(), count, weights.data() + column * shape.weights(), shape,
                 sums.data());
    const auto without = static_cast<float>(bits + product(mean, column, mean, column, 1, shape));
    for (Size each = 0; each < count; ++each)
      of[each * shape.columns + column] = std::max(0.0F, without - 2 * sums[static_cast<std::size_t>(each)]);
  }
}

// The length of the columns that overlap.
float length_of(const float *squares, Size first, Size columns) {
  return std::sqrt(std::accumulate(squares + first, squares + first + columns, 0.0F));
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

// Rows as they are compared: the mean of each, and the squared lengths of its columns without it.
struct Held {
  std::vector<Shared> shared;  // rows of one mean
  std::vector<Floats> means;
  Floats squares;
};

// Signs of queries against those of rows, for each move.
class SignComparison : public Comparison {
 public:
  SignComparison(Words queries, Size count, const Word *signs, Size rows, const Shape &shape,
                 const Held &held, const Floats &mean, Size reach, int threads)
      : Comparison(count, rows), queries_(std::move(queries)), signs_(signs), shape_(shape), held_(held),
        grid_{shape.columns, shape.words(), reach}, threads_(threads), of_mean_(of_moves(rows)),
        row_lengths_(of_moves(rows)), lengths_(of_moves(count)), levels_(held.means.size()) {
    const Floats weights = mean.empty() ? Floats() : weights_of(mean, shape);
    over_blocks(rows, ROWS_AT_ONCE, threads, [&](Size first, Size last) {
      prepare_rows(first, last, weights);
    });
    over_blocks(count, ROWS_AT_ONCE, threads, [&](Size first, Size last) {
      Floats of(static_cast<std::size_t>((last - first) * shape_.columns));
      squares(query_of(first), last - first, mean, weights, shape_, of.data());
      for (Size query = first; query < last; ++query)
        for (Size move = 0; move < grid_.moves(); ++move)
          lengths_[at(query, move)] = length_of(of.data() + (query - first) * shape_.columns,
                                                grid_.ours(move), grid_.overlapping(move));
    });
    for (std::size_t each = 0; each < levels_.size(); ++each) add_levels(each, mean);
  }

  const SignGrid &grid() const { return grid_; }
  const Word *row(Size row) const { return signs_ + row * grid_.size(); }
  // Of all rows in a move: their products with the mean of the queries, and their lengths without their mean.
  const float *of_mean(Size move) const { return of_mean_.data() + move * rows(); }
  const float *row_lengths(Size move) const { return row_lengths_.data() + move * rows(); }

 protected:
  void compute(Size first, Size last, float *scores) const override {
    over_blocks(rows(), ROWS_AT_ONCE, threads_, [&](Size start, Size end) {
      std::vector<std::int32_t> differing(static_cast<std::size_t>(grid_.moves() * (end - start)));
      for (Size query = first; query < last; ++query) {
        float *best = scores + (query - first) * rows();
        std::fill(best + start, best + end, NONE);
        count_moves(query_of(query), signs_ + start * grid_.size(), end - start, grid_, differing.data());
        for (std::size_t each = 0; each < held_.shared.size(); ++each) {
          const Size from = std::max(start, held_.shared[each].first), to = std::min(end, held_.shared[each].last);
          for (Size move = 0; from < to && move < grid_.moves(); ++move)
            raise(best + from, differing.data() + move * (end - start) + from - start,
                  of_mean_.data() + move * rows() + from, row_lengths_.data() + move * rows() + from,
                  levels_[each][at(query, move)], lengths_[at(query, move)], to - from);
        }
      }
    });
  }

 private:
  Floats of_moves(Size count) const { return Floats(static_cast<std::size_t>(grid_.moves() * count)); }
  std::size_t at(Size query, Size move) const { return static_cast<std::size_t>(query * grid_.moves() + move); }
  const Word *query_of(Size query) const { return queries_.data() + query * grid_.size(); }

  void prepare_rows(Size first, Size last, const Floats &weights) {
    for (Size move = 0; move < grid_.moves(); ++move) {
      const Size theirs = grid_.theirs(move), columns = grid_.overlapping(move);
      for (Size row = first; row < last; ++row)
        row_lengths_[static_cast<std::size_t>(move * rows() + row)] =
            length_of(held_.squares.data() + row * shape_.columns, theirs, columns);
      add_overlapping(signs_ + first * grid_.size() + theirs * grid_.words, last - first, weights,
                      grid_.ours(move), columns, of_mean_.data() + move * rows() + first);
    }
  }

  // Adds the products of adjacent columns of some signs with the weights of columns of a mean, if any.
  void add_overlapping(const Word *signs, Size count, const Floats &weights, Size column, Size columns,
                       float *sums) const {
    for (Size each = 0; each < columns && !weights.empty(); ++each)
      add_products(signs + each * grid_.words, count, weights.data() + (column + each) * shape_.weights(),
                   shape_, sums);
  }

  // What is added to minus twice the bits that differ from rows of a mean.
  void add_levels(std::size_t number, const Floats &mean) {
    const Floats &theirs = held_.means[number];
    const Floats weights = theirs.empty() ? Floats() : weights_of(theirs, shape_);
    Floats &levels = levels_[number] = of_moves(queries());
    over_blocks(queries(), ROWS_AT_ONCE, threads_, [&](Size first, Size last) {
      for (Size move = 0; move < grid_.moves(); ++move) {
        const Size own = grid_.ours(move), other = grid_.theirs(move), columns = grid_.overlapping(move);
        const double both = product(mean, own, theirs, other, columns, shape_);
        Floats less(static_cast<std::size_t>(last - first));
        add_overlapping(query_of(first) + own * grid_.words, last - first, weights, other, columns, less.data());
        for (Size query = first; query < last; ++query)
          levels[at(query, move)] = static_cast<float>(both - static_cast<double>(less[static_cast<std::size_t>(query - first)]) +
                                                       static_cast<double>(columns * shape_.bits()));
      }
    });
  }

  Words queries_;
  const Word *signs_;
  Shape shape_;
  const Held &held_;
  SignGrid grid_;
  int threads_;
  Floats of_mean_, row_lengths_, lengths_;  // by move and row; by query and move
  std::vector<Floats> levels_;              // by mean: by query and move
};

// Signs that come one by one. The products of each row with the signs so far are sums of whole numbers.
class LiveSignComparison : public LiveComparison {
 public:
  // `before` compares no queries without the mean of the map, or nothing.
  LiveSignComparison(std::unique_ptr<SignComparison> before, Floats prior, const Shape &shape, const Held &held, Size rows)
      : before_(std::move(before)), prior_(std::move(prior)), shape_(shape), held_(held), rows_(rows),
        sums_(prior_.size()), with_rows_(static_cast<std::size_t>(grid().moves() * rows)) {}

  void next(const void *query, int threads, float *scores) override {
    const Words words = packed(static_cast<const std::uint8_t *>(query), 1, shape_);
    Floats signs;
    for (Size column = 0; column < shape_.columns; ++column)
      for (Size bit = 0; bit < shape_.bits(); ++bit)
        signs.push_back(bytes_of(words.data() + column * shape_.words())[bit / 8] >> bit % 8 & 1 ? 1.0F : -1.0F);
    const Size moves = grid().moves();
    std::vector<std::int32_t> differing(static_cast<std::size_t>(moves * rows_));
    over_blocks(rows_, ROWS_AT_ONCE, threads, [&](Size first, Size last) {
      std::vector<std::int32_t> some(static_cast<std::size_t>(moves * (last - first)));
      count_moves(words.data(), before_->row(first), last - first, grid(), some.data());
      for (Size move = 0; move < moves; ++move)
        std::copy_n(some.data() + move * (last - first), last - first, differing.data() + move * rows_ + first);
    });
    const std::vector<double> with_means = products_with_means(signs);
    if (!prior_.empty()) add(signs, differing);
    const double frames = prior_.empty() ? 1 : frames_ + static_cast<double>(MODEL.before);
    Floats mean(signs.size()), of_mean(static_cast<std::size_t>(rows_));
    for (std::size_t bit = 0; bit < sums_.size(); ++bit)
      mean[bit] = static_cast<float>((sums_[bit] + static_cast<double>(MODEL.before) * static_cast<double>(prior_[bit])) / frames);
    for (std::size_t bit = 0; bit < sums_.size(); ++bit) signs[bit] -= mean[bit];
    std::fill_n(scores, rows_, NONE);
    for (Size move = 0; move < moves; ++move) {
      const Size ours = grid().ours(move), theirs = grid().theirs(move), columns = grid().overlapping(move);
      const float *part = signs.data() + ours * shape_.bits();
      const auto length = static_cast<float>(std::sqrt(dot(part, part, columns * shape_.bits())));
      for (Size row = 0; row < rows_ && !prior_.empty(); ++row)
        of_mean[row] = static_cast<float>((with_rows_[move * rows_ + row] + static_cast<double>(MODEL.before) * static_cast<double>(before_->of_mean(move)[row])) / frames);
      for (std::size_t number = 0; number < held_.means.size(); ++number) {
        const auto [first, last, from, to] = held_.shared[number];
        const double both = product(mean, ours, held_.means[number], theirs, columns, shape_);
        const double level = both - with_means[number * moves + move] + static_cast<double>(columns * shape_.bits());
        raise(scores + first, differing.data() + move * rows_ + first, of_mean.data() + first,
              before_->row_lengths(move) + first, static_cast<float>(level), length, last - first);
      }
    }
  }

  void keep(Archive &archive) override {
    const std::size_t bits = sums_.size(), products = with_rows_.size();
    archive(frames_), archive(sums_), archive(with_rows_);
    require(sums_.size() == bits && with_rows_.size() == products);
  }

 private:
  const SignGrid &grid() const { return before_->grid(); }

  // With the means of the rows, by mean and move.
  std::vector<double> products_with_means(const Floats &signs) const {
    std::vector<double> products;
    for (const Floats &mean : held_.means)
      for (Size move = 0; move < grid().moves(); ++move)
        products.push_back(product(signs, grid().ours(move), mean, grid().theirs(move), grid().overlapping(move), shape_));
    return products;
  }

  void add(const Floats &signs, const std::vector<std::int32_t> &differing) {
    for (std::size_t bit = 0; bit < signs.size(); ++bit) sums_[bit] += static_cast<double>(signs[bit]);
    for (Size move = 0; move < grid().moves(); ++move) {
      const Size bits = grid().overlapping(move) * shape_.bits();
      for (Size row = 0; row < rows_; ++row)
        with_rows_[move * rows_ + row] += static_cast<double>(bits - 2 * static_cast<Size>(differing[move * rows_ + row]));
    }
    ++frames_;
  }

  std::unique_ptr<SignComparison> before_;
  Floats prior_;  // the mean of the map
  Shape shape_;
  const Held &held_;
  Size rows_;
  double frames_ = 0;
  std::vector<double> sums_, with_rows_;  // of the signs so far; of their products with each row, by move
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
    const Held &rows = held(standardised, threads);
    const Size reach = swept ? std::min(REACH, shape_.columns - 1) : 0;
    Words words = packed(static_cast<const std::uint8_t *>(queries.descriptors), queries.count, shape_);
    Floats mean;
    if (standardised && queries.count) mean = mean_of(words.data(), queries.count, shape_);
    return std::make_unique<SignComparison>(std::move(words), queries.count, signs_, drives_.rows, shape_,
                                            rows, mean, reach, threads);
  }

  std::unique_ptr<LiveComparison> live(Size, bool standardised, bool swept, int threads) override {
    const Held &rows = held(standardised, threads);
    const Size reach = swept ? std::min(REACH, shape_.columns - 1) : 0;
    Floats prior;
    if (standardised) prior = mean_of(signs_, drives_.rows, shape_);
    auto before = std::make_unique<SignComparison>(Words(), 0, signs_, drives_.rows, shape_, rows, prior, reach, threads);
    return std::make_unique<LiveSignComparison>(std::move(before), std::move(prior), shape_, rows, drives_.rows);
  }

 private:
  const Held &held(bool standardised, int threads) {
    const std::lock_guard<Mutex> hold(mutex_);
    auto &found = held_[standardised];
    if (found) return *found;
    auto fresh = std::make_unique<Held>();
    const float *given = standardised ? means_ : nullptr;
    if (standardised) fresh->shared = given ? each_alone(drives_) : sharing(drives_);
    if (fresh->shared.empty()) fresh->shared = {{0, drives_.rows, 0, 0}};
    fresh->squares.resize(static_cast<std::size_t>(drives_.rows * shape_.columns));
    Floats of_all;
    for (const Shared &shared : fresh->shared) {
      const bool all = !given && shared.to - shared.from == drives_.rows;
      Floats mean;
      if (given) {
        mean = checked(Floats(given, given + shape_.columns * shape_.bits()));
        given += shape_.columns * shape_.bits();
      } else if (shared.to > shared.from && !(all && !of_all.empty()))
        mean = mean_of(signs_ + shared.from * shape_.size(), shared.to - shared.from, shape_);
      if (all) mean = of_all = of_all.empty() ? mean : of_all;
      const Floats weights = mean.empty() ? Floats() : weights_of(mean, shape_);
      over_blocks(shared.last - shared.first, ROWS_AT_ONCE, threads, [&](Size first, Size last) {
        squares(signs_ + (shared.first + first) * shape_.size(), last - first, mean, weights, shape_,
                fresh->squares.data() + (shared.first + first) * shape_.columns);
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
  std::array<std::unique_ptr<Held>, 2> held_;
};

}  // namespace

std::unique_ptr<Channel> channel_of_signs(const std::uint8_t *rows, Size columns, Size bytes,
                                          const Listing &listing, const float *means) {
  return std::make_unique<SignChannel>(rows, Shape{columns, bytes}, listing, means);
}

}  // namespace places
