// Label maps to descriptors; see ssrvlad.h. Arguments are valid.

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

}  // namespace places

#endif
