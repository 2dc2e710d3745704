// A live stream: has this place been seen before? tests/oracles/loops.py says the same plainly, and what its
// constants mean.

#ifndef SSRVLAD_LOOPS_HPP
#define SSRVLAD_LOOPS_HPP

#include <deque>

#include "filter.hpp"
#include "live.hpp"
#include "ssrvlad_loops.h"

namespace places {

// How self-similar the street is around each frame of a stretch, from frames too recent to be loops.
class Repeats {
 public:
  explicit Repeats(Size exclude);

  void reserve(Size frames) { highest_.reserve(static_cast<std::size_t>(frames)); }
  void start_stretch();
  // Takes the nearness of the next frame to all earlier ones of the stretch.
  void after(const float *near, Size count);
  // Of the earlier frames; NONE where nothing is known.
  const std::vector<float> &highest() const { return highest_; }

 private:
  Size nearest_, farthest_;
  std::deque<std::vector<float>> last_;
  std::vector<float> highest_;
};

// How closely the frames of a stretch before each earlier frame run beside the last ones.
class Tracks {
 public:
  // By label maps alone, tracks by chance are as close as those of returns.
  Tracks(Size exclude, bool alone);

  void reserve(Size frames);
  void start_stretch();
  // Takes the nearness of the next frame to all earlier ones of the stretch, of which the first are old.
  void after(const float *near, Size count, Size old);
  // Takes whether the frame closes a loop: tracks around one are not by chance, nor are those of a camera
  // that stands, nor is, for a while, a return that may still become a loop.
  void decided(bool accepted);
  // Whether the last frames run beside old ones in another light.
  bool returning() const;
  // How much nearer than the mean an old frame can be at a new place; 0 where that is not known.
  double explained() const;

 private:
  bool tells() const;  // whether enough tracks by chance were seen
  float step() const;  // how much nearer than different places a frame is to the next

  Size exclude_;
  bool alone_;
  std::vector<float> closeness_, before_;
  std::deque<float> steps_, others_, waiting_, by_chance_;
  Size since_, held_ = 0;
  float closest_ = 0, densest_ = 0;  // of old frames, and of the older half of the excluded ones
};

class Stream {
 public:
  Stream(const ssrvlad_loops_settings &settings, const ssrvlad_loops_channel *channels, int count);
  Stream(const Stream &) = delete;

  Size rows() const { return static_cast<Size>(described_.size()); }
  const std::vector<std::unique_ptr<LiveChannel>> &channels() const { return channels_; }
  std::vector<double> weights() const;

  ssrvlad_loop update(const void *const *descriptors, const Size *anchors, double stamp, bool starts,
                      int threads);
  void extend(const void *const *descriptors, double stamp, bool starts);
  // Memory for so many frames: no step asks for more that grows with their number.
  void reserve(Size frames);
  void settle();  // after frames that are known: the next one is then as quick as others

 private:
  bool breaks(const void *const *centres, double stamp) const;
  void start_stretch();
  // The rows but so many last frames of the present stretch: those of others are never recent.
  Size without_last(Size frames) const;
  void grow();  // states of the filter, one for each frame but the most recent
  void store(const void *const *centres, double stamp, Size shown);
  ssrvlad_loop step(const void *const *swept, const void *const *centres, const Size *anchors,
                    int threads);
  std::vector<float> &scores(const void *const *swept, const Size *anchors, int threads, Size old);
  Size stride(Size old) const;  // between old rows that show what is usual, and are compared anyhow
  void usual(const std::vector<float> &near, Size old, std::vector<float> &usual) const;  // nearness of these
  void choose(const std::vector<float> &rough, Size old);
  struct Fit {
    double weight, level;
  };
  Fit fit() const;
  void compute_likelihood(const Spread &spread);
  void filter();
  ssrvlad_loop result(const std::vector<float> &scores);

  Size exclude_;
  double threshold_;
  Size scan_above_;
  std::vector<std::size_t> rough_;  // numbers of the channels that give rough scores
  std::vector<std::unique_ptr<LiveChannel>> channels_;
  std::vector<double> trust_, leads_;
  std::vector<bool> described_;
  std::vector<Size> shown_;  // of each row the first one known to show its place, by the loops that closed
  Size known_ = 0, old_known_ = 0, old_ = 0;  // frames that are not empty: of all, and of the first old
  std::vector<Size> starts_;                  // of stretches
  std::deque<double> stamps_;                 // of the last frames of the present stretch
  Drives drives_;
  Filter filter_;
  Belief belief_;
  std::vector<float> probable_;  // how probable rows are by it
  bool starting_ = true;
  std::deque<double> neighbours_, fits_;
  Repeats repeats_;
  Tracks tracks_;
  std::vector<double> explained_;  // by the tracks of each stretch but the present one

  // Of the last frame, kept for their memory.
  struct OfRows {
    std::vector<float> scores, fused, near, usual, rough_usual, same, left, belief;
    std::vector<std::vector<float>> of_channels, rough;  // nearness by channel, empty if it is not rough
    std::vector<double> z;
    Chosen chosen;
    Likelihood likelihood;
  };
  OfRows of_rows_;
};

}  // namespace places

#endif
