// A map of one or several channels that finds the places of a drive; see ssrvlad_map.h.

#ifndef SSRVLAD_MAP_HPP
#define SSRVLAD_MAP_HPP

#include "compare.hpp"

namespace places {

// Its functions check the channels and queries, and throw `Refused`.
class Map {
 public:
  explicit Map(Listing listing) : listing_(std::move(listing)) {}

  Size channels() const { return static_cast<Size>(channels_.size()); }
  void add(const ssrvlad_channel &channel);
  // The scores of a drive by all channels as one, which the map and what is given must outlive. Fills the
  // steps that were taken.
  std::unique_ptr<Scores> compare(const ssrvlad_queries *queries, Size count, const ssrvlad_steps &steps,
                                  int threads, ssrvlad_taken &taken) const;
  const Listing &listing() const { return listing_; }
  std::vector<double> trust() const;
  // Of the rows of all channels, byte by byte, and of what decisions take from them.
  std::uint64_t digest() const;
  // Refuses queries that are not of a channel.
  void check(Size number, const ssrvlad_queries &queries, Size count) const;
  // What compares queries that come one by one with a channel.
  std::unique_ptr<LiveComparison> live(Size number, Size anchors, bool standardised, bool swept, int threads) const;
  // Of a query of a channel, from so many anchors.
  Size bytes(Size number, Size anchors) const {
    const Member &member = channels_[number];
    return member.channel ? member.bytes * anchors : listing_.count() * static_cast<Size>(sizeof(float));
  }

 private:
  // A channel, none for scores of another method, and what its queries must be.
  struct Member {
    std::unique_ptr<Channel> channel;
    Size length;  // of vectors; 0 for signs
    Size of_mean;
    double trust;
    const std::uint8_t *rows;
    Size bytes;  // of a row
  };

  Listing listing_;
  std::vector<Member> channels_;
};

}  // namespace places

#endif
