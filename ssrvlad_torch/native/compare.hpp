// The queries of one drive against all rows of a map: by a channel, and by several channels as one.
//
// A drive loses the mean of its descriptors; a query is described from several anchors, or moved to both sides, and its
// best score counts.

#ifndef SSRVLAD_COMPARE_HPP
#define SSRVLAD_COMPARE_HPP

#include <memory>
#include <vector>

#include "archive.hpp"
#include "decide.hpp"
#include "ssrvlad_map.h"

namespace places {

// Adjacent rows without the same mean, and the rows that it is of, or the mean if it is given.
struct Shared {
  Size first, last, from, to;
  const float *mean;
};

// What drives lose: means of so many numbers, one for each drive if they are given. Else a drive of `min_frames`
// frames has a mean of its own. Adjacent shorter drives share one; if they still have too few frames, it is the mean
// of all. Fewer than `min_frames` frames in all have none.
std::vector<Shared> sharing(const Drives &drives, const float *means, Size length);

// Scores that are computed in blocks of as many queries as fit in memory. Not for several threads.
class Comparison : public Scores {
 public:
  Comparison(Size queries, Size rows);

  Size queries() const override { return queries_; }
  Size rows() const { return rows_; }
  void of(Size query, float *scores) const override;

  Size width = 0;  // of the sweep, in anchors to each side

 protected:
  // Fills (last - first, rows) scores of some queries.
  virtual void compute(Size first, Size last, float *scores) const = 0;

 private:
  Size queries_, rows_, size_;
  mutable Size held_ = -1;
  mutable std::vector<float> block_;
};

// A sequence of which the queries come one by one, by one channel: each is compared without the mean of those
// so far, itself among them, and of `before` frames like the mean of the map. It must not outlive its channel.
class LiveComparison {
 public:
  virtual ~LiveComparison() = default;
  // Takes the next query, its descriptors from all anchors, and fills the scores of all rows.
  virtual void next(const void *query, int threads, float *scores) = 0;
  // Writes or reads what is of the queries so far.
  virtual void keep(Archive &archive) = 0;
  Size width = 0;  // of the sweep, in anchors to each side, by the queries so far
};

// The descriptors of the listed rows of a map, which must outlive it.
class Channel {
 public:
  virtual ~Channel() = default;
  // Compares so many queries, without the mean of each drive if standardised, from the anchors that suit or moved
  // to both sides if swept. The channel must outlive the comparison; the queries need not.
  virtual std::unique_ptr<Comparison> compare(const ssrvlad_queries &queries, Size count, bool standardised,
                                              bool swept, int threads) = 0;
  // The same for queries that come one by one, from so many anchors.
  virtual std::unique_ptr<LiveComparison> live(Size anchors, bool standardised, bool swept, int threads) = 0;
};

// Vectors (rows, length) of the listed rows; zeros are an empty frame. The means of the drives of the list,
// (drives, length), must outlive the channel, as the rows and the list must; without, they are those of the
// rows.
std::unique_ptr<Channel> channel_of_vectors(const float *rows, Size length, const Listing &listing,
                                            const float *means);

// Signs (rows, columns, height, bytes), eight in a byte; means as above, (drives, columns, height, 8 * bytes).
std::unique_ptr<Channel> channel_of_signs(const std::uint8_t *rows, Size columns, Size height, Size bytes,
                                          const Listing &listing, const float *means);

// Makes NONE of the scores of a query at rows that are no candidates; as below.
void mask(const Listing &listing, const std::uint8_t *allowed, const Size *excluded, float *scores);

// Scores without those of rows that are no candidates: rows of the list that are not `allowed`, if given, and
// for each query the rows of the map from the first of a pair to before the second, if pairs are given.
class Candidates : public Scores {
 public:
  Candidates(std::unique_ptr<Scores> scores, const Listing &listing, const std::uint8_t *allowed, const Size *excluded)
      : scores_(std::move(scores)), listing_(listing), allowed_(allowed), excluded_(excluded) {}
  Size queries() const override { return scores_->queries(); }
  void of(Size query, float *scores) const override {
    scores_->of(query, scores);
    mask(listing_, allowed_, excluded_ ? excluded_ + 2 * query : nullptr, scores);
  }

 private:
  std::unique_ptr<Scores> scores_;
  const Listing &listing_;
  const std::uint8_t *allowed_;
  const Size *excluded_;
};

// One query by several channels.
class Fusion {
 public:
  Fusion(std::vector<std::vector<float>> scores, const Listing &listing);

  // By how many deviations the first candidate of each channel is ahead of the best row elsewhere.
  std::vector<double> leads() const;
  // The weighted mean of their z-scores of nearness, as cosines.
  void of(const std::vector<double> &weights, float *scores) const;

 private:
  std::vector<std::vector<float>> near_;  // NONE where there is none
  std::vector<Spread> spreads_;           // of the rows that have one
  const Listing &listing_;
};

// By several channels.
class Fused : public Comparison {
 public:
  Fused(std::vector<std::unique_ptr<Scores>> members, const std::vector<double> &trust, const Listing &listing);

  // Of the members; their sum is 1.
  const std::vector<double> &weights() const { return weights_; }

 protected:
  void compute(Size first, Size last, float *scores) const override;

 private:
  Fusion of_query(Size query) const;

  std::vector<std::unique_ptr<Scores>> members_;
  std::vector<double> weights_;
  const Listing &listing_;
};

}  // namespace places

#endif
