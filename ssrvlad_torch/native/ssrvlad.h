/* SSR-VLAD in C: label map -> place descriptor, on a CPU, without any other library.
 *
 * The results are those of the Python package ssrvlad_torch: masks and counts are equal,
 * descriptors agree to 1e-6. All functions are thread-safe.
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

/* Return codes of functions; a positive return value is a count. */
enum {
  SSRVLAD_OK = 0,
  SSRVLAD_NO_MEMORY = -1,
  SSRVLAD_WRONG_ARGUMENT = -2 /* a size, a setting or a label type out of range */
};

/* Why the last call of this thread failed that did, in a line: "rings: expected 1 to 64, got 0", or "not
 * enough memory". Functions that create something return NULL for either. */
SSRVLAD_API const char *ssrvlad_last_error(void);

enum { SSRVLAD_LAYERS = 8, SSRVLAD_NO_LAYER = 8, SSRVLAD_UNKNOWN = 255 };
enum { SSRVLAD_ZHANG_SUEN = 0, SSRVLAD_GUO_HALL = 1 };
enum { SSRVLAD_SKELETON = 0, SSRVLAD_KEYPOINTS = 1 };
enum { SSRVLAD_RESIDUALS = 0, SSRVLAD_HARMONICS = 1 };
enum { SSRVLAD_VANISHING_COLUMN = 0, SSRVLAD_MIDDLE = 1 };

/* Kinds of descriptors: float numbers of length 1, or zeros where nothing is seen; and bits of cells,
 * eight in a byte. */
enum { SSRVLAD_VECTORS = 0, SSRVLAD_SIGNS = 1, SSRVLAD_SCORES = 2 };

/* The settings of the method, with the names of SSRVLADConfig. */
typedef struct ssrvlad_settings {
  double opening, closing, hole_area, region_area, radius, inner_radius;
  double spectral_weight, power;
  int32_t working_size; /* 0: native size */
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

/* The number of the interface of these headers. It rises with each change that programs must be compiled
 * again for; the function returns that of the library. What creates something is a macro that gives the
 * library this number: `ssrvlad_new(&settings)`. The library refuses another one. */
#define SSRVLAD_INTERFACE 5
SSRVLAD_API int ssrvlad_interface(void);

/* SHA-256 of the C++ files, in the order of their names, from which the library was built; empty if
 * the build did not define it. */
SSRVLAD_API const char *ssrvlad_source(void);

/* What the core uses of this processor: "AVX-512", "AVX2", "SSE2", "NEON", "SIMD128" or "no SIMD". */
SSRVLAD_API const char *ssrvlad_simd(void);

/* Fills the settings of a preset, "default" or "paper". */
SSRVLAD_API int ssrvlad_preset(const char *name, ssrvlad_settings *settings);

/* `ssrvlad_new(settings)` creates a head, or returns NULL if a setting is out of range or memory is short.
 * It keeps tables and the working memory of its threads for later calls. */
#define ssrvlad_new(...) ssrvlad_new_for(SSRVLAD_INTERFACE, __VA_ARGS__)
SSRVLAD_API ssrvlad_head *ssrvlad_new_for(int program, const ssrvlad_settings *settings);
SSRVLAD_API void ssrvlad_free(ssrvlad_head *head);

/* The length of a descriptor; SSRVLAD_WRONG_ARGUMENT without a head. */
SSRVLAD_API int64_t ssrvlad_length(const ssrvlad_head *head);

/* The fingerprint of the settings, that of `SSRVLADConfig` and of databases: descriptors can be compared
 * only if theirs are equal. 16 characters that belong to the head; none without a head. */
SSRVLAD_API const char *ssrvlad_fingerprint(const ssrvlad_head *head);

/* Computes the descriptors of a batch, each with norm 1, or zeros for an empty image; `threads`
 * threads share the images. Returns SSRVLAD_OK, or the number of pixels with an unknown id, or a
 * negative code; unless SSRVLAD_OK, the descriptors are undefined. */
SSRVLAD_API int64_t ssrvlad_describe(ssrvlad_head *head, const ssrvlad_labels *labels,
                                     const ssrvlad_table *table, int threads, float *descriptors);

#ifdef __cplusplus
}
#endif

#endif
