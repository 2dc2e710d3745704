/* A map in C: from the descriptors of a map and of a drive, by one or several channels, to the places of
 * the drive, with the probability that each is right.
 *
 *     const int64_t starts[] = {0, 4000};
 *     const ssrvlad_drives drives = {starts, 2, 9000};
 *     ssrvlad_map *map = ssrvlad_map_new(&drives);
 *     const ssrvlad_channel shapes = {descriptors, SSRVLAD_VECTORS, 1, 480, 1.0};
 *     if (map && ssrvlad_map_add_channel(map, &shapes) == SSRVLAD_OK)
 *       ssrvlad_map_query(map, &queries, 150, &steps, threads, &decision, &taken);
 *     ssrvlad_map_free(map);
 *
 * The places are those of `ssrvlad query` and of the Python package ssrvlad_torch. A map that has all its
 * channels may be used by several threads. Functions return SSRVLAD_OK, SSRVLAD_NO_MEMORY or
 * SSRVLAD_WRONG_ARGUMENT: a size or a setting out of range, or a number that is not finite; unless
 * SSRVLAD_OK, the results are undefined.
 */
#ifndef SSRVLAD_MAP_H
#define SSRVLAD_MAP_H

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
 * query, 0 if there is no course. `follows` is NULL, or says of each query whether it is followed: online that
 * depends on the queries before it. */
typedef struct ssrvlad_decision {
  float *scores;
  int64_t *rows;
  float *right, *spread, *together;
  int32_t followed, way;
  int64_t streams;
  double rate, gain;
  uint8_t *follows;
} ssrvlad_decision;

typedef struct ssrvlad_map ssrvlad_map;

/* Some rows of a map that stand for all: likely candidates, and a random sample of the others. `rows` are
 * their numbers in the map, rising; `weights` are how many rows of the map each stands for, 1 or more.
 * `means` are the first places, rising from 0, of adjacent rows that lose one mean. */
typedef struct ssrvlad_shortlist {
  const int64_t *rows;
  const double *weights;
  int64_t count;
  const int64_t *means;
  int64_t means_count;
} ssrvlad_shortlist;

/* The descriptors of the rows of a map, or of its shortlist, by one channel, in their order; they are not
 * copied, and must outlive the map. Vectors are float (rows, size), of length 1, or zeros for an empty frame,
 * which matches nothing; columns and height are 1. Signs are bytes (rows, columns, height, size), eight in
 * each, of cells in columns. Scores of another method have no rows, and columns, height and size are 1.
 * `trust` is how much the channel counts beside others before anything is known of a drive. `means` are what
 * the rows of a shortlist lose: (means_count, size), of signs as 1 and -1 (means_count, columns, height,
 * 8 * size); NULL for the means of the drives. */
typedef struct ssrvlad_channel {
  const void *rows;
  int32_t kind;
  int64_t columns, height, size;
  double trust;
  const float *means;
} ssrvlad_channel;

/* The descriptors of the queries of one drive by one channel, each from `anchors` anchors, with the usual
 * one in the middle: (count, anchors, ...). Signs have one anchor. Scores of another method are float (count,
 * rows), at most 1, -INFINITY where there can be no match. */
typedef struct ssrvlad_queries {
  const void *descriptors;
  int64_t anchors;
} ssrvlad_queries;

/* What is done between descriptors and a decision. Standardise: each drive loses the mean of its
 * descriptors, if the queries and the map have 30 frames each; adjacent drives of the map of fewer frames
 * share one. Sweep: all anchors of the queries count, as far to both sides as suits the scores best;
 * signs are moved by up to three columns and two rows. Follow: SSRVLAD_ALONE, SSRVLAD_ONLINE with `delay` later queries,
 * or SSRVLAD_OFFLINE, by the queries before each, and `delay` later ones, or by all. `top` candidates are
 * found for each query, among the rows with `allowed` (rows,) not 0, NULL for all, that are not from the
 * first to before the second row of the map of the query in `excluded` (count, 2), NULL for none. */
typedef struct ssrvlad_steps {
  int32_t standardise, sweep, follow;
  int64_t delay, top;
  const uint8_t *allowed;
  const int64_t *excluded;
} ssrvlad_steps;

/* The steps that were taken: whether descriptors were standardised, the anchors to each side that count,
 * and the weights of the channels, whose sum is 1, in memory of the caller. */
typedef struct ssrvlad_taken {
  int32_t standardised;
  int64_t width;
  double *weights;
} ssrvlad_taken;

/* `ssrvlad_map_new(drives)` creates a map without channels, or returns NULL if the drives do not start at
 * rising rows, the first at 0, or memory is short. */
#define ssrvlad_map_new(...) ssrvlad_map_new_for(SSRVLAD_INTERFACE, __VA_ARGS__)
SSRVLAD_API ssrvlad_map *ssrvlad_map_new_for(int program, const ssrvlad_drives *drives);

/* `ssrvlad_map_of(drives, shortlist)` creates a map of which a shortlist of the rows is there; NULL as
 * above. */
#define ssrvlad_map_of(...) ssrvlad_map_of_for(SSRVLAD_INTERFACE, __VA_ARGS__)
SSRVLAD_API ssrvlad_map *ssrvlad_map_of_for(int program, const ssrvlad_drives *drives,
                                            const ssrvlad_shortlist *shortlist);
SSRVLAD_API void ssrvlad_map_free(ssrvlad_map *map);

/* Adds a channel; the first one has the number 0. */
SSRVLAD_API int ssrvlad_map_add_channel(ssrvlad_map *map, const ssrvlad_channel *channel);

/* Finds the `count` queries of a drive, given for each channel of the map in its order; `threads` threads
 * share the rows. */
SSRVLAD_API int ssrvlad_map_query(const ssrvlad_map *map, const ssrvlad_queries *queries, int64_t count,
                                  const ssrvlad_steps *steps, int threads, ssrvlad_decision *decision,
                                  ssrvlad_taken *taken);

/* Fills the scores (count, rows) of a drive by all channels, by which `ssrvlad_map_query` decides. */
SSRVLAD_API int ssrvlad_map_compare(const ssrvlad_map *map, const ssrvlad_queries *queries, int64_t count,
                                    const ssrvlad_steps *steps, int threads, float *scores,
                                    ssrvlad_taken *taken);

/* A sequence whose queries come one by one, in a map that stays as it is and must outlive it: what
 * `ssrvlad_map_query` finds with SSRVLAD_ONLINE. The mean of the queries, the width of the sweep, the weights of the
 * channels and the course are those of the queries so far; to the mean ten frames like the map's are added. */
typedef struct ssrvlad_tracker ssrvlad_tracker;

/* `ssrvlad_tracker_new(map, steps)` creates a tracker, or returns NULL. It copies the steps; `follow` and `excluded`
 * do not matter. */
#define ssrvlad_tracker_new(...) ssrvlad_tracker_new_for(SSRVLAD_INTERFACE, __VA_ARGS__)
SSRVLAD_API ssrvlad_tracker *ssrvlad_tracker_new_for(int program, const ssrvlad_map *map,
                                                     const ssrvlad_steps *steps);
SSRVLAD_API void ssrvlad_tracker_free(ssrvlad_tracker *tracker);

/* How many queries it has taken: the number that the next one gets. -1 for NULL. */
SSRVLAD_API int64_t ssrvlad_tracker_count(const ssrvlad_tracker *tracker);

/* Takes the next query, given for each channel of the map. If a query has as many later ones as the delay,
 * `decision` and `taken` are its answer, and `query` its number, from 0; else `query` is -1. `ssrvlad_tracker_finish`
 * takes none: it answers the first query that waits for later ones, by those that there are. After SSRVLAD_NO_MEMORY
 * a tracker refuses all but to be freed. */
SSRVLAD_API int ssrvlad_tracker_update(ssrvlad_tracker *tracker, const ssrvlad_queries *queries, int threads,
                                       ssrvlad_decision *decision, ssrvlad_taken *taken, int64_t *query);
SSRVLAD_API int ssrvlad_tracker_finish(ssrvlad_tracker *tracker, ssrvlad_decision *decision, ssrvlad_taken *taken,
                                       int64_t *query);

/* Writes the state of a tracker, if it has at most `size` bytes; returns its number of bytes, -1 if memory is
 * short or was before. `ssrvlad_tracker_load` puts it into a new tracker, of the same map with the same steps; the
 * answers to later queries are the same to the bit. What is no such state is refused, and the tracker can then only
 * be freed. */
SSRVLAD_API int64_t ssrvlad_tracker_save(ssrvlad_tracker *tracker, void *state, int64_t size);
SSRVLAD_API int ssrvlad_tracker_load(ssrvlad_tracker *tracker, const void *state, int64_t size);

#ifdef __cplusplus
}
#endif

#endif
