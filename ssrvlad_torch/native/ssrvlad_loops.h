/* Loop closures in a live stream in C, on a CPU, without any other library: has this place been seen
 * before?
 *
 * A frame is known by its descriptors in one channel or several, vectors or signs. Each new frame is
 * compared with all earlier ones, the scores of the channels are fused, and a Bayes filter follows the
 * stream. The results are those of `LoopDetector` of the Python package ssrvlad_torch; its
 * tests/oracles/loops.py says plainly what is computed.
 *
 *     ssrvlad_loops_channel shapes = {SSRVLAD_VECTORS, {480, 1, 1}, 1.0};
 *     ssrvlad_loops_settings settings = {50, 0.8, SSRVLAD_SCAN_ABOVE};
 *     ssrvlad_loops *loops = ssrvlad_loops_new(&settings, &shapes, 1);
 *     ...
 *     const void *frame[] = {descriptor};
 *     ssrvlad_loop result;
 *     ssrvlad_loops_update(loops, frame, NULL, stamp, 0, 1, &result);
 *
 * A stream belongs to one thread at a time; different streams may be used at the same time. After
 * SSRVLAD_NO_MEMORY a stream refuses all further frames; those before can still be copied.
 */
#ifndef SSRVLAD_LOOPS_H
#define SSRVLAD_LOOPS_H

#include "ssrvlad.h"

#ifdef __cplusplus
extern "C" {
#endif

/* What is known of each frame. A frame is empty if its first channel is a zero vector. */
typedef struct ssrvlad_loops_channel {
  int32_t kind;     /* SSRVLAD_VECTORS or SSRVLAD_SIGNS */
  int64_t shape[3]; /* of vectors their length, 1, 1; of signs columns, rows, bytes of a cell */
  double trust;     /* how much the channel counts before it has led; that of label maps is 1 */
} ssrvlad_loops_channel;

typedef struct ssrvlad_loops_settings {
  int64_t exclude;  /* number of the last frames of the same sequence, which are no candidates; 50 for
                       frames 3 m apart */
  double threshold; /* least probability of a loop, 0 to 1; 0.8 */
  int64_t scan_above; /* number of old frames above which, if they have signs, all are compared by a
                         part of these; by all channels then near and probable ones, and of the others
                         half as many or more; at least 1; SSRVLAD_SCAN_ABOVE */
} ssrvlad_loops_settings;

/* Why a frame closes a loop or does not. */
enum {
  SSRVLAD_ACCEPTED = 0,       /* the probability reaches the threshold */
  SSRVLAD_EMPTY_FRAME = 1,    /* its descriptor is zero */
  SSRVLAD_NO_CANDIDATE = 2,   /* all earlier frames are empty, or it is the first */
  SSRVLAD_TOO_RECENT = 3,     /* fewer than two of them are old enough to be candidates; or, with a
                                 candidate, the place is more probably that of an excluded frame */
  SSRVLAD_AMBIGUOUS = 4,      /* probably at an old place, but not clearly at one of them */
  SSRVLAD_BELOW_THRESHOLD = 5 /* probably at a new place */
};

enum {
  SSRVLAD_PLACES = 5,        /* places in a result, at most */
  SSRVLAD_RADIUS = 5,          /* rows on each side of a row that show the same place */
  SSRVLAD_ROWS = 11,         /* all of these, with the row */
  SSRVLAD_CHANNELS = 16,     /* channels of a stream, at most */
  SSRVLAD_SCAN_ABOVE = 1500 /* old frames above which not all are compared by all channels */
};

/* An earlier frame by its row, and the probability that the place is near it. */
typedef struct ssrvlad_place {
  int64_t row;
  double probability;
} ssrvlad_place;

/* The result of a frame. Rows count from 0 in the order of the frames. */
typedef struct ssrvlad_loop {
  int32_t reason;     /* of the enumeration above */
  int32_t places;     /* of the next field */
  ssrvlad_place best[SSRVLAD_PLACES]; /* the most probable places, best first, for a back end that
                                         verifies them; each of a probability of at least 0.01 */
  int64_t candidate;  /* the most probable old row; -1 without one, and the rest is then 0 */
  double score;       /* its score: a cosine, without the mean of all frames so far */
  double probability; /* that the place is near the candidate, or near frames that closed a loop there */
  int64_t first;      /* of the rows near the candidate, in its stretch */
  int32_t rows;       /* their number */
  double probabilities[SSRVLAD_ROWS]; /* of each of them */
} ssrvlad_loop;

typedef struct ssrvlad_loops ssrvlad_loops;

/* `ssrvlad_loops_new(settings, channels, count)` creates a stream without frames, or returns NULL if a
 * setting or a shape is out of range or memory is short. */
#define ssrvlad_loops_new(...) ssrvlad_loops_new_for(SSRVLAD_INTERFACE, __VA_ARGS__)
SSRVLAD_API ssrvlad_loops *ssrvlad_loops_new_for(int program, const ssrvlad_loops_settings *settings,
                                                 const ssrvlad_loops_channel *channels, int count);
SSRVLAD_API void ssrvlad_loops_free(ssrvlad_loops *loops);

/* Asks for the memory of so many frames at once: until there are more, no frame asks for memory that grows
 * with their number. Returns SSRVLAD_OK, or SSRVLAD_NO_MEMORY, after which the stream is as before. */
SSRVLAD_API int ssrvlad_loops_reserve(ssrvlad_loops *loops, int64_t frames);

/* The number of frames; 0 without a stream. */
SSRVLAD_API int64_t ssrvlad_loops_rows(const ssrvlad_loops *loops);

/* Looks for the place of the next frame among the earlier ones, then stores it. Returns SSRVLAD_OK, or
 * SSRVLAD_WRONG_ARGUMENT if a descriptor cannot be one; the stream is then unchanged.
 *
 * descriptors  of each channel; vectors from one or several anchors, the usual one in the middle.
 * anchors      the number of anchors of each channel, odd, of signs 1; NULL for one of each.
 * stamp        seconds, not less than that of the frame before; NaN if it is not known. Where stamps
 *              pause, and the next view is another, frames are judged as of another sequence.
 * starts       whether the frame is the first of a sequence: another drive, or camera.
 * threads      that share the comparison with many frames. */
SSRVLAD_API int ssrvlad_loops_update(ssrvlad_loops *loops, const void *const *descriptors,
                                     const int64_t *anchors, double stamp, int starts, int threads,
                                     ssrvlad_loop *result);

/* Stores frames that are known, from a database for example, as if they had come, without results: the
 * next frames are compared with them. Let the last hundred or so come by `ssrvlad_loops_update`, and the
 * stream goes on where it was. Returns as above.
 *
 * descriptors  of each channel, of all frames one after another, from the usual anchor.
 * stamps       of each frame; NULL if they are not known.
 * starts       of each frame, as above. */
SSRVLAD_API int ssrvlad_loops_extend(ssrvlad_loops *loops, const void *const *descriptors,
                                     const double *stamps, const uint8_t *starts, int64_t frames);

/* Copies the descriptors of the rows from `first` to before `last` by a channel. */
SSRVLAD_API int ssrvlad_loops_descriptors(const ssrvlad_loops *loops, int channel, int64_t first,
                                          int64_t last, void *descriptors);

/* Fills the present weight of each channel; their sum is 1. */
SSRVLAD_API void ssrvlad_loops_weights(const ssrvlad_loops *loops, double *weights);

#ifdef __cplusplus
}
#endif

#endif
