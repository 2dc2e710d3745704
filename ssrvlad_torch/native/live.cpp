// The channels of live.hpp.

#include "live.hpp"

#include <algorithm>
#include <array>
#include <cmath>

#include "parallel.hpp"
#include "signs.hpp"

namespace places {

namespace {
using Floats = std::vector<float>;

constexpr Size AHEAD = 1024;    // numbers that come from memory while others are computed
constexpr Size TOGETHER = 3;    // anchors that are compared with a row at once
constexpr Size MANY = 1 << 13;  // rows from which threads share them
constexpr double LENGTH_TOLERANCE = 1e-3;
constexpr Size PART = 2;        // bytes of a cell by which frames are roughly compared
constexpr Size REACH = 2;       // columns by which parts are moved to each side
constexpr int DIGITS = 18, PART_DIGITS = 8;  // of a mean
constexpr Size FEW = 8;         // frames that a row takes in one by one
constexpr Size AT_ONCE = 64;    // rows of signs that stay in the cache
constexpr double MIN_SQUARE = 1e-9;    // of a length without a mean
constexpr float LEAST = 1e-3F;         // of two lengths' product
constexpr float LEAST_SQUARE = 1e-5F;  // of a length without a mean, a bit: less is rounding

// Rows of numbers in blocks that never move, so that growing copies nothing.
template <class Number>
class GrowingRows {
 public:
  static constexpr Size ROWS = 1024;

  explicit GrowingRows(Size width) : width_(width) {}

  Size rows() const { return rows_; }
  Number *operator[](Size row) { return blocks_[row / ROWS].get() + row % ROWS * width_; }
  const Number *operator[](Size row) const { return blocks_[row / ROWS].get() + row % ROWS * width_; }

  Number *append() {
    reserve(rows_ + 1);
    return (*this)[rows_++];
  }

  void reserve(Size rows) {
    while (static_cast<Size>(blocks_.size()) * ROWS < rows) blocks_.emplace_back(new Number[ROWS * width_]);
  }

 private:
  Size width_, rows_ = 0;
  std::vector<std::unique_ptr<Number[]>> blocks_;
};

// For rows without their mean, the best product with some anchors, and their squared lengths.
template <Size ANCHORS>
void best_of(const float *rows, Size count, Size width, const float *mean, const float *anchors, float *best,
             float *squares) {
  on_cpu([=](auto) {
    const float *row = rows, *const last = rows + count * width - AHEAD;
    for (Size number = 0; number < count; ++number, row += width) {
      float products[ANCHORS + 1][LANES] = {};  // with the anchors, and with the row itself
      for (Size i = 0; i < width; i += LANES) {
        if (row + i < last) __builtin_prefetch(row + i + AHEAD);
        for (Size lane = 0; lane < LANES; ++lane) {
          const float value = row[i + lane] - mean[i + lane];
          for (Size anchor = 0; anchor < ANCHORS; ++anchor)
            products[anchor][lane] += value * anchors[anchor * width + i + lane];
          products[ANCHORS][lane] += value * value;
        }
      }
      for (Size anchor = 0; anchor < ANCHORS; ++anchor)
        best[number] = std::max(best[number], folded(products[anchor]));
      squares[number] = folded(products[ANCHORS]);
    }
  });
}

// Calls a function for the rows from `first` to `last` that are of each stretch.
template <class Stretch, class Function>
void by_stretch(const std::vector<Stretch> &stretches, Size first, Size last, Function function) {
  auto next = std::upper_bound(stretches.begin(), stretches.end(), first,
                               [](Size row, const Stretch &stretch) { return row < stretch.first; });
  for (Size from = first, to; from < last; from = to, ++next) {
    to = next == stretches.end() ? last : std::min(last, next->first);
    function(*std::prev(next), from, to);
  }
}

// Calls a function for neighbouring rows from `first` to `last` that are chosen, while the next of them
// comes from memory.
template <class Number, class Function>
void by_choice(const Chosen &chosen, const GrowingRows<Number> &rows, Size width, Size first, Size last,
               Function function) {
  if (chosen.empty()) return function(first, last);
  constexpr Size LINE = 64 / sizeof(Number);
  const auto next = [&](Size row, bool is_chosen) {
    while (row < last && (chosen[row] != 0) != is_chosen) ++row;
    return row;
  };
  for (Size from = next(first, true), to, then; from < last; from = then) {
    to = next(from, false);
    then = next(to, true);
    for (Size at = 0; then < last && at < width; at += LINE) __builtin_prefetch(rows[then] + at);
    function(from, to);
  }
}

// Vectors of length 1, or zero for an empty frame.
class LiveVectors : public LiveChannel {
 public:
  explicit LiveVectors(Size length)
      : length_(length), width_((length + LANES - 1) / LANES * LANES), rows_(width_), stretches_(1), total_(length),
        before_(length) {}

  Size bytes() const override { return length_ * static_cast<Size>(sizeof(float)); }
  Size rows() const { return rows_.rows(); }

  bool empty(const void *descriptor) const override {
    const auto *vector = static_cast<const float *>(descriptor);
    return std::all_of(vector, vector + length_, [](float number) { return number == 0; });
  }

  bool fits(const void *swept, Size anchors) const override {
    if (anchors > MOST_NUMBERS / length_) return false;
    const auto *vector = static_cast<const float *>(swept);
    for (Size anchor = 0; anchor < anchors; ++anchor, vector += length_) {
      const double length = std::sqrt(dot(vector, vector, length_));
      if (!(std::abs(length - 1) <= LENGTH_TOLERANCE || length == 0)) return false;
    }
    return anchors % 2 == 1;
  }

  void reserve(Size frames) override {
    rows_.reserve(frames);
    empty_.reserve(frames);
  }

  void start_stretch() override {
    if (stretches_.back().first == rows()) return;
    compute_mean();
    stretches_.push_back({rows(), {}});
    for (Size i = 0; i < length_; ++i) before_[i] += total_[i];
    std::fill(total_.begin(), total_.end(), 0.0);
    counted_before_ += counted_;
    counted_ = 0;
  }

  void append(const void *descriptor) override {
    const auto *vector = static_cast<const float *>(descriptor);
    float *row = rows_.append();
    std::copy_n(vector, length_, row);
    std::fill(row + length_, row + width_, 0.0F);
    empty_.push_back(empty(vector));
    for (Size i = 0; i < length_; ++i) total_[i] += static_cast<double>(vector[i]);
    counted_ += !empty_.back();
  }

  void scores(const void *swept, Size anchors, int threads, const Chosen &chosen, float *scores) override {
    compute_mean();
    const Floats units = centred(static_cast<const float *>(swept), anchors, stretches_.back().mean.data());
    const Size count = rows() - 1;
    over_blocks(count, GrowingRows<float>::ROWS, count < MANY ? 1 : threads, [&](Size first, Size last) {
      float squares[GrowingRows<float>::ROWS];
      std::fill(scores + first, scores + last, NONE);
      const auto compare = [&](const Stretch &stretch, Size from, Size to) {
        for (Size anchor = 0, some; anchor < anchors; anchor += some) {
          some = anchors - anchor >= TOGETHER ? TOGETHER : 1;
          (some > 1 ? best_of<TOGETHER> : best_of<1>)(rows_[from], to - from, width_, stretch.mean.data(),
                                                      units.data() + anchor * width_, scores + from,
                                                      squares + from - first);
        }
        for (Size row = from; row < to; ++row) {
          const double square = std::max(static_cast<double>(squares[row - first]), MIN_SQUARE);
          scores[row] = empty_[row] ? NONE : scores[row] / static_cast<float>(std::sqrt(square));
        }
      };
      by_stretch(stretches_, first, last, [&](const Stretch &stretch, Size from, Size to) {
        by_choice(chosen, rows_, width_, from, to, [&](Size start, Size end) { compare(stretch, start, end); });
      });
    });
  }

  void copy(Size first, Size last, void *descriptors) const override {
    auto *out = static_cast<float *>(descriptors);
    for (Size row = first; row < last; ++row, out += length_) std::copy_n(rows_[row], length_, out);
  }

  double cosine(const void *one, const void *other) const override {
    const auto *a = static_cast<const float *>(one), *b = static_cast<const float *>(other);
    const double length = std::max(std::sqrt(dot(a, a, length_)), ROUNDING);
    return dot(a, b, length_) / (length * std::max(std::sqrt(dot(b, b, length_)), ROUNDING));
  }

 private:
  struct Stretch {
    Size first;
    Floats mean;
  };

  void compute_mean() {  // of the present stretch
    const auto counted = static_cast<double>(std::max<Size>(1, counted_ + (counted_before_ ? MODEL.before : 0)));
    const double share =
        counted_before_ ? static_cast<double>(MODEL.before) / static_cast<double>(counted_before_) : 0;
    Floats &mean = stretches_.back().mean;
    mean.resize(width_);
    for (Size i = 0; i < length_; ++i) mean[i] = static_cast<float>((total_[i] + before_[i] * share) / counted);
  }

  // Anchors without the mean, of length 1 again; those that equal it are zero.
  Floats centred(const float *swept, Size anchors, const float *mean) const {
    Floats after(anchors * width_);
    for (Size anchor = 0; anchor < anchors; ++anchor, swept += length_) {
      float *vector = after.data() + anchor * width_, most = 0;
      for (Size i = 0; i < length_; ++i) {
        vector[i] = swept[i] - mean[i];
        most = std::max(most, std::abs(vector[i]));
      }
      const double length = std::max(std::sqrt(dot(vector, vector, width_)), ROUNDING);
      scale(vector, static_cast<float>(static_cast<double>(most) <= ROUNDING ? 0 : 1 / length), width_);
    }
    return after;
  }

  Size length_, width_;  // numbers of a vector, and with zeros that fill the lanes of a processor
  GrowingRows<float> rows_;
  std::vector<bool> empty_;
  std::vector<Stretch> stretches_;  // the last is the present one
  std::vector<double> total_, before_;
  Size counted_ = 0, counted_before_ = 0;
};

// Signs of frames on a grid, as numbers 1 and -1, and the scores of the last one.
//
// A mean is a sum of frames, so the products of a row with it are sums of the products with frames: a row that is
// compared takes in the last frame. One that was not compared for long has them anew, from the mean in some digits.
class CountedSigns {
 public:
  CountedSigns(const SignGrid &grid, int digits)
      : grid_(grid), moves_(grid.moves()), digits_(digits), signs_(grid.size()), products_(3 * moves_), marks_(1),
        stretches_(1), total_(grid.cells() * grid.bits()), before_(total_.size()) {
    for (Size move = 0; move < moves_; ++move) bits_.push_back(static_cast<float>(grid.overlapping(move)));
  }

  Size rows() const { return signs_.rows(); }

  void reserve(Size frames) {
    signs_.reserve(frames);
    products_.reserve(frames);
    marks_.reserve(frames);
  }

  // Gives rows after many frames what they would have if each had been compared; else they have it anew when
  // they are compared.
  void settle(const Chosen &chosen) {
    const Size before = stretches_.back().first;
    const SignMean sum = SignMean::rounded(mean().data(), digits_, true, grid_);
    const SignMean first = SignMean::rounded(mean_before().data(), digits_, true, grid_);
    by_stretch(stretches_, 0, rows(), [&](const Stretch &stretch, Size from, Size to) {
      for (Size row = from; row < to; ++row) {
        if (!chosen.empty() && !chosen[row]) continue;
        renew(row, row + 1, sum);
        if (!before) continue;
        if (!is_present(row) && !marks_[row]->is_measured) measure(row, stretch);
        float *sums = products_[row] + moves_;
        products(first, signs_[row], 1, grid_, count_moves, sums);
        for (Size move = 0; move < moves_; ++move) sums[move] *= static_cast<float>(before);
        marks_[row]->knows_before = true;
      }
    });
  }

  // Rows of the stretch that ended are measured now, or when they are compared.
  void start_stretch(bool measured) {
    Stretch &ended = stretches_.back();
    if (ended.first == rows()) return;
    ended.mean = mean();
    const Floats of_mean = lengths(squares(ended.mean, Floats(ended.mean.size())), grid_, false);
    const float others = 1 - share(), share_next = static_cast<float>(MODEL.before) / static_cast<float>(rows());
    for (Size row = 0; row < rows(); ++row) {
      Mark &mark = *marks_[row];
      float *sums = products_[row], *before = sums + moves_;
      const bool is_behind = this->is_behind(row);
      for (Size seen = mark.frames; seen < rows() && !is_behind; ++seen) take(seen, row);
      if (row >= ended.first) {
        mark.is_measured = !is_behind;
        if (mark.is_measured) to_lengths(of_mean, frames(), sums + 2 * moves_);
        else if (measured) measure(row, ended);
      }
      mark.frames = is_behind || !mark.knows_before ? 0 : rows();
      for (Size move = 0; move < moves_ && mark.frames; ++move) {
        before[move] = sums[move] + others * before[move];
        sums[move] = share_next * before[move];
      }
    }
    add(before_.data(), total_.data(), 1, static_cast<Size>(total_.size()));
    std::fill(total_.begin(), total_.end(), 0.0F);
    stretches_.push_back({rows(), {}});
  }

  void append(const std::uint8_t *signs) {
    std::copy_n(packed(signs, 1, grid_).data(), grid_.size(), signs_.append());
    std::fill_n(products_.append(), 3 * moves_, 0.0F);
    *marks_.append() = {};
    add(total_.data(), unpacked(signs_[rows() - 1]).data(), 1, static_cast<Size>(total_.size()));
  }

  void scores(int threads, const Chosen &chosen, float *scores) {
    const Size count = rows() - 1;
    const Stretch &present = stretches_.back();
    const Floats mean = this->mean(), frame = unpacked(signs_[count]), nothing(mean.size());
    Floats centred = frame;
    add(centred.data(), mean.data(), -1, static_cast<Size>(mean.size()));
    // By move: lengths of the last frame and of the mean; by stretch, products of the frame with its mean.
    const Floats query = lengths(squares(centred, nothing), grid_, true), of_mean = lengths(squares(mean, nothing), grid_, false);
    std::vector<Floats> of_means;
    for (const Stretch &stretch : stretches_) of_means.push_back(products_of(centred, &stretch == &present ? mean : stretch.mean));
    SignMean digits;
    for (Size row = 0; row < count && !digits.count(); ++row)
      if ((chosen.empty() || chosen[row]) && is_behind(row))
        digits = SignMean::rounded(mean.data(), digits_, true, grid_);
    const double frames = this->frames();
    const auto share = static_cast<float>(1 / frames);
    over_blocks(count, AT_ONCE, count < MANY ? 1 : threads, [&](Size first, Size last) {
      std::fill(scores + first, scores + last, NONE);
      std::vector<std::int32_t> differing(2 * moves_ * AT_ONCE);
      Floats there(moves_);
      by_stretch(stretches_, first, last, [&](const Stretch &stretch, Size from, Size to) {
        const bool is_present = &stretch == &present;
        const Floats &of_its_mean = of_means[&stretch - stretches_.data()];
        by_choice(chosen, signs_, grid_.size(), from, to, [&](Size start, Size end) {
          const Size some = end - start;
          count_moves(signs_[count], signs_[start], some, grid_, differing.data());
          if (is_present) count_in_place(signs_[count], signs_[start], some, grid_, differing.data() + moves_ * some);
          for (Size row = start, next; row < end; row = next) {
            for (next = row; next < end && is_behind(next);) ++next;
            if (next > row) renew(row, next, digits);
            else ++next;
          }
          for (Size row = start; row < end; ++row) {
            Mark &mark = *marks_[row];
            if (!is_present && !mark.is_measured) measure(row, stretch);
            float *sums = products_[row], *lengths = sums + 2 * moves_;
            const std::int32_t *differs = differing.data() + row - start;
            while (mark.frames < count) take(mark.frames, row);
            for (Size move = 0; move < moves_ && mark.frames == count; ++move) {
              sums[move] += bits_[move] - 2 * static_cast<float>(differs[move * some]);
              if (is_present) lengths[move] += bits_[move] - 2 * static_cast<float>(differs[(moves_ + move) * some]);
            }
            mark.frames = rows();
            if (is_present) {
              std::copy_n(lengths, moves_, there.data());
              to_lengths(of_mean, frames, there.data());
              lengths = there.data();
            }
            float best = NONE;
            for (Size move = 0; move < moves_; ++move) {
              const auto at = move;
              const float product = bits_[at] - 2 * static_cast<float>(differs[move * some]) - share * sums[move] - of_its_mean[at];
              const float both = query[at] * lengths[move];
              best = std::max(best, both > LEAST ? product / both : 0);
            }
            scores[row] = std::min(best, 1.0F);
          }
        });
      });
    });
    // The last frame as a row.
    const Floats moved = products_of(mean, frame), of_before = products_of(before_, frame);
    const Floats without = lengths(squares(frame, mean), grid_, false);
    for (Size move = 0; move < moves_; ++move) {
      const auto at = move;
      float *sums = products_[count] + move;
      sums[0] = moved[at] / share;
      sums[moves_] = of_before[at];
      sums[2 * moves_] = (bits_[at] + of_mean[at] * of_mean[at] - without[at] * without[at]) / (2 * share);
    }
    *marks_[count] = {rows(), true, false};
  }

  void copy(Size first, Size last, std::uint8_t *signs) const {
    for (Size row = first; row < last; ++row)
      for (Size cell = 0; cell < grid_.cells(); ++cell, signs += grid_.bytes)
        std::memcpy(signs, signs_[row] + cell * grid_.words(), grid_.bytes);
  }

  double cosine(const std::uint8_t *one, const std::uint8_t *other) const {
    const SignGrid still{grid_.columns, grid_.rows, grid_.bytes};
    std::int32_t differing = 0;
    count_moves(packed(one, 1, still).data(), packed(other, 1, still).data(), 1, still, &differing);
    return 1 - 2.0 * differing / static_cast<double>(total_.size());
  }

 private:
  struct Stretch {
    Size first;
    Floats mean;  // once it has ended
  };
  // How many frames the products of a row take in; whether those with the frames before the present stretch are
  // known; whether its stretch has ended and it has its lengths without the mean.
  struct Mark {
    Size frames = 0;
    bool knows_before = false, is_measured = false;
  };

  Floats unpacked(const Word *signs) const {
    Floats numbers(total_.size());
    on_cpu([=, grid = grid_, number = numbers.data()](auto) {
      for (Size cell = 0; cell < grid.cells(); ++cell)
        for (Size word = 0; word < grid.words(); ++word) {
          const Size first = cell * grid.bits() + 64 * word, count = std::min<Size>(64, grid.bits() - 64 * word);
          for (Size bit = 0; bit < count; ++bit)
            number[first + bit] = static_cast<float>(static_cast<int>(signs[cell * grid.words() + word] >> bit & 1) * 2 - 1);
        }
    });
    return numbers;
  }

  bool is_present(Size row) const { return row >= stretches_.back().first; }

  float share() const {  // by which the frames before the present stretch count in its mean
    const Size first = stretches_.back().first;
    return first ? static_cast<float>(MODEL.before) / static_cast<float>(first) : 0;
  }

  double frames() const {  // that this mean is of
    const Size first = stretches_.back().first;
    return static_cast<double>(rows() - first + (first ? MODEL.before : 0));
  }

  Floats mean() const {
    Floats mean = total_;
    add(mean.data(), before_.data(), share(), static_cast<Size>(mean.size()));
    scale(mean.data(), static_cast<float>(1 / frames()), static_cast<Size>(mean.size()));
    return mean;
  }

  Floats mean_before() const {
    Floats mean = before_;
    scale(mean.data(), 1 / static_cast<float>(std::max<Size>(1, stretches_.back().first)), static_cast<Size>(mean.size()));
    return mean;
  }

  // Of the cells.
  std::vector<double> squares(const Floats &numbers, const Floats &less) const {
    Floats centred = numbers;
    add(centred.data(), less.data(), -1, static_cast<Size>(centred.size()));
    std::vector<double> squares;
    for (const float *cell = centred.data(); cell < centred.data() + centred.size(); cell += grid_.bits())
      squares.push_back(dot(cell, cell, grid_.bits()));
    return squares;
  }

  // By move.
  Floats products_of(const Floats &moved, const Floats &numbers) const {
    Floats products(moves_);
    on_cpu([=, grid = grid_, one = moved.data(), other = numbers.data(), out = products.data()](auto) {
      const Size cell = grid.bits();
      for (Size move = 0; move < grid.moves(); ++move) {
        const auto [ours, our_row, theirs, their_row, columns, cells] = grid.overlap(move);
        float lanes[2 * LANES] = {};
        for (Size at = 0; at < columns; ++at) {
          const float *a = one + ((ours + at) * grid.rows + our_row) * cell;
          const float *b = other + ((theirs + at) * grid.rows + their_row) * cell;
          Size number = 0;
          for (; number + 2 * LANES <= cells * cell; number += 2 * LANES)
            for (Size lane = 0; lane < 2 * LANES; ++lane) lanes[lane] += a[number + lane] * b[number + lane];
          for (; number < cells * cell; ++number) lanes[0] += a[number] * b[number];
        }
        out[move] = folded(lanes) + folded(lanes + LANES);
      }
    });
    return products;
  }

  // Makes of the products of a row with the sum, where it is, its lengths without the mean, of which those are given.
  void to_lengths(const Floats &of_mean, double frames, float *products) const {
    const auto twice = static_cast<float>(2 / frames);
    for (Size move = 0; move < moves_; ++move) {
      const float square = bits_[move] - twice * products[move] + of_mean[move] * of_mean[move];
      products[move] = square > LEAST_SQUARE * bits_[move] ? std::sqrt(square) : 0;
    }
  }

  void measure(Size row, const Stretch &stretch) {
    const Floats without = lengths(squares(unpacked(signs_[row]), stretch.mean), grid_, false);
    std::copy(without.begin(), without.end(), products_[row] + 2 * moves_);
    marks_[row]->is_measured = true;
  }

  // Whether a row has no products with the present sum, or misses more than a few frames.
  bool is_behind(Size row) const {
    const Size frames = marks_[row]->frames;
    return frames < stretches_.back().first || rows() - frames > FEW;
  }

  // Gives neighbouring rows of a stretch their products with the present sum, by its mean.
  void renew(Size first, Size last, const SignMean &mean) {
    const Size count = last - first;
    Floats moved(moves_ * count), there(moved.size());
    products(mean, signs_[first], count, grid_, count_moves, moved.data());
    if (is_present(first)) products(mean, signs_[first], count, grid_, count_in_place, there.data());
    const auto sum = static_cast<float>(frames());
    for (Size row = first; row < last; ++row) {
      float *sums = products_[row];
      for (Size move = 0; move < moves_; ++move) {
        const Size at = move * count + row - first;
        sums[move] = sum * moved[at];
        if (is_present(first)) sums[2 * moves_ + move] = sum * there[at];
      }
      marks_[row]->frames = rows();
      marks_[row]->knows_before = !stretches_.back().first;
    }
  }

  // Adds a frame of the present stretch to the products of a row.
  void take(Size frame, Size row) {
    std::vector<std::int32_t> differing(moves_);
    for (Size kind = 0; kind < 1 + is_present(row); ++kind) {
      (kind ? count_in_place : count_moves)(signs_[frame], signs_[row], 1, grid_, differing.data());
      for (Size move = 0; move < moves_; ++move)
        products_[row][2 * kind * moves_ + move] += bits_[move] - 2 * static_cast<float>(differing[move]);
    }
    marks_[row]->frames = frame + 1;
  }

  SignGrid grid_;
  Size moves_;
  int digits_;
  Floats bits_;  // that overlap in a move
  GrowingRows<Word> signs_;
  // By move, of a row: the products of the sum, moved, and of that of the frames before the stretch; and of the sum
  // where it is, or the lengths of the row without its mean.
  GrowingRows<float> products_;
  GrowingRows<Mark> marks_;
  std::vector<Stretch> stretches_;  // the last is the present one
  Floats total_, before_;           // sums of the frames of the present stretch, and of those before
};

// Signs on a grid of cells; of each cell some bytes, evenly spaced, are the part.
class LiveSigns : public LiveChannel {
 public:
  explicit LiveSigns(const SignGrid &grid)
      : size_(grid.cells() * grid.bytes), cell_(grid.bytes), stride_(std::max<Size>(1, grid.bytes / PART)),
        signs_(grid.swept(), DIGITS),
        part_({grid.columns, 1, grid.rows * ((cell_ + stride_ - 1) / stride_), std::min(REACH, grid.columns - 1), 0},
              PART_DIGITS) {}

  Size bytes() const override { return size_; }
  bool empty(const void *descriptor) const override {
    const auto *signs = static_cast<const std::uint8_t *>(descriptor);
    return std::all_of(signs, signs + size_, [](std::uint8_t byte) { return byte == 0; });
  }
  bool fits(const void *, Size anchors) const override { return anchors == 1; }
  void reserve(Size frames) override {
    signs_.reserve(frames);
    part_.reserve(frames);
  }
  void start_stretch() override {
    signs_.start_stretch(false);
    part_.start_stretch(true);
  }
  void append(const void *descriptor) override {
    const auto *signs = static_cast<const std::uint8_t *>(descriptor);
    std::vector<std::uint8_t> part;
    for (Size cell = 0; cell < size_; cell += cell_)
      for (Size at = 0; at < cell_; at += stride_) part.push_back(signs[cell + at]);
    signs_.append(signs);
    part_.append(part.data());
  }
  void scores(const void *, Size, int threads, const Chosen &chosen, float *scores) override {
    signs_.scores(threads, chosen, scores);
  }
  bool has_part() const override { return true; }
  void rough_scores(int threads, float *scores) override { part_.scores(threads, {}, scores); }
  void settle(const Chosen &chosen) override {
    signs_.settle(chosen);
    part_.settle({});
  }
  void copy(Size first, Size last, void *descriptors) const override {
    signs_.copy(first, last, static_cast<std::uint8_t *>(descriptors));
  }
  double cosine(const void *one, const void *other) const override {
    return signs_.cosine(static_cast<const std::uint8_t *>(one), static_cast<const std::uint8_t *>(other));
  }

 private:
  Size size_, cell_, stride_;  // bytes: of all, of a cell, from one to the next of those of the part
  CountedSigns signs_, part_;
};
}  // namespace

std::unique_ptr<LiveChannel> channel_of(const ssrvlad_loops_channel &channel) {
  const auto &[kind, shape, trust] = channel;
  if (kind == SSRVLAD_VECTORS) return std::make_unique<LiveVectors>(shape[0]);
  return std::make_unique<LiveSigns>(SignGrid{shape[0], shape[1], shape[2]});
}

}  // namespace places
