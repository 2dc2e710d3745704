// The queries of one drive against all rows of a map: by a channel, and by several channels as one.
//
// recognition/reference.py says the same plainly. A drive loses the mean of its descriptors; a query is
// described from several anchors, or moved to both sides, and its best score counts.

#ifndef SSRVLAD_COMPARE_HPP
#define SSRVLAD_COMPARE_HPP

#include <memory>
#include <vector>

#include "filter.hpp"
#include "scores.hpp"

namespace places {

constexpr Size SAMPLE = 200;     // of the queries, to see what leads

// Adjacent rows without the same mean, and the rows that it is of.
struct Shared {
  Size first, last, from, to;
};

// A drive of MIN_FRAMES frames has a mean of its own. Adjacent shorter drives share one; if they still
// have too few frames, it is the mean of all. Fewer than MIN_FRAMES frames in all have none.
std::vector<Shared> sharing(const Drives &drives);

// Scores that are computed in blocks of as many queries as fit in memory. Not for several threads.
class Blocks : public Scores {
 public:
  Blocks(Size queries, Size rows);

  Size queries() const override { return queries_; }
  Size rows() const override { return rows_; }
  void of(Size query, float *scores) const override;

 protected:
  // Fills (last - first, rows) scores of some queries.
  virtual void compute(Size first, Size last, float *scores) const = 0;

 private:
  Size queries_, rows_, size_;
  mutable Size held_ = -1;
  mutable std::vector<float> block_;
};

// By one channel.
class Comparison : public Blocks {
 public:
  using Blocks::Blocks;
  Size width = 0;  // of the sweep, in anchors to each side
};

// The descriptors of the queries of one drive, each from several anchors with the usual one in the
// middle: (count, anchors, ...).
struct Queries {
  const void *descriptors;
  Size count, anchors;
};

// The descriptors of all rows of a map, which must outlive it.
class Channel {
 public:
  virtual ~Channel() = default;
  // Compares queries, without the mean of each drive if standardised, from all anchors or moved to both
  // sides if swept. The channel must outlive the comparison; the queries need not.
  virtual std::unique_ptr<Comparison> compare(const Queries &queries, bool standardised, bool swept,
                                              int threads) = 0;
};

// Vectors (rows, length); zeros are an empty frame.
std::unique_ptr<Channel> channel_of_vectors(const float *rows, Size length, const Drives &drives);

// Signs (rows, columns, bytes), eight in a byte.
std::unique_ptr<Channel> channel_of_signs(const std::uint8_t *rows, Size columns, Size bytes,
                                          const Drives &drives);

// By several channels, which must outlive it: the weighted mean of their z-scores of nearness.
class Fused : public Blocks {
 public:
  Fused(std::vector<const Scores *> members, const std::vector<double> &trust);

  // Of the members; their sum is 1.
  const std::vector<double> &weights() const { return weights_; }

 protected:
  void compute(Size first, Size last, float *scores) const override;

 private:
  std::vector<const Scores *> members_;
  std::vector<double> weights_;
};

}  // namespace places

#endif
