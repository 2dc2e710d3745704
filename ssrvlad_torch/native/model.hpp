// The numbers that shape where a query is said to be and how sure that is, and whether a frame of a live stream
// closes a loop. `frames` are those of a query's sequence or of the stream, `rows` those of the map. Each number
// says how it was obtained; half and twice of those that are no grids and not defined are in
// docs/research/half-twice.csv and half-twice-loops.csv:
//
//   defined   follows from what it means
//   drives    chosen on every fifth of the real cases of the page on confidence and on cities 0 to 5
//   motion    chosen on UofA, Gardens Point, CamVid and a city, each by the other three
//   counted   counted in the same cases as `drives`
//   pairs     chosen on the first four pairs of two drives on the page on loops, and on tours of cities
//   by hand   a round number

#ifndef SSRVLAD_MODEL_HPP
#define SSRVLAD_MODEL_HPP

#include <cstdint>

namespace places {

struct PlaceModel {
  // Places
  std::int64_t near = 3;              // rows to one that shows the same place, at most; defined, as the tolerance of results
  std::int64_t elsewhere = 5;         // rows, or frames, from which on one shows another place; by hand
  std::int64_t min_frames = 30;       // of a sequence with a mean, a course online, gaps; of a map with confidence; by hand
  std::int64_t before = 10;           // frames like those before, which the mean of the first frames takes in; by hand
  double rounding = 1e-4;    // more than which a wider sweep must lead, and values of rivals differ; defined

  // Motion, a frame
  double change = 0.05;      // probability of another speed; motion
  double jump = 0.01;        // probability of any other row; by hand
  double unmapped = 0.1;     // prior probability that the map lacks the first place, or one after a jump; by hand
  std::int64_t stretch = 200;         // mean number of frames whose places the map has, or lacks: so many are judged online; drives
  double weight = 0.3;       // of the deviations by which a row is nearer, as the logarithm of a chance; motion
  double level = 0.5;        // deviations of a place that the map lacks; motion
  double most_log = 50;      // logarithm of a chance, at most: frames may equal their rows; defined

  // Courses
  double unusual = 3;        // how much more another than forwards must gain; by hand: one sequence in twenty takes it
  double of_two = 0.75;      // what counts of the gain of two streams; by hand
  double remainder = 0.5;    // of the gain, in a random order, and after others rest; by hand, after a table was seen
  double trailing = 10;      // gain by which a course trails and rests; by hand, for speed
  double least_rate = 0.1;   // gain a query of a course that is taken, of `around` at least: random frames gain less; pairs
  double behind = 1;         // how much less ahead than alone, as the logarithm of a chance, answers may be; so too

  // Frames around
  std::int64_t around = 10;           // frames on each side that must show a place, and tell whether answers linger; drives
  std::int64_t streams = 2;           // of a course, at most; defined
  std::int64_t compared = 512;        // rows by which frames are compared, queries that show which channel leads; by hand
  double lingering = 0.5;    // of the usual rows, and of neighbours: less far to more of these lingers; cities 0 to 5

  // Rivals
  std::int64_t most_places = 10;      // best places that are compared; by hand
  double rows_a_place = 8.5;  // of a map; counted

  // Confidence
  double slope = 0.25, deviation = 0.6;  // of right answers the median rate, and the deviation of its logit; drives
  double few = 2;            // power of the density of the fraction of wrong answers, if followed; drives
  double chance_nearer = 1.9;   // deviations by which the place of a followed answer is nearer by chance; counted
  double least_together = 2;    // neighbouring queries that count as one, at least; drives
  double most_nearer = 6;       // more, at which right ones are, at most; defined
  std::int64_t points = 15;         // of a grid of the prior, which is fine enough; defined
  double most_away = 2.5;    // deviations of the rates of the grid; defined
};

inline constexpr PlaceModel MODEL;

struct LoopModel {
  // Motion, a frame; else as of places
  double change = 0.01, unmapped = 0.3, stay = 0.97, weight = 0.25;  // pairs

  // Frames
  std::int64_t stride = 50;         // the frame before is the one so many parts of the excluded ones ago; by hand
  std::int64_t usual = 100;         // last frames that show what is usual just now; by hand
  std::int64_t memory = 1000;       // frames that show what is usual in a stretch; by hand
  double least_place = 0.01;        // probability of a place that is reported; by hand

  // Within a stretch
  double evidence = 3;              // logarithm of how much likelier a row at twice the level is; pairs
  double level_fraction = 0.9;      // of how near the frame before usually is, the level of a loop; pairs
  double repeat_margin = 1.2;       // by which a loop must be nearer than the street repeats; pairs
  std::int64_t distant = 5;         // parts of the excluded frames from which on they show that; by hand
  std::int64_t track = 15;          // frames in a row that show that; pairs

  // Of another stretch
  std::int64_t fits = 20;           // last loops that show how well right rows fit; by hand
  std::int64_t least_known = 5;     // loops, or tracks by chance, before they count; by hand
  double fit = 0.5, fit_weight = 2;  // of their median the level of a new place, and how much more it counts; pairs

  // Tracks: returns in another light
  float smoothing = 0.93F;          // of a track, what it keeps a frame; pairs
  double explained = 0.9;           // quantile of tracks by chance that a new place explains, by label maps; cities
  float by_chance = 1.5F;           // times as close as these a return is; pairs
  float clear = 0.12F;              // closeness from which tracks by chance are too close to tell returns; pairs
  float same = 0.75F;               // closeness of one light, 1 being a frame and the next; pairs
  std::int64_t wait = 25;           // frames without a loop before and after a track by chance; pairs

  // Gaps, at which a stretch ends
  double gap = 600, gap_steps = 10;  // seconds, and times the usual step, that a gap is longer than; by hand
  double like = 0.5, spreads = 3;   // of a usual step, and deviations of different places: one light; pairs

  // Large memories
  double chosen = 0.01;             // of the rows, by their rough scores, that are compared exactly; by hand, for speed
};

inline constexpr LoopModel LOOPS;

}  // namespace places

#endif
