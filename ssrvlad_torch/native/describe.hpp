// Label maps to descriptors, and single stages of the method; see ssrvlad.h. Arguments are valid.

#ifndef SSRVLAD_DESCRIBE_HPP
#define SSRVLAD_DESCRIBE_HPP

#include <cstdint>
#include <memory>
#include <string>

#include "ssrvlad.h"

namespace places {

// Settings, with their tables and the working memory of threads.
class Head {
 public:
  explicit Head(const ssrvlad_settings &settings);
  ~Head();
  std::int64_t length() const;
  // Returns the number of pixels with an unknown id; unless it is 0, the descriptors are undefined.
  std::int64_t describe(const ssrvlad_labels &labels, const ssrvlad_table &table, int threads,
                        float *descriptors);

 private:
  struct State;
  std::unique_ptr<State> state_;
};

// That of `SSRVLADConfig.fingerprint`, 16 hexadecimal digits.
std::string fingerprint_of(const ssrvlad_settings &settings);

std::int64_t vote(const ssrvlad_labels &labels, const ssrvlad_table &table, std::int64_t rows,
                  std::int64_t columns, std::uint8_t *categories);

// Bit-planes of images, one byte a pixel.
struct Planes {
  const std::uint8_t *bytes;
  std::int64_t images, height, width;
};

void open_and_close(const Planes &planes, std::int64_t opening, std::int64_t closing,
                    std::uint8_t *target);
void fill_holes(const Planes &planes, std::int64_t area, std::uint8_t *target);
void drop_regions(const Planes &planes, std::int64_t area, std::uint8_t *target);
void thin(const Planes &planes, int thinning, std::uint8_t *target);
void keypoints(const Planes &skeletons, std::uint8_t *end_points, std::uint8_t *intersections);

}  // namespace places

#endif
