// The descriptors of a live stream by one channel, and the scores of a new frame against them.
//
// Each frame is compared without the mean of its stretch. The mean of the present stretch is that of its
// frames so far, with `before` frames of the mean of all before. tests/oracles/loops.py says the same plainly.

#ifndef SSRVLAD_LIVE_HPP
#define SSRVLAD_LIVE_HPP

#include <array>
#include <memory>
#include <vector>

#include "scores.hpp"
#include "signs.hpp"

namespace places {

constexpr int REACH = 2;     // columns of cells by which signs are moved to each side

// Rows of numbers in blocks that never move, so that growing copies nothing.
template <class Number>
class GrowingRows {
 public:
  static constexpr Size ROWS = 1024;

  explicit GrowingRows(Size width) : width_(width) {}

  Size rows() const { return rows_; }
  const Number *operator[](Size row) const {
    return blocks_[place(row / ROWS)].get() + row % ROWS * width_;
  }

  Number *append() {
    if (rows_ % ROWS == 0) blocks_.emplace_back(new Number[place(ROWS * width_)]);
    const Size row = rows_++;
    return blocks_.back().get() + row % ROWS * width_;
  }

 private:
  static std::size_t place(Size at) { return static_cast<std::size_t>(at); }

  Size width_, rows_ = 0;
  std::vector<std::unique_ptr<Number[]>> blocks_;
};

// Whether each row is chosen; empty if all are.
using Chosen = std::vector<std::uint8_t>;

class LiveChannel {
 public:
  virtual ~LiveChannel() = default;

  virtual Size bytes() const = 0;  // of a descriptor
  virtual Size rows() const = 0;
  virtual bool empty(const void *descriptor) const = 0;
  // Whether descriptors from some anchors can be those of a frame.
  virtual bool fits(const void *swept, Size anchors) const = 0;
  // Fills a score for each row: of a new frame by its descriptors from some anchors, the usual one in
  // the middle; NONE where the row is empty, and where it is not chosen.
  virtual void scores(const void *swept, Size anchors, int threads, const Chosen &chosen,
                      float *scores) = 0;
  // The same frames in a form for large memories, whose scores are rough where all rows are chosen;
  // nothing if there is no such form.
  virtual std::unique_ptr<LiveChannel> large() const { return nullptr; }
  // Appends the frame that was scored last, or one that was not, by its descriptor.
  virtual void append(const void *descriptor) = 0;
  // Appends a frame that is known; frames that come later make up for what `scores` would have counted.
  virtual void extend(const void *descriptor) = 0;
  // The next frame starts a stretch.
  virtual void start_stretch() = 0;
  virtual void copy(Size first, Size last, void *descriptors) const = 0;
  // The cosine of two descriptors, with their means.
  virtual double cosine(const void *one, const void *other) const = 0;
};

// Vectors of length 1, or zero for an empty frame.
class LiveVectors : public LiveChannel {
 public:
  explicit LiveVectors(Size length);

  Size bytes() const override { return length_ * static_cast<Size>(sizeof(float)); }
  Size rows() const override { return rows_.rows(); }
  bool empty(const void *descriptor) const override;
  bool fits(const void *swept, Size anchors) const override;
  void scores(const void *swept, Size anchors, int threads, const Chosen &chosen, float *scores) override;
  void append(const void *descriptor) override;
  void extend(const void *descriptor) override { append(descriptor); }
  void start_stretch() override;
  void copy(Size first, Size last, void *descriptors) const override;
  double cosine(const void *one, const void *other) const override;

 private:
  struct Stretch {
    Size first;
    std::vector<float> mean;
  };

  std::vector<float> mean(const float *next) const;
  std::vector<float> centred(const float *swept, Size anchors, const float *mean) const;

  Size length_, width_;  // numbers of a vector, and with zeros that fill the lanes of a processor
  GrowingRows<float> rows_;
  std::vector<bool> empty_;
  std::vector<Stretch> finished_;
  Size first_ = 0;  // of the present stretch
  std::vector<double> total_, before_;
  Size counted_ = 0, counted_before_ = 0;
};

// Signs of cells, `columns` columns of `size` bytes each, as numbers 1 and -1.
class StoredSigns : public LiveChannel {
 public:
  StoredSigns(Size columns, Size size);

  Size bytes() const override { return columns_ * size_; }
  Size rows() const override { return rows_.rows(); }
  bool empty(const void *descriptor) const override;
  bool fits(const void *, Size anchors) const override { return anchors == 1; }
  void copy(Size first, Size last, void *descriptors) const override;
  double cosine(const void *one, const void *other) const override;

 protected:
  static constexpr int MOVES = 2 * REACH + 1;

  // A sum of frames: how many have each sign, as binary numbers. Plane p holds the bits of value 2 ** p.
  struct Sum {
    std::vector<std::vector<Word>> planes;
    Size frames = 0;
  };

  std::vector<Word> packed(const void *descriptor) const;
  double bits(int move) const;  // of the columns that are left after a move
  // How many columns from one on each move leaves or does not leave together, and whether one does.
  Size together(Size column) const;
  bool leaves(int move, Size column) const { return column - move >= 0 && column - move < columns_; }
  void add(const Word *frame, Sum &sum) const;
  void store(const Word *frame);

  Size columns_, size_;
  SignGrid grid_;
  GrowingRows<Word> rows_;
  std::vector<Word> nothing_;  // no bit
  Size first_ = 0;             // of the present stretch
  Sum own_, every_;            // of the present stretch, and of all frames
};

// A mean is a sum of frames, so products with it are sums of whole numbers: those of a row with the
// frames so far grow by its product with each new frame, and no mean is ever written out. Two products
// of two frames count, over the columns that are left after each move: `moved`, of one with the other
// moved to the right, and `there`, of both where they are.
class LiveSigns : public StoredSigns {
 public:
  LiveSigns(Size columns, Size size, Size cell) : StoredSigns(columns, size), cell_(cell) {}

  void scores(const void *swept, Size, int threads, const Chosen &, float *scores) override;
  std::unique_ptr<LiveChannel> large() const override;
  void append(const void *descriptor) override;
  void extend(const void *descriptor) override;
  void start_stretch() override;

 private:
  template <class Number>
  using ByMove = std::array<std::vector<Number>, MOVES>;

  // Products of a frame with a sum of frames, by move.
  struct Products {
    std::array<double, MOVES> moved{}, there{};
  };

  // The mean of a stretch is the sum of its frames, and a share of the sum of all before, by a number.
  struct Stretch {
    Size first;
    double share, frames;
  };

  Products with(const Word *frame, const Sum &sum) const;
  Stretch present(Size fresh) const;  // the present stretch with some more frames
  Products with_sum(const Products &own, const Products &every) const;  // with that of the present mean
  double square_of_sum(std::size_t move) const;
  void store_with(const Word *frame, const Products &own, const Products &every);
  void compare(const Word *frame, int threads);  // fills what is of the last frame
  void recount();
  void score(int move, std::vector<double> &centred, float *scores) const;

  Size cell_;  // bytes of a cell
  std::vector<Stretch> finished_;
  std::array<double, MOVES> own_square_{}, own_with_before_{},
      before_square_{};  // of their sums, by move
  // Of each row by move: products `moved` with the sum of all frames, and with that of the present mean;
  // with that also `there`, of rows of the present stretch, and of others the length without their mean.
  ByMove<double> with_every_, with_present_, there_or_length_;
  bool counted_ = true, compared_ = false;
  // Of the frame that was compared last: products with each row, there with those of the present
  // stretch.
  ByMove<std::int32_t> moved_, there_;
  Products last_own_, last_every_;
  std::array<double, MOVES> last_self_{};
};

// Signs of a memory too large to compare each frame with all of them: with all rows a part of each cell
// is compared, as LiveSigns, and all of it with chosen rows. For these the numbers of a mean are rounded to
// LEVELS + 1 levels, so that it is a sum of few signs.
class LargeSigns : public StoredSigns {
 public:
  LargeSigns(Size columns, Size size, Size cell);

  void scores(const void *swept, Size, int threads, const Chosen &chosen, float *scores) override;
  void append(const void *descriptor) override;
  void extend(const void *descriptor) override;
  void start_stretch() override;

 private:
  static constexpr int PLANES = 4, LEVELS = (1 << PLANES) - 1;
  using ByMove = std::array<double, MOVES>;

  // Signs one after another, of which the weighted sum is a vector: a mean, or a frame less its mean.
  struct Planes {
    std::vector<Word> signs;
    std::vector<double> weights;
  };

  // The mean of a stretch, and the squares of its columns.
  struct Mean {
    Size first;
    Planes planes;
    std::vector<double> squares;
  };

  std::vector<std::uint8_t> part(const void *descriptor) const;
  Mean mean(const Sum &own, const Sum &every) const;
  ByMove product(const Planes &vector, const Word *frame) const;  // of it with the frame, moved
  // By move, the length of what is left of a frame less a mean; the frame is moved, or the other one is.
  ByMove lengths(const Word *frame, const Mean &mean, bool is_moved) const;

  Size cell_, stride_;  // bytes of a cell, and from one to the next of those that are compared with all
  LiveSigns part_;
  std::vector<Mean> finished_;
};

}  // namespace places

#endif
