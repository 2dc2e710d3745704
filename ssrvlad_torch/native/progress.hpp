// Whether the answers of a drive move on as its frames change.

#ifndef SSRVLAD_PROGRESS_HPP
#define SSRVLAD_PROGRESS_HPP

#include <array>
#include <deque>
#include <vector>

#include "numbers.hpp"

namespace places {

// How alike the neighbouring queries of a drive see a map.
class Likeness {
 public:

  // Takes the next query: its scores at rows that represent the map, the same for each, NONE where there
  // can be no match.
  void add(const std::vector<float> &scores);
  // The correlation of a query with one before it, at most `around` * `streams`.
  double of(Size query, Size before) const {
    return each_[static_cast<std::size_t>(query - first_)][static_cast<std::size_t>(query - before - 1)];
  }
  // Forgets all queries but so many.
  void forget(Size most) {
    for (; static_cast<Size>(each_.size()) > most; ++first_) each_.pop_front();
  }
  template <typename Archive>
  void keep(Archive &archive) {
    archive(first_), archive(each_), archive(recent_);
  }

 private:
  std::deque<std::vector<double>> recent_;  // profiles, the newest first
  std::deque<std::array<double, MODEL.around * MODEL.streams>> each_;  // of the queries from `first_` on
  Size first_ = 0;
};

// Which answers of a stream of queries, their rows, -1 for none, linger at one place while the frames go
// on to others, by so many later queries, at most `around`.
std::vector<bool> lingering(const Likeness &likeness, const std::vector<Size> &queries,
                            const std::vector<Size> &rows, Size later);

}  // namespace places

#endif
