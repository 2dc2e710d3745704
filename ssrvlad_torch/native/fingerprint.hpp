// The fingerprint of settings.

#ifndef SSRVLAD_FINGERPRINT_HPP
#define SSRVLAD_FINGERPRINT_HPP

#include <string>

#include "ssrvlad.h"

namespace places {

// That of `SSRVLADConfig.fingerprint`, 16 hexadecimal digits.
std::string fingerprint_of(const ssrvlad_settings &settings);

}  // namespace places

#endif
