// The descriptors of a live stream by one channel, and the scores of a new frame against them.
//
// Each frame is compared without the mean of its stretch. The mean of the present stretch is that of its
// frames so far, with `before` frames of the mean of all before. tests/oracles/loops.py says the same plainly.

#ifndef SSRVLAD_LIVE_HPP
#define SSRVLAD_LIVE_HPP

#include <memory>
#include <vector>

#include "numbers.hpp"
#include "ssrvlad_loops.h"

namespace places {

// Whether each row is chosen; empty if all are.
using Chosen = std::vector<std::uint8_t>;

class LiveChannel {
 public:
  virtual ~LiveChannel() = default;

  virtual Size bytes() const = 0;  // of a descriptor
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

// `descriptor` is vectors of length 1, or zero for an empty frame, or signs on a grid of cells.
std::unique_ptr<LiveChannel> channel_of(const ssrvlad_loops_channel &channel);

}  // namespace places

#endif
