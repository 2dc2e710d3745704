/* From scores to decisions in C: a drive is followed along the rows of a map, and each answer comes with
 * the probability that it is right.
 *
 * The decisions are those of `ssrvlad query` and of the Python package ssrvlad_torch. All functions are
 * thread-safe. They return SSRVLAD_OK, SSRVLAD_NO_MEMORY, SSRVLAD_WRONG_ARGUMENT, or the negative code
 * of a function that the caller gave; unless SSRVLAD_OK, the results are undefined.
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

/* The queries of one drive, and how they fit a map. Scores are cosines, at most 1, and -INFINITY where
 * there can be no match. They come as one of three; what is not used is NULL:
 *  - `matrix` (queries, rows).
 *  - `scores` fills those of one query, one for each row of the map.
 *  - For a map that is too large to score every row, four functions: `candidates` of a query; scores
 *    of `some` rows, rising; the `spread`, mean and standard deviation, of the nearness of all rows,
 *    which is -log(1 - score); and a `sample` of rows that represent all, the same for each query, with
 *    their scores: the same part of all rows as of these is taken to match.
 *    `candidates` and `sample` return how many rows there are, and fill them unless `rows` is NULL.
 * Functions are called several times with each query, by the thread of the caller and with `context`.
 * A negative return value ends the call. */
typedef struct ssrvlad_evidence {
  int64_t queries;
  const float *matrix;
  void *context;
  int (*scores)(void *context, int64_t query, float *scores);
  int64_t (*candidates)(void *context, int64_t query, int64_t *rows);
  int (*some)(void *context, int64_t query, const int64_t *rows, int64_t count, float *scores);
  int (*spread)(void *context, int64_t query, double *mean, double *deviation);
  int64_t (*sample)(void *context, int64_t query, int64_t *rows, float *scores);
} ssrvlad_evidence;

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

/* Decides about a drive: each query alone, or followed, online by the queries before it and `delay` later
 * ones, offline by all. Scores that are NaN or above 1.001 are a SSRVLAD_WRONG_ARGUMENT. */
SSRVLAD_API int ssrvlad_decide(const ssrvlad_drives *map, const ssrvlad_evidence *evidence, int mode,
                               int64_t delay, int64_t top, ssrvlad_decision *decision);

/* How a drive is expected to move, and how much one frame counts: the settings of the Python class
 * Motion. NULL stands for its defaults. */
typedef struct ssrvlad_motion {
  double change, jump, unmapped, stay, weight, level, rate;
} ssrvlad_motion;

/* Where each of Q queries is, in memory of the caller: candidates (Q, top) with probabilities and rows;
 * of Q numbers each the probability of the rows beside the first, that of a place that the map lacks, and
 * the chance of `ssrvlad_chance` for the first. */
typedef struct ssrvlad_places {
  float *scores;
  int64_t *rows;
  float *around, *unmapped;
  double *chance;
} ssrvlad_places;

/* Follows a drive by a way, whether its queries run the map or not. */
SSRVLAD_API int ssrvlad_follow(const ssrvlad_drives *map, const ssrvlad_evidence *evidence,
                               const ssrvlad_motion *motion, int way, int mode, int64_t delay, int64_t top,
                               ssrvlad_places *places);

/* How much likelier the queries are as a drive that runs the map in a way than each alone, as a natural
 * logarithm. */
SSRVLAD_API int ssrvlad_gain(const ssrvlad_drives *map, const ssrvlad_evidence *evidence,
                             const ssrvlad_motion *motion, int way, double *gain);

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
