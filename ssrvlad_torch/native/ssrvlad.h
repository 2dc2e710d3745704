/* SSR-VLAD in C: label map -> place descriptor, on a CPU, without any other library.
 *
 * The numbers are those of the Python package ssrvlad_torch: masks and counts are equal,
 * descriptors agree to 1e-6. Every function may be called from several threads at once.
 */
#ifndef SSRVLAD_H
#define SSRVLAD_H

#include <stdint.h>

#if defined(_WIN32)
#define SSRVLAD_API __declspec(dllexport)
#else
#define SSRVLAD_API __attribute__((visibility("default")))
#endif

#ifdef __cplusplus
extern "C" {
#endif

/* What a function returns if it does not return a count. */
enum {
  SSRVLAD_OK = 0,
  SSRVLAD_NO_MEMORY = -1,
  SSRVLAD_WRONG_ARGUMENT = -2 /* a size, a setting or a label type out of range */
};

enum { SSRVLAD_LAYERS = 8, SSRVLAD_NO_LAYER = 8, SSRVLAD_UNKNOWN = 255 };
enum { SSRVLAD_ZHANG_SUEN = 0, SSRVLAD_GUO_HALL = 1 };
enum { SSRVLAD_SKELETON = 0, SSRVLAD_KEYPOINTS = 1 };
enum { SSRVLAD_RESIDUALS = 0, SSRVLAD_HARMONICS = 1 };
enum { SSRVLAD_VANISHING_COLUMN = 0, SSRVLAD_MIDDLE = 1 };

/* The settings of the method, by the names of SSRVLADConfig. */
typedef struct ssrvlad_settings {
  double opening, closing, hole_area, region_area, radius, inner_radius;
  double spectral_weight, power;
  int32_t working_size; /* 0: the native size */
  int32_t rings, sectors, harmonics, boundary_harmonics;
  int32_t thinning, context, aggregation, anchor; /* of the enumerations above */
} ssrvlad_settings;

/* Ids -> categories: the category of `id` is `categories[origin + id]`, 0 to 7, SSRVLAD_NO_LAYER or
 * SSRVLAD_UNKNOWN. Ids outside the table are unknown. */
typedef struct ssrvlad_table {
  const uint8_t *categories;
  int64_t entries, origin;
} ssrvlad_table;

/* A batch of label maps, one after another, rows from the top. */
typedef struct ssrvlad_labels {
  const void *ids;
  int32_t bytes; /* of an id: 1 (unsigned), or 2, 4, 8 (signed) */
  int64_t images, height, width;
} ssrvlad_labels;

typedef struct ssrvlad_head ssrvlad_head;

/* SHA-256 of the C++ file and this header, one after the other, that the library was built from; empty
 * if the build did not say. */
SSRVLAD_API const char *ssrvlad_source(void);

/* Fills the settings of a preset, "default" or "paper". */
SSRVLAD_API int ssrvlad_preset(const char *name, ssrvlad_settings *settings);

/* A head of the given settings, or NULL if one is out of range or memory is short. It keeps what it
 * needs again: tables, and the working memory of as many threads as used it at once. */
SSRVLAD_API ssrvlad_head *ssrvlad_new(const ssrvlad_settings *settings);
SSRVLAD_API void ssrvlad_free(ssrvlad_head *head);

/* Numbers in a descriptor. */
SSRVLAD_API int64_t ssrvlad_length(const ssrvlad_head *head);

/* The descriptors of a batch, each of length 1 or zeros for an empty image; images are shared among
 * `threads` threads. Returns SSRVLAD_OK, a code above, or how many pixels have an unknown id; the
 * descriptors are then undefined. */
SSRVLAD_API int64_t ssrvlad_describe(ssrvlad_head *head, const ssrvlad_labels *labels,
                                     const ssrvlad_table *table, int threads, float *descriptors);

/* The stages alone, on `images` bit-planes of height x width bytes: bit k of a byte is layer k.
 * Radii and areas are in pixels. Source and target may be the same. */
SSRVLAD_API int ssrvlad_open_and_close(const uint8_t *planes, int64_t images, int64_t height,
                                       int64_t width, int64_t opening, int64_t closing,
                                       uint8_t *target);
SSRVLAD_API int ssrvlad_fill_holes(const uint8_t *planes, int64_t images, int64_t height,
                                   int64_t width, int64_t area, uint8_t *target);
SSRVLAD_API int ssrvlad_drop_regions(const uint8_t *planes, int64_t images, int64_t height,
                                     int64_t width, int64_t area, uint8_t *target);
SSRVLAD_API int ssrvlad_thin(const uint8_t *planes, int64_t images, int64_t height, int64_t width,
                             int thinning, uint8_t *target);
SSRVLAD_API int ssrvlad_keypoints(const uint8_t *skeletons, int64_t images, int64_t height,
                                  int64_t width, uint8_t *end_points, uint8_t *intersections);

/* Categories on the working grid of `rows` x `columns` cells, by majority vote: (images, rows,
 * columns) bytes. Returns as `ssrvlad_describe`. */
SSRVLAD_API int64_t ssrvlad_vote(const ssrvlad_labels *labels, const ssrvlad_table *table,
                                 int64_t rows, int64_t columns, uint8_t *categories);

#ifdef __cplusplus
}
#endif

#endif
