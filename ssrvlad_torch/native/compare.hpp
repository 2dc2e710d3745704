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

// Each drive, if it has a mean of its own whatever its number of frames.
std::vector<Shared> each_alone(const Drives &drives);

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

// The descriptors of queries of one drive, each from several anchors with the usual one in the middle:
// (count, anchors, ...). They lose the mean of the drive, if it is given; else their own, if standardised.
struct Queries {
  const void *descriptors;
  Size count, anchors;
  const float *mean = nullptr;
};

// The descriptors of all rows of a map, which must outlive it.
class Channel {
 public:
  virtual ~Channel() = default;
  // Compares queries, without the mean of each drive if standardised, from the anchors that suit or moved
  // to both sides if swept; from all anchors if the mean of the queries is given. The channel must outlive
  // the comparison; the queries need not.
  virtual std::unique_ptr<Comparison> compare(const Queries &queries, bool standardised, bool swept,
                                              int threads) = 0;
};

// Vectors (rows, length); zeros are an empty frame. The means of the drives, (drives, length), must outlive
// the channel, as the rows must; without, they are those of the rows.
std::unique_ptr<Channel> channel_of_vectors(const float *rows, Size length, const Drives &drives,
                                            const float *means);

// Signs (rows, columns, bytes), eight in a byte; means as above, (drives, columns, 8 * bytes).
std::unique_ptr<Channel> channel_of_signs(const std::uint8_t *rows, Size columns, Size bytes,
                                          const Drives &drives, const float *means);

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
