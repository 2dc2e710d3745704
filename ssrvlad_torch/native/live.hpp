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

// Signs of frames in columns, as numbers 1 and -1, and the scores of the last one.
//
// A mean is a sum of frames, so the products with it of a row are sums of whole numbers. They grow with each
// frame that the row is compared with; a row that was not is brought up to date by the frames that it missed,
// or, where these are many, by the sum.
//
// Products are by move, and there are two kinds, one after the other: those of one frame with another that is
// moved, and those of both where they are, over the same columns of the one.
class CountedSigns {
 public:
  CountedSigns(Size columns, Size bytes);  // bytes of a column

  Size rows() const { return frames_.signs.rows(); }
  void reserve(Size frames);
  void start_stretch();
  void append(const std::uint8_t *signs);
  void scores(int threads, const Chosen &chosen, float *scores);
  void copy(Size first, Size last, std::uint8_t *signs) const;
  double cosine(const std::uint8_t *one, const std::uint8_t *other) const;

 private:
  using Words = std::vector<Word>;
  using Products = std::vector<double>;

  // A sum of frames: how many have each sign, as binary digits.
  struct Sum {
    std::vector<Words> digits;
    Size frames = 0;
  };

  // Signs with their products: with the sum of the first frames, and with that of the frames before a stretch.
  struct Mark {
    Size frames = 0, stretch = -1;
    bool is_measured = false;  // has, in place of the products in place, the lengths without its mean
  };
  struct Store {
    Size size, width;
    GrowingRows<Word> signs{size};
    GrowingRows<double> products{width};
    GrowingRows<Mark> marks{1};

    Store(Size words, Size numbers) : size(words), width(numbers) {}
    void append(const Word *words);
  };

  struct Stretch {
    Size first;
    Products squares;  // of the mean in place, once it has ended
  };

  // The present mean: the sum of all frames, and `less` than that of those before the stretch, by a number.
  struct Mean {
    double frames, less;
    double of(const double *all, const double *before, Size product) const {
      return (all[product] + less * before[product]) / frames;
    }
  };

  Words packed(const std::uint8_t *signs) const;
  Size mirrored(Size product) const { return product < moves_ ? moves_ - 1 - product : product; }
  void add_product(const Word *moved, const Word *signs, double factor, double *sums, Size size) const;
  void add_sum(const Sum &sum, const Word *signs, double *sums, Size size) const;
  void add(const Word *frame, Sum &sum) const;
  Size present() const { return static_cast<Size>(stretches_.size()) - 1; }
  Mean mean() const;
  Products squares(const Mean &mean) const;
  void to_lengths(const Stretch &stretch, const Mean &mean, double *products) const;
  void bring(Store &store, Size row, Size to, const Sum &sum, Size size) const;
  void compare(Store &store, Size first, Size last, Size size, std::int32_t *differing, double *products) const;
  void measure(Size row, Size number);
  void append_mean(const Mean &mean);

  Size columns_, bytes_;
  SignGrid grid_;
  Size moves_;
  Products bits_;  // that the products are over
  Words nothing_;           // no bit
  Store frames_, planes_;           // the means of stretches that ended are weighted sums of DIGITS planes
  std::vector<Stretch> stretches_;  // the last is the present one
  Sum all_, before_;                // of all frames, and of those before the present stretch
  Products of_all_, of_all_before_, of_before_all_, of_before_;  // the first sum, moved, with the second
  Products with_all_, with_before_;                              // sums, moved, with the last frame
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
  void start_stretch() override;
  void append(const void *descriptor) override;
  void scores(const void *, Size, int threads, const Chosen &chosen, float *scores) override {
    signs_.scores(threads, chosen, scores);
  }
  bool has_part() const override { return true; }
  void rough_scores(int threads, float *scores) override { part_.scores(threads, {}, scores); }
  void copy(Size first, Size last, void *descriptors) const override;
  double cosine(const void *one, const void *other) const override;

 private:
  Size columns_, size_, cell_, stride_;  // bytes; from one to the next of those of the part
  CountedSigns signs_, part_;
};

}  // namespace places

#endif
