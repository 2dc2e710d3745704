// The descriptors of a live stream by one channel, and the scores of a new frame against them.
//
// Each frame is compared without the mean of its stretch. The mean of the present stretch is that of its
// frames so far, with `before` frames of the mean of all before. tests/oracles/loops.py says the same plainly.

#ifndef SSRVLAD_LIVE_HPP
#define SSRVLAD_LIVE_HPP

#include <memory>
#include <vector>

#include "scores.hpp"
#include "signs.hpp"

namespace places {

// Rows of numbers in blocks that never move, so that growing copies nothing.
template <class Number>
class GrowingRows {
 public:
  static constexpr Size ROWS = 1024;

  explicit GrowingRows(Size width) : width_(width) {}

  Size rows() const { return rows_; }
  Number *operator[](Size row) { return blocks_[place(row / ROWS)].get() + row % ROWS * width_; }
  const Number *operator[](Size row) const {
    return blocks_[place(row / ROWS)].get() + row % ROWS * width_;
  }

  Number *append() {
    reserve(rows_ + 1);
    return (*this)[rows_++];
  }

  void reserve(Size rows) {
    while (static_cast<Size>(blocks_.size()) * ROWS < rows)
      blocks_.emplace_back(new Number[place(ROWS * width_)]);
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
  // Memory for so many frames.
  virtual void reserve(Size frames) = 0;
  // The next frame starts a stretch.
  virtual void start_stretch() = 0;
  virtual void append(const void *descriptor) = 0;
  // Fills a score for each row before the last one: of that frame, by its descriptors from some anchors,
  // the usual one in the middle; NONE where the row is empty, and where it is not chosen.
  virtual void scores(const void *swept, Size anchors, int threads, const Chosen &chosen, float *scores) = 0;
  // Whether there is a small part of each descriptor; by it, fills scores of the last frame for all rows.
  virtual bool has_part() const { return false; }
  virtual void rough_scores(int, float *) {}
  // After many frames that were appended: makes the next scores, of rows that are chosen, as quick as others.
  virtual void settle(const Chosen &) {}
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
  void reserve(Size frames) override;
  void start_stretch() override;
  void append(const void *descriptor) override;
  void scores(const void *swept, Size anchors, int threads, const Chosen &chosen, float *scores) override;
  void copy(Size first, Size last, void *descriptors) const override;
  double cosine(const void *one, const void *other) const override;

 private:
  struct Stretch {
    Size first;
    std::vector<float> mean;
  };

  void compute_mean();  // of the present stretch
  std::vector<float> centred(const float *swept, Size anchors, const float *mean) const;

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
  CountedSigns(const SignGrid &grid, Size bytes, int digits);  // bytes of a cell

  Size rows() const { return signs_.rows(); }
  void reserve(Size frames);
  // Gives rows after many frames what they would have if each had been compared; else they have it anew when
  // they are compared.
  void settle(const Chosen &chosen);
  // Rows of the stretch that ended are measured now, or when they are compared.
  void start_stretch(bool measured);
  void append(const std::uint8_t *signs);
  void scores(int threads, const Chosen &chosen, float *scores);
  void copy(Size first, Size last, std::uint8_t *signs) const;
  double cosine(const std::uint8_t *one, const std::uint8_t *other) const;

 private:
  using Floats = std::vector<float>;

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

  std::vector<Word> packed(const std::uint8_t *signs) const;
  Floats unpacked(const Word *signs) const;
  bool is_present(Size row) const { return row >= stretches_.back().first; }
  float share() const;    // by which the frames before the present stretch count in its mean
  double frames() const;  // that this mean is of
  Floats mean() const;
  Floats mean_before() const;
  std::vector<double> squares(const Floats &numbers, const Floats &less) const;  // of the cells
  Floats products_of(const Floats &moved, const Floats &numbers) const;          // by move
  void to_lengths(const Floats &of_mean, double frames, float *products) const;
  void measure(Size row, const Stretch &stretch);
  bool is_behind(Size row) const;
  void renew(Size first, Size last, const SignMean &mean);
  void take(Size frame, Size row);

  SignGrid grid_;
  Size bytes_, moves_;
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

// Signs of cells, `columns` columns of `size` bytes each.
class LiveSigns : public LiveChannel {
 public:
  LiveSigns(Size columns, Size size, Size cell);  // bytes of a column, and of a cell

  Size bytes() const override { return columns_ * size_; }
  Size rows() const override { return signs_.rows(); }
  bool empty(const void *descriptor) const override;
  bool fits(const void *, Size anchors) const override { return anchors == 1; }
  void reserve(Size frames) override;
  void start_stretch() override {
    signs_.start_stretch(false);
    part_.start_stretch(true);
  }
  void append(const void *descriptor) override;
  void scores(const void *, Size, int threads, const Chosen &chosen, float *scores) override {
    signs_.scores(threads, chosen, scores);
  }
  bool has_part() const override { return true; }
  void settle(const Chosen &chosen) override {
    signs_.settle(chosen);
    part_.settle({});
  }
  void rough_scores(int threads, float *scores) override { part_.scores(threads, {}, scores); }
  void copy(Size first, Size last, void *descriptors) const override;
  double cosine(const void *one, const void *other) const override;

 private:
  Size part_bytes() const { return size_ / cell_ * ((cell_ + stride_ - 1) / stride_); }

  Size columns_, size_, cell_, stride_;  // bytes; from one to the next of those of the part
  CountedSigns signs_, part_;
};

}  // namespace places

#endif
