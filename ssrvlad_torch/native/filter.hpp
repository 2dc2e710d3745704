// The hidden Markov model of a drive along the rows of a map.
//
// The state is a row where the camera is, and its speed in rows a frame. The belief holds a list of
// rows: a shortlist, or all rows. All other rows are one more state, elsewhere, with one
// probability for each of them; a place that the map lacks is the last one.
// tests/oracles/recognition.py says the same with whole matrices.

#ifndef SSRVLAD_FILTER_HPP
#define SSRVLAD_FILTER_HPP

#include <algorithm>
#include <array>
#include <utility>
#include <vector>

#include "numbers.hpp"

namespace places {

constexpr int SPEEDS = 7;
constexpr double MOST_RATE = 3;  // of courses
constexpr std::array<double, SPEEDS> PRIOR = {0.08, 0.16, 0.34, 0.16, 0.14, 0.07, 0.05};
constexpr int FORWARDS = 1, BACKWARDS = -1;  // ways to run a map

// How a drive moves, and how much one frame counts; recognition/recognise.py explains the settings.
struct Motion {
  double change = MODEL.change, jump = MODEL.jump, unmapped = MODEL.unmapped, stay = 1 - 1.0 / MODEL.stretch,
         weight = MODEL.weight, level = MODEL.level, rate = 1;

  Motion at(double rate) const;
};

// The probabilities of neighbouring steps in rows of one way at each speed, from the first step on, and from the
// last one back.
struct Steps {
  struct Speed {
    Size first;
    std::vector<float> chances, reversed;

    Size count() const { return static_cast<Size>(chances.size()); }
    Size last() const { return first + count() - 1; }
  };
  std::array<Speed, SPEEDS> of;
  Size first = 0, last = 0;  // of all speeds

  Steps(double rate, int way);
};

// Neighbouring rows of one drive of the map; `at` is the place of the first in a list of rows.
struct Run {
  Size first, last, at, drive;
};

// A list of rising rows of a map, as runs.
struct Rows {
  std::vector<Run> runs;
  Size count = 0;

  Size at(Size place) const;    // the row at a place of the list
  Size from(Size row) const;    // the place of the first listed row from a row on
};

// Where each drive of a map starts, and how many rows the map has.
struct Drives {
  std::vector<Size> starts;
  Size rows = 0;

  Size last(Size drive) const;                    // the row after those of a drive
  Size of(Size row) const;                        // the drive of a row
  Rows all() const;                               // all rows
  Rows some(const Size *rows, Size count) const;  // rising rows, each once
};

// The rows of a map that are compared: all, or a shortlist with a random sample of the others, in which a
// row stands for several of the map.
struct Listing {
  Drives map;                   // all rows
  Rows rows;                    // those that are listed
  Drives drives;                // of the list, by places: adjacent rows that may share a mean
  std::vector<double> weights;  // of listed rows, how many each stands for; empty for all rows

  explicit Listing(Drives all) : map(std::move(all)), rows(map.all()), drives(map) {}
  Listing(Drives all, const Size *listed, std::vector<double> weighed, Drives parts)
      : map(std::move(all)), rows(map.some(listed, parts.rows)), drives(std::move(parts)),
        weights(std::move(weighed)) {}

  Size count() const { return rows.count; }
  // The places of the rows that are at most so many rows from that at a place: the first, and the one
  // after the last.
  std::pair<Size, Size> around(Size place, Size reach) const {
    return {rows.from(rows.at(place) - reach), rows.from(rows.at(place) + reach + 1)};
  }
  // Of all rows of the map, by the nearness of those that are listed.
  Spread spread(const float *near) const;
};

// Visits neighbouring rows as seen from a drive: those of it that a list holds, by the row, the place
// in the list and the number; those of it that the list does not hold, and those outside the drive, by
// the row and the number.
template <typename Listed, typename Unlisted, typename Outside>
void visit(Size first, Size last, Size drive, const Rows &list, const Drives &drives, Listed listed,
           Unlisted unlisted, Outside outside) {
  const Size start = std::min(last, std::max(first, drives.starts[drive]));
  const Size end = std::max(start, std::min(last, drives.last(drive)));
  if (first < start) outside(first, start - first);
  auto run = std::upper_bound(list.runs.begin(), list.runs.end(), start,
                              [](Size row, const Run &each) { return row < each.last; });
  for (Size row = start; row < end;) {
    const Size next = run == list.runs.end() ? end : std::min(end, std::max(row, run->first));
    if (row < next) unlisted(row, next - row);
    if (next == end) break;
    row = std::min(end, run->last);
    listed(next, run->at + next - run->first, row - next);
    ++run;
  }
  if (end < last) outside(end, last - end);
}

// The belief after a frame, by way, speed and listed row; those of rows in a unit, so that no pass over them
// is for their sum alone.
struct Belief {
  Rows rows;
  Floats mapped;
  double elsewhere = 0, unmapped = 1, unit = 1;

  // Probabilities of the listed rows in the first way, `count` numbers; in memory that was used before.
  Floats of_rows(Floats memory = {}) const;
};

// How likely a frame is at each listed row, and on average at the others, as against a place that the
// map lacks.
struct Likelihood {
  Floats rows;
  double elsewhere = 0;
};

// How likely a frame and the later ones are from each state of its belief, and from a row by chance; those of
// rows in a unit. Not normalised.
struct Future {
  Floats mapped;
  double elsewhere = 1, unmapped = 1, any_row = 1, unit = 1;
};

// Probabilities of the listed rows in the first way, and of a place that the map lacks, by all frames.
struct Smoothed {
  Floats rows;
  double unmapped;
};

// How much likelier a frame is at rows than at a place that the map lacks, by their nearness, the spread of that of
// all rows, and the weight and level of a motion; 0 where it is -inf.
void likelihoods(const float *near, Size count, double weight, double level, const Spread &spread, float *likely);

class Filter {
 public:
  // The drives may grow, and must outlive the filter. Ways: one or both of FORWARDS and BACKWARDS.
  Filter(const Drives &drives, const Motion &motion, const std::vector<int> &ways);

  const Drives &drives() const { return drives_; }
  const Motion &motion() const { return motion_; }
  // The least and the greatest step in rows, in all ways.
  std::pair<Size, Size> reach() const;

  // The belief in listed rows before the first frame of a drive.
  Belief start(const Rows &rows, Floats memory = {}) const;
  // The belief with more rows listed, of which nothing is believed.
  Belief extended(const Belief &belief, const Rows &rows, Floats memory = {}) const;
  // Takes a frame into a belief: the logarithm of how much likelier the frame is so than alone. After a
  // frame that can be nowhere by the belief, this starts anew, with the frame if it can be anywhere.
  double update(Belief &belief, const Likelihood &likelihood) const;
  // The belief in listed rows one frame later, and that of `update`.
  std::pair<Belief, double> after(const Belief &before, const Rows &rows, const Likelihood &likelihood,
                                  Floats memory = {}) const;

  // The future from the last belief, and from an earlier one by the later rows and their future; `last` if the
  // belief cannot lead there. The filter must have one way, which is not checked.
  Future last(const Belief &belief, const Likelihood &likelihood) const;
  std::pair<Future, Smoothed> before(const Belief &belief, const Likelihood &likelihood, const Rows &later,
                                     const Future &future, Floats memory = {}) const;

 private:
  struct Passing {
    double unlisted = 0, outside = 0;
  };

  Passing passing(const Belief &before, const Rows &rows) const;
  double weigh(Belief &belief, const Likelihood &likelihood) const;
  double take(double total, Belief &belief, const Likelihood &likelihood) const;
  double any_row(double mapped, double elsewhere, const Rows &rows) const;
  Size places() const;  // the number of rows, in all ways; of an empty map as of one row
  double unmapped_at_start() const;

  const Drives &drives_;
  Motion motion_;
  std::vector<Steps> ways_;
};

}  // namespace places

#endif
