/* What is decided of a drive in C, by ssrvlad_map.h, and how sure it is: each answer comes with the
 * probability that it is right.
 *
 * All functions are thread-safe. They return SSRVLAD_OK, SSRVLAD_NO_MEMORY or SSRVLAD_WRONG_ARGUMENT; unless
 * SSRVLAD_OK, the results are undefined.
 */
#ifndef SSRVLAD_DECIDE_H
#define SSRVLAD_DECIDE_H

#include "ssrvlad.h"

#ifdef __cplusplus
extern "C" {
#endif

enum { SSRVLAD_ALONE = 0, SSRVLAD_ONLINE = 1, SSRVLAD_OFFLINE = 2 };
enum { SSRVLAD_FORWARDS = 1, SSRVLAD_BACKWARDS = -1 };

/* The rows of a map: the frames of one drive after those of another. `starts` are the first rows of
 * `count` drives, rising from 0. */
typedef struct ssrvlad_drives {
  const int64_t *starts;
  int64_t count, rows;
} ssrvlad_drives;

/* What is decided of Q queries, in memory of the caller: candidates (Q, top), best first, with scores and
 * rows, -INFINITY and -1 for none; of Q numbers each the probability that the first candidate is right,
 * its standard deviation, and how many neighbouring queries err together. Scores are probabilities of
 * rows if the drive is `followed`, of the first candidate with the rows beside it, else the scores of the
 * rows. The course that was taken, or was found and left because the answers are surer without: the way,
 * the rate in rows of the map a frame, the number of streams whose frames alternate; and its gain a
 * query, 0 if there is no course. */
typedef struct ssrvlad_decision {
  float *scores;
  int64_t *rows;
  float *right, *spread, *together;
  int32_t followed, way;
  int64_t streams;
  double rate, gain;
} ssrvlad_decision;

/* The probability that a wrong answer is as far ahead of its rivals as the best of `count` values is,
 * and the row of the best rival, -1 without one. The higher a value the better, -INFINITY where there can
 * be no match. `rows` are the rows of the map, rising, or NULL for the first ones; `matching` is the
 * number of rows of the map that could match, or -1 for those with a value. */
SSRVLAD_API int ssrvlad_chance(const double *values, const int64_t *rows, int64_t count, int64_t matching,
                               double *chance, int64_t *rival);

/* The probability that the map has the place of each query of a drive, by the chance of its answer by this
 * query alone, NaN without an answer; so many neighbouring queries err together. 0 without an answer.
 * `best` is how often a wrong answer is the best of its query: 1 if it was judged alone; if it is less, the
 * chance of an answer that is not the best is 1. */
SSRVLAD_API int ssrvlad_mapped(const double *chances, int64_t queries, double together, double best,
                               double *mapped);

/* Of the answers to the queries of a drive the probability that each is right, and its standard
 * deviation, by their chances, NaN without an answer, and the probability that the map has the place; so
 * many neighbouring queries err together. Where the map has the places few answers of a drive that is
 * `followed`, not 0, are wrong; of queries judged alone any part may be. */
SSRVLAD_API int ssrvlad_confidence(const double *chances, const double *mapped, int64_t queries,
                                   double together, int followed, float *right, float *spread);

/* How many neighbouring queries of a drive have one answer, by the best rivals of their answers; -1 if
 * memory is short, or there are no such rivals. */
SSRVLAD_API double ssrvlad_together(const int64_t *rivals, int64_t queries);

#ifdef __cplusplus
}
#endif

#endif
