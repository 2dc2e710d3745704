// The channels of live.hpp.

#include "live.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>

#include "parallel.hpp"

namespace places {

namespace {
constexpr Size AHEAD = 1024;    // numbers that come from memory while others are computed
constexpr Size TOGETHER = 3;     // anchors that are compared with a row at once
constexpr Size MANY = 1 << 13;  // rows from which threads share them
constexpr double LENGTH_TOLERANCE = 1e-3;
constexpr Size PART = 2;  // bytes of a cell by which all rows of a large memory are compared
constexpr double MIN_SQUARE = 1e-9, LEAST = 1e-3;  // of a length without a mean, of two lengths' product

std::size_t place(Size at) { return static_cast<std::size_t>(at); }

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
template <class Stretches, class Function>
void by_stretch(const Stretches &stretches, Size first, Size last, Function function) {
  for (std::size_t number = 0; number < stretches.size(); ++number) {
    const Size end = number + 1 < stretches.size() ? stretches[number + 1].first : last;
    const Size from = std::max(first, stretches[number].first), to = std::min(last, end);
    if (from < to) function(stretches[number], from, to);
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

// The numbers of bits in which a column of a frame differs from that of another.
Size differing(const Word *one, const Word *other, Size words) {
  std::int32_t bits;
  count_moves(one, other, 1, {1, 1, words, 0, 0}, &bits);
  return bits;
}
}  // namespace

// ------------------------------------------------------------------------------------------- vectors

LiveVectors::LiveVectors(Size length)
    : length_(length),
      width_((length + LANES - 1) / LANES * LANES),
      rows_(width_),
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
  if (first_ == rows()) return;
  finished_.push_back({first_, mean(nullptr)});
  for (Size i = 0; i < length_; ++i) before_[place(i)] += total_[place(i)];
  std::fill(total_.begin(), total_.end(), 0.0);
  counted_before_ += counted_;
  counted_ = 0;
  first_ = rows();
}

// The mean of the present stretch, with another frame if there is one.
std::vector<float> LiveVectors::mean(const float *next) const {
  Size counted = counted_ + (next && !empty(next)) + (counted_before_ ? MODEL.before : 0);
  counted = std::max<Size>(1, counted);
  const double share =
      counted_before_ ? static_cast<double>(MODEL.before) / static_cast<double>(counted_before_) : 0;
  std::vector<float> mean(place(width_));
  for (Size i = 0; i < length_; ++i) {
    const double own = total_[place(i)] + (next ? static_cast<double>(next[i]) : 0);
    mean[place(i)] =
        static_cast<float>((own + before_[place(i)] * share) / static_cast<double>(counted));
  }
  return mean;
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
  const auto *given = static_cast<const float *>(swept);
  auto stretches = finished_;
  stretches.push_back({first_, mean(given + anchors / 2 * length_)});
  const std::vector<float> all = centred(given, anchors, stretches.back().mean.data());
  over_blocks(rows(), GrowingRows<float>::ROWS, rows() < MANY ? 1 : threads, [&](Size first, Size last) {
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
    by_stretch(stretches, first, last, [&](const Stretch &stretch, Size from, Size to) {
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

StoredSigns::StoredSigns(Size columns, Size size)
    : columns_(columns),
      size_(size),
      grid_{columns, 1, (size + 7) / 8, REACH, 0},
      rows_(grid_.size()),
      nothing_(place(grid_.size())) {}

bool StoredSigns::empty(const void *descriptor) const {
  const auto *bytes = static_cast<const std::uint8_t *>(descriptor);
  return std::all_of(bytes, bytes + columns_ * size_, [](std::uint8_t byte) { return byte == 0; });
}

std::vector<Word> StoredSigns::packed(const void *descriptor) const {
  const auto *bytes = static_cast<const std::uint8_t *>(descriptor);
  std::vector<Word> frame(nothing_);
  for (Size column = 0; column < columns_; ++column)
    std::memcpy(frame.data() + column * grid_.words, bytes + column * size_, place(size_));
  return frame;
}

double StoredSigns::bits(int move) const {
  return static_cast<double>(8 * size_ * std::max<Size>(0, columns_ - std::abs(move)));
}

Size StoredSigns::together(Size column) const {
  return column == REACH ? std::max<Size>(1, columns_ - 2 * REACH) : 1;
}

void StoredSigns::add(const Word *frame, Sum &sum) const {
  ++sum.frames;
  std::vector<Word> carry(frame, frame + grid_.size());
  for (std::size_t plane = 0; sum.frames >> plane; ++plane) {
    if (plane == sum.planes.size()) sum.planes.push_back(nothing_);
    for (std::size_t word = 0; word < carry.size(); ++word) {
      const Word both = carry[word] & sum.planes[plane][word];
      sum.planes[plane][word] ^= carry[word];
      carry[word] = both;
    }
  }
}

void StoredSigns::store(const Word *frame) {
  std::copy_n(frame, grid_.size(), rows_.append());
  add(frame, own_);
  add(frame, every_);
}

void StoredSigns::copy(Size first, Size last, void *descriptors) const {
  auto *out = static_cast<std::uint8_t *>(descriptors);
  for (Size row = first; row < last; ++row)
    for (Size column = 0; column < columns_; ++column, out += size_)
      std::memcpy(out, rows_[row] + column * grid_.words, place(size_));
}

double StoredSigns::cosine(const void *one, const void *other) const {
  return 1 - 2 * static_cast<double>(differing(packed(one).data(), packed(other).data(), grid_.size())) /
                 bits(0);
}

LiveSigns::Products LiveSigns::with(const Word *frame, const Sum &sum) const {
  Products products;
  const auto add_products = [&](const Word *signs, double factor) {
    std::array<std::int32_t, MOVES> different;
    count_moves(signs, frame, 1, grid_, different.data());
    for (int move = -REACH; move <= REACH; ++move)
      products.moved[place(move + REACH)] += factor * (bits(move) - 2.0 * different[place(move + REACH)]);
    for (Size column = 0, count; column < columns_; column += count) {
      const Size at = column * grid_.words;
      count = together(column);
      const auto product = static_cast<double>(
          8 * size_ * count - 2 * differing(signs + at, frame + at, grid_.words * count));
      for (int move = -REACH; move <= REACH; ++move)
        if (leaves(move, column)) products.there[place(move + REACH)] += factor * product;
    }
  };
  // A count of frames is the sum of half the numbers 1 and -1 of each plane, and half of all its values.
  double value = 1;
  for (const auto &plane : sum.planes) add_products(plane.data(), value), value *= 2;
  add_products(nothing_.data(), static_cast<double>(sum.frames) + 1 - value);
  return products;
}

LiveSigns::Stretch LiveSigns::present(Size fresh) const {
  const double before = static_cast<double>(first_), own = static_cast<double>(rows() - first_ + fresh);
  if (!first_) return {first_, 0, own};
  return {first_, static_cast<double>(MODEL.before) / before, own + static_cast<double>(MODEL.before)};
}

LiveSigns::Products LiveSigns::with_sum(const Products &own, const Products &every) const {
  Products sum;
  const double share = present(0).share;
  for (std::size_t move = 0; move < MOVES; ++move) {
    sum.moved[move] = own.moved[move] + share * (every.moved[move] - own.moved[move]);
    sum.there[move] = own.there[move] + share * (every.there[move] - own.there[move]);
  }
  return sum;
}

double LiveSigns::square_of_sum(std::size_t move) const {
  const double share = present(0).share;
  return own_square_[move] + 2 * share * own_with_before_[move] + share * share * before_square_[move];
}

void LiveSigns::store_with(const Word *frame, const Products &own, const Products &every) {
  for (int move = -REACH; move <= REACH; ++move) {
    const std::size_t at = place(move + REACH);
    own_square_[at] += 2 * own.there[at] + bits(move);
    own_with_before_[at] += every.there[at] - own.there[at];
  }
  store(frame);
  compared_ = false;
}

void LiveSigns::extend(const void *descriptor) {
  const std::vector<Word> frame = packed(descriptor);
  store_with(frame.data(), with(frame.data(), own_), with(frame.data(), every_));
  for (auto *each : {&with_every_, &with_present_, &there_or_length_})
    for (auto &of_rows : *each) of_rows.push_back(0);
  counted_ = false;
}

void LiveSigns::append(const void *descriptor) {
  const std::vector<Word> frame = packed(descriptor);
  if (!compared_) compare(frame.data(), 1);
  const Products sum = with_sum(last_own_, last_every_);
  for (int move = -REACH; move <= REACH; ++move) {
    const std::size_t at = place(move + REACH);
    for (std::size_t row = 0; row < moved_[at].size(); ++row) {
      with_every_[at][row] += moved_[at][row];
      with_present_[at][row] += moved_[at][row];
    }
    for (std::size_t row = 0; row < there_[at].size(); ++row)
      there_or_length_[at][place(first_) + row] += there_[at][row];
    with_every_[at].push_back(last_every_.moved[at] + last_self_[at]);
    with_present_[at].push_back(sum.moved[at] + last_self_[at]);
    there_or_length_[at].push_back(sum.there[at] + bits(move));
  }
  store_with(frame.data(), last_own_, last_every_);
}

void LiveSigns::recount() {
  if (counted_) return;
  for (Size row = 0; row < rows(); ++row) {
    const Products every = with(rows_[row], every_), sum = with_sum(with(rows_[row], own_), every);
    for (std::size_t move = 0; move < MOVES; ++move) {
      with_every_[move][place(row)] = every.moved[move];
      with_present_[move][place(row)] = sum.moved[move];
      if (row >= first_) there_or_length_[move][place(row)] = sum.there[move];
    }
  }
  counted_ = true;
}

void LiveSigns::start_stretch() {
  if (first_ == rows()) return;
  if (!counted_)
    for (Size row = first_; row < rows(); ++row) {
      const Products sum = with_sum(with(rows_[row], own_), with(rows_[row], every_));
      for (std::size_t move = 0; move < MOVES; ++move)
        there_or_length_[move][place(row)] = sum.there[move];
    }
  finished_.push_back(present(0));
  for (int move = -REACH; move <= REACH; ++move) {
    const std::size_t at = place(move + REACH);
    const double frames = finished_.back().frames;
    const double square = bits(move) + square_of_sum(at) / (frames * frames);
    for (Size row = first_; row < rows(); ++row) {
      double &there = there_or_length_[at][place(row)];
      there = std::sqrt(std::max(0.0, square - 2 * there / frames));
    }
    before_square_[at] += 2 * own_with_before_[at] + own_square_[at];
    own_square_[at] = own_with_before_[at] = 0;
  }
  own_ = {};
  first_ = rows();
  for (std::size_t move = 0; move < MOVES; ++move)
    for (std::size_t row = 0; row < with_every_[move].size(); ++row)
      with_present_[move][row] = present(0).share * with_every_[move][row];
  compared_ = false;
}

void LiveSigns::compare(const Word *frame, int threads) {
  recount();
  last_own_ = with(frame, own_);
  last_every_ = with(frame, every_);
  std::array<std::int32_t, MOVES> own;
  count_moves(frame, frame, 1, grid_, own.data());
  for (int move = -REACH; move <= REACH; ++move) {
    const std::size_t at = place(move + REACH);
    last_self_[at] = bits(move) - 2.0 * own[at];
    moved_[at].resize(place(rows()));
    there_[at].assign(place(rows() - first_), 0);
  }
  over_blocks(rows(), GrowingRows<Word>::ROWS, rows() < MANY ? 1 : threads, [&](Size first, Size last) {
    const Size count = last - first;
    std::vector<std::int32_t> different(place(MOVES * count));
    count_moves(frame, rows_[first], count, grid_, different.data());
    for (int move = -REACH; move <= REACH; ++move)
      for (Size row = 0; row < count; ++row)
        moved_[place(move + REACH)][place(first + row)] =
            static_cast<std::int32_t>(bits(move)) - 2 * different[place((move + REACH) * count + row)];
    for (Size row = std::max(first, first_); row < last; ++row)
      for (Size column = 0, count; column < columns_; column += count) {
        const Size at = column * grid_.words;
        count = together(column);
        const Size product =
            8 * size_ * count - 2 * differing(frame + at, rows_[row] + at, grid_.words * count);
        for (int move = -REACH; move <= REACH; ++move)
          if (leaves(move, column))
            there_[place(move + REACH)][place(row - first_)] += static_cast<std::int32_t>(product);
      }
  });
  compared_ = true;
}

// Takes a move of the frame that was compared last into the scores of all rows.
void LiveSigns::score(int move, std::vector<double> &centred, float *scores) const {
  const std::size_t at = place(move + REACH), back = place(REACH - move);
  const Stretch now = present(1);
  const Products sum = with_sum(last_own_, last_every_);
  const auto square = [&](std::size_t of) {  // of the mean with the frame
    const double all = square_of_sum(of) + 2 * sum.there[of] + bits(move);
    return all / (now.frames * now.frames);
  };
  const double query = std::sqrt(
      std::max(0.0, bits(move) - 2 * (sum.there[back] + bits(move)) / now.frames + square(back)));
  const double self = last_self_[at] - (sum.moved[at] + last_self_[at]) / now.frames;
  auto stretches = finished_;
  stretches.push_back(now);
  double before = 0;  // sum of the rows of earlier stretches
  by_stretch(stretches, 0, rows(), [&](const Stretch &stretch, Size from, Size to) {
    const bool is_now = from >= first_;
    double own = is_now ? self : 0;
    for (Size row = from; row < to; ++row) {
      const double product = moved_[at][place(row)];
      centred[place(row)] = product - (with_present_[at][place(row)] + product) / now.frames;
      own += centred[place(row)];
    }
    const double of_mean = (own + stretch.share * before) / stretch.frames;
    const double most = bits(move) + square(at);
    for (Size row = from; row < to; ++row) {
      double length = there_or_length_[at][place(row)];
      if (is_now) {
        const double there = length + there_[at][place(row - first_)];
        length = std::sqrt(std::max(0.0, most - 2 * there / now.frames));
      }
      const double score = (centred[place(row)] - of_mean) / std::max(query * length, LEAST);
      scores[row] = std::max(scores[row], static_cast<float>(std::min(score, 1.0)));
    }
    before += own;
  });
}

std::unique_ptr<LiveChannel> LiveSigns::large() const {
  auto large = std::make_unique<LargeSigns>(columns_, size_, cell_);
  std::vector<std::uint8_t> descriptor(place(bytes()));
  auto stretches = finished_;
  stretches.push_back(present(0));
  by_stretch(stretches, 0, rows(), [&](const Stretch &, Size from, Size to) {
    large->start_stretch();
    for (Size row = from; row < to; ++row) {
      copy(row, row + 1, descriptor.data());
      large->extend(descriptor.data());
    }
  });
  if (first_ == rows()) large->start_stretch();
  return large;
}

void LiveSigns::scores(const void *swept, Size, int threads, const Chosen &, float *scores) {
  compare(packed(swept).data(), threads);
  std::fill(scores, scores + rows(), NONE);
  std::vector<double> centred(place(rows()));
  for (int move = -REACH; move <= REACH; ++move) score(move, centred, scores);
}

// ------------------------------------------------------------------------------- signs of a large memory

LargeSigns::LargeSigns(Size columns, Size size, Size cell)
    : StoredSigns(columns, size),
      cell_(cell),
      stride_(std::max<Size>(1, cell / PART)),
      part_(columns, size / cell * ((cell + stride_ - 1) / stride_), PART) {}

// Some bytes of each cell, evenly spaced.
std::vector<std::uint8_t> LargeSigns::part(const void *descriptor) const {
  const auto *bytes = static_cast<const std::uint8_t *>(descriptor);
  std::vector<std::uint8_t> signs;
  for (Size cell = 0; cell < columns_ * size_; cell += cell_)
    for (Size at = 0; at < cell_; at += stride_) signs.push_back(bytes[cell + at]);
  return signs;
}

void LargeSigns::append(const void *descriptor) {
  store(packed(descriptor).data());
  part_.append(part(descriptor).data());
}

void LargeSigns::extend(const void *descriptor) {
  store(packed(descriptor).data());
  part_.extend(part(descriptor).data());
}

void LargeSigns::start_stretch() {
  if (first_ == rows()) return;
  finished_.push_back(mean(own_, every_));
  own_ = {};
  first_ = rows();
  part_.start_stretch();
}

LargeSigns::Mean LargeSigns::mean(const Sum &own, const Sum &every) const {
  const Size before = every.frames - own.frames;
  const double frames = static_cast<double>(own.frames + (before ? MODEL.before : 0));
  Mean mean{first_, {std::vector<Word>(place(PLANES * grid_.size())), {}},
            std::vector<double>(place(columns_))};
  for (int plane = 0; plane < PLANES; ++plane)
    mean.planes.weights.push_back(static_cast<double>(1 << plane) / LEVELS);
  constexpr Size BITS = 64;
  for (Size word = 0; word < grid_.size(); ++word) {
    std::array<std::int32_t, BITS> own_ones{}, ones{}, levels;
    const auto add_ones = [&](const Sum &sum, std::array<std::int32_t, BITS> &counts) {
      for (std::size_t plane = 0; plane < sum.planes.size(); ++plane)
        for (std::size_t bit = 0; bit < BITS; ++bit)
          counts[bit] += static_cast<std::int32_t>(sum.planes[plane][place(word)] >> bit & 1) << plane;
    };
    add_ones(own, own_ones);
    add_ones(every, ones);
    const Size used = std::min(BITS, 8 * size_ - word % grid_.words * BITS);
    for (std::size_t bit = 0; bit < static_cast<std::size_t>(used); ++bit) {
      const double here = 2.0 * own_ones[bit] - static_cast<double>(own.frames);
      const double there = 2.0 * (ones[bit] - own_ones[bit]) - static_cast<double>(before);
      const double sum = before ? here + MODEL.before * there / static_cast<double>(before) : here;
      levels[bit] = static_cast<std::int32_t>(sum / frames * (LEVELS / 2.0) + (LEVELS + 1) / 2.0);
    }
    for (std::size_t bit = 0; bit < static_cast<std::size_t>(used); ++bit) {
      for (int plane = 0; plane < PLANES; ++plane)
        mean.planes.signs[place(plane * grid_.size() + word)] |=
            static_cast<Word>(levels[bit] >> plane & 1) << bit;
      const double value = 2.0 * levels[bit] / LEVELS - 1;
      mean.squares[place(word / grid_.words)] += value * value;
    }
  }
  return mean;
}

LargeSigns::ByMove LargeSigns::product(const Planes &vector, const Word *frame) const {
  ByMove products{};
  for (std::size_t plane = 0; plane < vector.weights.size(); ++plane) {
    std::array<std::int32_t, MOVES> different;
    count_moves(vector.signs.data() + static_cast<Size>(plane) * grid_.size(), frame, 1, grid_,
                different.data());
    for (int move = -REACH; move <= REACH; ++move)
      products[place(move + REACH)] +=
          vector.weights[plane] * (bits(move) - 2.0 * different[place(move + REACH)]);
  }
  return products;
}

LargeSigns::ByMove LargeSigns::lengths(const Word *frame, const Mean &mean, bool is_moved) const {
  ByMove squares{};
  for (Size column = 0, count; column < columns_; column += count) {
    count = together(column);
    const Size at = column * grid_.words, words = count * grid_.words;
    double square = static_cast<double>(8 * size_ * count);
    for (Size next = 0; next < count; ++next) square += mean.squares[place(column + next)];
    for (std::size_t plane = 0; plane < PLANES; ++plane) {
      const Word *signs = mean.planes.signs.data() + static_cast<Size>(plane) * grid_.size() + at;
      square -= 2 * mean.planes.weights[plane] *
                static_cast<double>(8 * size_ * count - 2 * differing(signs, frame + at, words));
    }
    for (int move = -REACH; move <= REACH; ++move)
      if (leaves(is_moved ? -move : move, column)) squares[place(move + REACH)] += square;
  }
  for (double &square : squares) square = std::sqrt(std::max(0.0, square));
  return squares;
}

void LargeSigns::scores(const void *swept, Size anchors, int threads, const Chosen &chosen,
                        float *scores) {
  if (chosen.empty()) return part_.scores(part(swept).data(), anchors, threads, chosen, scores);
  const std::vector<Word> frame = packed(swept);
  Sum own = own_, every = every_;
  add(frame.data(), own);
  add(frame.data(), every);
  finished_.push_back(mean(own, every));  // that of the present stretch, for now
  const auto &stretches = finished_;
  const Mean &now = stretches.back();
  const ByMove moved = lengths(frame.data(), now, true);
  Planes query{frame, {1}};  // less its mean
  query.signs.insert(query.signs.end(), now.planes.signs.begin(), now.planes.signs.end());
  for (const double weight : now.planes.weights) query.weights.push_back(-weight);
  std::vector<ByMove> of_means(stretches.size());
  for (std::size_t number = 0; number < stretches.size(); ++number)
    for (std::size_t plane = 0; plane < PLANES; ++plane) {
      const Planes &planes = stretches[number].planes;
      const ByMove products =
          product(query, planes.signs.data() + static_cast<Size>(plane) * grid_.size());
      for (std::size_t move = 0; move < MOVES; ++move)
        of_means[number][move] += planes.weights[plane] * products[move];
    }
  over_blocks(rows(), GrowingRows<Word>::ROWS, rows() < MANY ? 1 : threads, [&](Size first, Size last) {
    std::fill(scores + first, scores + last, NONE);
    by_stretch(stretches, first, last, [&](const Mean &mean, Size from, Size to) {
      const ByMove &of_mean = of_means[static_cast<std::size_t>(&mean - stretches.data())];
      by_choice(chosen, rows_, grid_.size(), from, to, [&](Size start, Size end) {
        for (Size row = start; row < end; ++row) {
          const ByMove products = product(query, rows_[row]), own_lengths = lengths(rows_[row], mean, false);
          for (std::size_t move = 0; move < MOVES; ++move) {
            const double score =
                (products[move] - of_mean[move]) / std::max(moved[move] * own_lengths[move], LEAST);
            scores[row] = std::max(scores[row], static_cast<float>(std::min(score, 1.0)));
          }
        }
      });
    });
  });
  finished_.pop_back();
}

}  // namespace places
