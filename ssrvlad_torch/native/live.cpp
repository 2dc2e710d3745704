// The channels of live.hpp.

#include "live.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>

#include "parallel.hpp"

namespace places {

namespace {
constexpr Size AHEAD = 1024;    // numbers that come from memory while others are computed
constexpr Size TOGETHER = 3;     // anchors that are compared with a row at once
constexpr Size MANY = 1 << 13;  // rows from which threads share them
constexpr double LENGTH_TOLERANCE = 1e-3;
constexpr Size REACH = 2;       // columns by which signs are moved to each side
constexpr Size MOST_MOVES = 64;
constexpr Size PART = 2;        // bytes of a cell by which frames are roughly compared
constexpr Size DIGITS = 20;     // of the mean of a stretch that has ended
constexpr double LEVELS = (1 << DIGITS) - 1;
constexpr double MIN_SQUARE = 1e-9, LEAST = 1e-3;  // of a length without a mean, of two lengths' product

std::size_t place(Size at) { return static_cast<std::size_t>(at); }

// What a digit of a mean weighs.
double weight(Size digit) { return static_cast<double>(1 << digit) / LEVELS; }

SSRVLAD_INLINE void prefetch(const void *numbers) { __builtin_prefetch(numbers); }

// For rows without their mean, the best product with some anchors, and their squared lengths.
template <Size ANCHORS>
void best_of(const float *rows, Size count, Size width, const float *mean, const float *anchors, float *best,
             float *squares) {
  on_cpu([=](auto) {
    const float *row = rows, *const last = rows + count * width - AHEAD;
    for (Size number = 0; number < count; ++number, row += width) {
      float products[ANCHORS + 1][LANES] = {};  // with the anchors, and with the row itself
      for (Size i = 0; i < width; i += LANES) {
        if (row + i < last) prefetch(row + i + AHEAD);
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
    while (row < last && (chosen[place(row)] != 0) != is_chosen) ++row;
    return row;
  };
  for (Size from = next(first, true), to, then; from < last; from = then) {
    to = next(from, false);
    then = next(to, true);
    for (Size at = 0; then < last && at < width; at += LINE) prefetch(rows[then] + at);
    function(from, to);
  }
}

}  // namespace

// ------------------------------------------------------------------------------------------- vectors

LiveVectors::LiveVectors(Size length)
    : length_(length),
      width_((length + LANES - 1) / LANES * LANES),
      rows_(width_),
      stretches_(1),
      total_(place(length)),
      before_(place(length)) {}

bool LiveVectors::empty(const void *descriptor) const {
  const auto *vector = static_cast<const float *>(descriptor);
  return std::all_of(vector, vector + length_, [](float number) { return number == 0; });
}

bool LiveVectors::fits(const void *swept, Size anchors) const {
  if (anchors > MOST_NUMBERS / length_) return false;
  const auto *vector = static_cast<const float *>(swept);
  for (Size anchor = 0; anchor < anchors; ++anchor, vector += length_) {
    const double length = std::sqrt(dot(vector, vector, length_));
    if (!(std::abs(length - 1) <= LENGTH_TOLERANCE || length == 0)) return false;
  }
  return anchors % 2 == 1;
}

void LiveVectors::reserve(Size frames) {
  rows_.reserve(frames);
  empty_.reserve(place(frames));
}

void LiveVectors::append(const void *descriptor) {
  const auto *vector = static_cast<const float *>(descriptor);
  float *row = rows_.append();
  std::copy_n(vector, length_, row);
  std::fill(row + length_, row + width_, 0.0F);
  empty_.push_back(empty(vector));
  for (Size i = 0; i < length_; ++i) total_[place(i)] += static_cast<double>(vector[i]);
  counted_ += !empty_.back();
}

void LiveVectors::start_stretch() {
  if (stretches_.back().first == rows()) return;
  compute_mean();
  stretches_.push_back({rows(), {}});
  for (Size i = 0; i < length_; ++i) before_[place(i)] += total_[place(i)];
  std::fill(total_.begin(), total_.end(), 0.0);
  counted_before_ += counted_;
  counted_ = 0;
}

void LiveVectors::compute_mean() {
  const auto counted = static_cast<double>(std::max<Size>(1, counted_ + (counted_before_ ? MODEL.before : 0)));
  const double share =
      counted_before_ ? static_cast<double>(MODEL.before) / static_cast<double>(counted_before_) : 0;
  std::vector<float> &mean = stretches_.back().mean;
  mean.resize(place(width_));
  for (Size i = 0; i < length_; ++i)
    mean[place(i)] = static_cast<float>((total_[place(i)] + before_[place(i)] * share) / counted);
}

// Anchors without the mean, of length 1 again; those that equal it are zero.
std::vector<float> LiveVectors::centred(const float *swept, Size anchors, const float *mean) const {
  std::vector<float> after(place(anchors * width_));
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

void LiveVectors::scores(const void *swept, Size anchors, int threads, const Chosen &chosen,
                         float *scores) {
  compute_mean();
  const std::vector<float> all =
      centred(static_cast<const float *>(swept), anchors, stretches_.back().mean.data());
  const Size count = rows() - 1;
  over_blocks(count, GrowingRows<float>::ROWS, count < MANY ? 1 : threads, [&](Size first, Size last) {
    float squares[GrowingRows<float>::ROWS];
    std::fill(scores + first, scores + last, NONE);
    const auto compare = [&](const Stretch &stretch, Size from, Size to) {
      for (Size anchor = 0; anchor < anchors;) {
        const bool several = anchors - anchor >= TOGETHER;
        (several ? best_of<TOGETHER> : best_of<1>)(rows_[from], to - from, width_, stretch.mean.data(),
                                            all.data() + anchor * width_, scores + from,
                                            squares + from - first);
        anchor += several ? TOGETHER : 1;
      }
      for (Size row = from; row < to; ++row) {
        const double square = std::max(static_cast<double>(squares[row - first]), MIN_SQUARE);
        scores[row] = empty_[place(row)] ? NONE : scores[row] / static_cast<float>(std::sqrt(square));
      }
    };
    by_stretch(stretches_, first, last, [&](const Stretch &stretch, Size from, Size to) {
      by_choice(chosen, rows_, width_, from, to,
                [&](Size start, Size end) { compare(stretch, start, end); });
    });
  });
}

void LiveVectors::copy(Size first, Size last, void *descriptors) const {
  auto *out = static_cast<float *>(descriptors);
  for (Size row = first; row < last; ++row, out += length_) std::copy_n(rows_[row], length_, out);
}

double LiveVectors::cosine(const void *one, const void *other) const {
  const auto *a = static_cast<const float *>(one), *b = static_cast<const float *>(other);
  const double length = std::max(std::sqrt(dot(a, a, length_)), ROUNDING);
  return dot(a, b, length_) / (length * std::max(std::sqrt(dot(b, b, length_)), ROUNDING));
}

// --------------------------------------------------------------------------------------------- signs

CountedSigns::CountedSigns(Size columns, Size bytes)
    : columns_(columns),
      bytes_(bytes),
      grid_{columns, 1, (bytes + 7) / 8, std::min(REACH, columns - 1), 0},
      moves_(grid_.moves()),
      nothing_(place(grid_.size())),
      frames_(grid_.size(), 4 * moves_),
      planes_(grid_.size(), 4 * moves_),
      stretches_(1) {
  for (Size product = 0; product < 2 * moves_; ++product)
    bits_.push_back(static_cast<double>(8 * bytes * grid_.overlap(product % moves_).cells()));
  for (Products *products : {&of_all_, &of_all_before_, &of_before_all_, &of_before_, &with_all_, &with_before_})
    products->resize(bits_.size());
}

void CountedSigns::Store::append(const Word *words) {
  std::copy_n(words, size, signs.append());
  std::fill_n(products.append(), width, 0.0);
  *marks.append() = {};
}

void CountedSigns::reserve(Size frames) {
  frames_.signs.reserve(frames);
  frames_.products.reserve(frames);
  frames_.marks.reserve(frames);
}

CountedSigns::Words CountedSigns::packed(const std::uint8_t *signs) const {
  Words frame(place(grid_.size()));
  for (Size column = 0; column < columns_; ++column)
    std::memcpy(frame.data() + column * grid_.words, signs + column * bytes_, place(bytes_));
  return frame;
}

void CountedSigns::copy(Size first, Size last, std::uint8_t *signs) const {
  for (Size row = first; row < last; ++row)
    for (Size column = 0; column < columns_; ++column, signs += bytes_)
      std::memcpy(signs, frames_.signs[row] + column * grid_.words, place(bytes_));
}

double CountedSigns::cosine(const std::uint8_t *one, const std::uint8_t *other) const {
  const Size middle = moves_ / 2;
  std::array<std::int32_t, MOST_MOVES> differing;
  count_moves(packed(one).data(), packed(other).data(), 1, grid_, differing.data());
  return 1 - 2.0 * differing[place(middle)] / bits_[place(middle)];
}

// Adds products of signs, the first `size` of both kinds.
void CountedSigns::add_product(const Word *moved, const Word *signs, double factor, double *sums,
                               Size size) const {
  std::array<std::int32_t, 2 * MOST_MOVES> differing;
  count_moves(moved, signs, 1, grid_, differing.data());
  if (size > moves_) count_in_place(moved, signs, 1, grid_, differing.data() + moves_);
  for (Size product = 0; product < size; ++product)
    sums[product] += factor * (bits_[place(product)] - 2.0 * differing[place(product)]);
}

// Adds the products with a sum. A count of frames is the sum of half the numbers 1 and -1 of each digit, and
// half of all its values.
void CountedSigns::add_sum(const Sum &sum, const Word *signs, double *sums, Size size) const {
  double value = 1;
  for (const Words &digit : sum.digits) add_product(digit.data(), signs, value, sums, size), value *= 2;
  add_product(nothing_.data(), signs, static_cast<double>(sum.frames) + 1 - value, sums, size);
}

void CountedSigns::add(const Word *frame, Sum &sum) const {
  ++sum.frames;
  Words carry(frame, frame + grid_.size());
  for (std::size_t digit = 0; sum.frames >> digit; ++digit) {
    if (digit == sum.digits.size()) sum.digits.emplace_back(carry.size());
    for (std::size_t word = 0; word < carry.size(); ++word) {
      const Word both = carry[word] & sum.digits[digit][word];
      sum.digits[digit][word] ^= carry[word];
      carry[word] = both;
    }
  }
}

CountedSigns::Mean CountedSigns::mean() const {
  const auto before = static_cast<double>(before_.frames), own = static_cast<double>(all_.frames) - before;
  if (!before_.frames) return {own, 0};
  return {own + static_cast<double>(MODEL.before), static_cast<double>(MODEL.before) / before - 1};
}

CountedSigns::Products CountedSigns::squares(const Mean &mean) const {
  Products squares;
  for (std::size_t product = 0; product < bits_.size(); ++product) {
    const double both = of_all_before_[product] + of_before_all_[product];
    const double sum = of_all_[product] + mean.less * both + mean.less * mean.less * of_before_[product];
    squares.push_back(sum / (mean.frames * mean.frames));
  }
  return squares;
}

void CountedSigns::append(const std::uint8_t *signs) {
  const Words frame = packed(signs);
  frames_.append(frame.data());
  add(frame.data(), all_);
  Products self(bits_.size());
  add_product(frame.data(), frame.data(), 1, self.data(), 2 * moves_);
  std::fill(with_all_.begin(), with_all_.end(), 0);
  std::fill(with_before_.begin(), with_before_.end(), 0);
  add_sum(all_, frame.data(), with_all_.data(), 2 * moves_);
  add_sum(before_, frame.data(), with_before_.data(), 2 * moves_);
  for (std::size_t product = 0; product < self.size(); ++product) {
    const auto mirror = place(mirrored(static_cast<Size>(product)));
    of_all_[product] += with_all_[product] + with_all_[mirror] - self[product];
    of_all_before_[product] += with_before_[mirror];
    of_before_all_[product] += with_before_[product];
  }
}

void CountedSigns::start_stretch() {
  Stretch &ended = stretches_.back();
  if (ended.first == rows()) return;
  const Mean mean = this->mean();
  const Products squares = this->squares(mean);
  ended.squares.assign(squares.begin() + moves_, squares.end());
  for (Size row = ended.first; row < rows(); ++row) {
    Mark &mark = *frames_.marks[row];
    mark.is_measured = mark.stretch == present() && mark.frames == rows();
    if (mark.is_measured) to_lengths(ended, mean, frames_.products[row] + moves_);
  }
  append_mean(mean);
  before_ = all_;
  of_all_before_ = of_before_all_ = of_before_ = of_all_;
  stretches_.push_back({rows(), {}});
}

// Makes of the products in place of a row, with the sums of all and before, or with a mean, its lengths.
void CountedSigns::to_lengths(const Stretch &stretch, const Mean &mean, double *products) const {
  for (Size move = 0; move < moves_; ++move) {
    const double product = mean.of(products, products + 2 * moves_, move);
    const double square = bits_[place(move)] - 2 * product + stretch.squares[place(move)];
    products[move] = std::sqrt(std::max(0.0, square));
  }
}

void CountedSigns::append_mean(const Mean &mean) {
  constexpr Size BITS = 64;
  std::vector<Words> planes(DIGITS, Words(place(grid_.size())));
  for (Size word = 0; word < grid_.size(); ++word) {
    std::array<std::array<std::int32_t, BITS>, 2> counts{};
    for (const Sum *sum : {&all_, &before_})
      for (std::size_t digit = 0; digit < sum->digits.size(); ++digit)
        for (std::size_t bit = 0; bit < BITS; ++bit)
          counts[sum == &before_][bit] += static_cast<std::int32_t>(sum->digits[digit][place(word)] >> bit & 1) << digit;
    for (Size bit = 0; bit < std::min(BITS, 8 * bytes_ - word % grid_.words * BITS); ++bit) {
      const double all = 2.0 * counts[0][place(bit)] - static_cast<double>(all_.frames);
      const double before = 2.0 * counts[1][place(bit)] - static_cast<double>(before_.frames);
      const double share = (mean.of(&all, &before, 0) + 1) / 2;
      const auto level = static_cast<Word>(std::lround(LEVELS * std::max(0.0, std::min(share, 1.0))));
      for (Size digit = 0; digit < DIGITS; ++digit)
        planes[place(digit)][place(word)] |= (level >> digit & 1) << bit;
    }
  }
  for (const Words &plane : planes) planes_.append(plane.data());
}

// Brings the first `size` products of a row to the sum of the first frames; `sum` has these and perhaps more.
void CountedSigns::bring(Store &store, Size row, Size to, const Sum &sum, Size size) const {
  Mark &mark = *store.marks[row];
  const Word *signs = store.signs[row];
  double *all = store.products[row];
  if (to - mark.frames <= static_cast<Size>(sum.digits.size())) {
    for (Size frame = mark.frames; frame < to; ++frame) add_product(frames_.signs[frame], signs, 1, all, size);
  } else {
    std::fill_n(all, size, 0.0);
    add_sum(sum, signs, all, size);
    for (Size frame = to; frame < sum.frames; ++frame) add_product(frames_.signs[frame], signs, -1, all, size);
  }
  mark.frames = to;
}

// Fills the products of the last frame, moved, with neighbouring rows, by row and move, and takes it into the
// first `size` products of these.
void CountedSigns::compare(Store &store, Size first, Size last, Size size, std::int32_t *differing,
                           double *products) const {
  const Size count = last - first, before = rows() - 1, number = present();
  const Word *frame = frames_.signs[before];
  count_moves(frame, store.signs[first], count, grid_, differing);
  if (size > moves_) count_in_place(frame, store.signs[first], count, grid_, differing + moves_ * count);
  for (Size row = first; row < last; ++row, products += moves_) {
    Mark &mark = *store.marks[row];
    double *all = store.products[row];
    if (mark.stretch != number) {
      bring(store, row, before_.frames, before_, size);
      std::copy_n(all, size, all + 2 * moves_);
      mark.stretch = number;
    }
    const auto product = [&](Size at) {
      return bits_[place(at)] - 2.0 * differing[at * count + row - first];
    };
    for (Size move = 0; move < moves_; ++move) products[move] = product(move);
    if (mark.frames > before) continue;  // it has the frame
    bring(store, row, before, all_, size);
    for (Size at = 0; at < size; ++at) all[at] += product(at);
    ++mark.frames;
  }
}

// Gives a row of a stretch that has ended its lengths without the mean.
void CountedSigns::measure(Size row, Size number) {
  Mark &mark = *frames_.marks[row];
  if (mark.is_measured) return;
  Products products(place(4 * moves_));
  for (Size digit = 0; digit < DIGITS; ++digit)
    add_product(planes_.signs[number * DIGITS + digit], frames_.signs[row], weight(digit), products.data(), 2 * moves_);
  to_lengths(stretches_[place(number)], {1, 0}, products.data() + moves_);
  std::copy_n(products.data() + moves_, moves_, frames_.products[row] + moves_);
  mark.is_measured = true;
}

void CountedSigns::scores(int threads, const Chosen &chosen, float *scores) {
  const Size count = rows() - 1, block = GrowingRows<Word>::ROWS;
  const Mean mean = this->mean();
  const Products squares = this->squares(mean);
  // By move, the length of the last frame without its mean; by stretch and move, its product with a mean.
  Products query, of_means(place(moves_) * stretches_.size());
  double *of_present = of_means.data() + present() * moves_;
  for (Size move = 0; move < moves_; ++move) {
    const Size mirror = mirrored(move), there = moves_ + mirror;
    const double product = mean.of(with_all_.data(), with_before_.data(), there);
    query.push_back(std::sqrt(std::max(0.0, bits_[place(move)] - 2 * product + squares[place(there)])));
    of_present[move] = mean.of(with_all_.data(), with_before_.data(), mirror) - squares[place(move)];
  }
  // Makes of the products of the last frame with rows those without its mean.
  const auto centre = [&](const double *all, double *products) {
    for (Size move = 0; move < moves_; ++move) products[move] -= mean.of(all, all + 2 * moves_, move);
  };
  over_blocks(planes_.signs.rows(), block, 1, [&](Size first, Size last) {
    Products products(place(moves_ * (last - first)));
    std::vector<std::int32_t> differing(products.size());
    compare(planes_, first, last, moves_, differing.data(), products.data());
    double *centred = products.data();
    for (Size row = first; row < last; ++row, centred += moves_) {
      centre(planes_.products[row], centred);
      for (Size move = 0; move < moves_; ++move)
        of_means[place(row / DIGITS * moves_ + move)] += weight(row % DIGITS) * centred[move];
    }
  });
  over_blocks(count, block, count < MANY ? 1 : threads, [&](Size first, Size last) {
    std::fill(scores + first, scores + last, NONE);
    Products products(place(moves_ * (last - first)));
    std::vector<std::int32_t> differing(2 * products.size());
    by_stretch(stretches_, first, last, [&](const Stretch &stretch, Size from, Size to) {
      const Size number = &stretch - stretches_.data();
      const bool is_present = number == present();
      by_choice(chosen, frames_.signs, grid_.size(), from, to, [&](Size start, Size end) {
        compare(frames_, start, end, is_present ? 2 * moves_ : moves_, differing.data(), products.data());
        double *centred = products.data();
        for (Size row = start; row < end; ++row, centred += moves_) {
          if (!is_present) measure(row, number);
          const double *all = frames_.products[row];
          centre(all, centred);
          double best = -std::numeric_limits<double>::infinity();
          for (Size move = 0; move < moves_; ++move) {
            double length = all[moves_ + move];
            if (is_present) {
              const double product = mean.of(all, all + 2 * moves_, moves_ + move);
              length = std::sqrt(std::max(0.0, bits_[place(move)] - 2 * product + squares[place(moves_ + move)]));
            }
            const double product = centred[move] - of_means[place(number * moves_ + move)];
            best = std::max(best, product / std::max(query[place(move)] * length, LEAST));
          }
          scores[row] = static_cast<float>(std::min(best, 1.0));
        }
      });
    });
  });
}

LiveSigns::LiveSigns(Size columns, Size size, Size cell)
    : columns_(columns),
      size_(size),
      cell_(cell),
      stride_(std::max<Size>(1, cell / PART)),
      signs_(columns, size),
      part_(columns, size / cell * ((cell + stride_ - 1) / stride_)) {}

bool LiveSigns::empty(const void *descriptor) const {
  const auto *signs = static_cast<const std::uint8_t *>(descriptor);
  return std::all_of(signs, signs + bytes(), [](std::uint8_t byte) { return byte == 0; });
}

void LiveSigns::reserve(Size frames) {
  signs_.reserve(frames);
  part_.reserve(frames);
}

void LiveSigns::start_stretch() {
  signs_.start_stretch();
  part_.start_stretch();
}

// The part has some bytes of each cell, evenly spaced.
void LiveSigns::append(const void *descriptor) {
  const auto *signs = static_cast<const std::uint8_t *>(descriptor);
  std::vector<std::uint8_t> part;
  for (Size cell = 0; cell < bytes(); cell += cell_)
    for (Size at = 0; at < cell_; at += stride_) part.push_back(signs[cell + at]);
  signs_.append(signs);
  part_.append(part.data());
}

void LiveSigns::copy(Size first, Size last, void *descriptors) const {
  signs_.copy(first, last, static_cast<std::uint8_t *>(descriptors));
}

double LiveSigns::cosine(const void *one, const void *other) const {
  return signs_.cosine(static_cast<const std::uint8_t *>(one), static_cast<const std::uint8_t *>(other));
}

}  // namespace places
