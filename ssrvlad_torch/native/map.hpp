// A map of one or several channels that finds the places of a drive; see ssrvlad_map.h.

#ifndef SSRVLAD_MAP_HPP
#define SSRVLAD_MAP_HPP

#include "compare.hpp"
#include "decide.hpp"
#include "ssrvlad_map.h"

namespace places {

// Its functions check the channels and queries, and throw `Failed`.
class Map {
 public:
  explicit Map(Drives drives) : drives_(std::move(drives)) {}

  Size channels() const { return static_cast<Size>(members_.size()); }
  void add(const ssrvlad_channel &channel);
  std::unique_ptr<Comparison> compare(Size channel, const ssrvlad_queries &queries, Size count,
                                      bool standardised, bool swept, int threads) const;
  // Fills the steps that were taken.
  Decision query(const ssrvlad_queries *queries, Size count, const ssrvlad_steps &steps, int threads,
                 ssrvlad_taken &taken) const;

 private:
  // A channel, and what its queries must be.
  struct Member {
    std::unique_ptr<Channel> channel;
    Size length;  // of vectors; 0 for signs
    Size of_mean;
    double trust;
  };

  Drives drives_;
  std::vector<Member> members_;
};

}  // namespace places

#endif
