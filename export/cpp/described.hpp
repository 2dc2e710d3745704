// A described frame: what `Place` of place.hpp gives, or another network and the core, and what a map and a
// stream take. Needs neither ONNX Runtime nor zlib.

#pragma once

#include <cstdint>
#include <new>
#include <stdexcept>
#include <string>
#include <vector>

#include <ssrvlad/ssrvlad.h>

namespace ssrvlad {

// The descriptor of a frame; with `export --sweep` the descriptors of all anchors in sequence. All
// zeros: the frame is empty and matches nothing.
struct Described {
  std::vector<float> descriptor;
  std::size_t length = 0;  // of one descriptor
  std::vector<std::uint8_t> features;  // 16 columns x 16 rows x 16 bytes of signs, if the file gives some
  std::vector<float> hog;              // 480 numbers, if the file gives them
};

// Fingerprints of what a file gives: of the settings of the head, of features and of HOG; empty for
// what it does not give. Descriptors of other fingerprints do not compare.
struct Fingerprints {
  std::string descriptor, features, hog;
};

namespace detail {

// Throws what a return code of the core means: std::bad_alloc, or std::runtime_error, which names `what` was refused.
inline void require(int status, const std::string& what) {
  if (status == SSRVLAD_NO_MEMORY) throw std::bad_alloc();
  if (status != SSRVLAD_OK) throw std::runtime_error(what + ": " + ssrvlad_last_error());
}

// A channel of a frame: vectors of one or several anchors, or signs.
struct Channel {
  std::string name, fingerprint;
  std::int32_t kind;
  std::int64_t shape[3];  // of vectors their length, 1, 1; of signs columns, rows, bytes of a cell
  const void* data;
  std::int64_t anchors;

  std::size_t numbers() const { return static_cast<std::size_t>(shape[0] * shape[1] * shape[2]); }
  std::size_t bytes() const { return numbers() * (kind == SSRVLAD_VECTORS ? sizeof(float) : 1); }
};

// How much a channel counts beside others before anything is known of a drive.
inline double trust_of(const std::string& channel) {
  return channel == "features" ? 6 : channel == "hog" ? 2 : 1;
}

// The channels of a frame; `where` names it.
inline std::vector<Channel> channels_of(const std::string& where, const Described& frame, const Fingerprints& model) {
  constexpr std::size_t kSigns = 16 * 16 * 16;
  const auto vectors = [](const char* name, const std::string& fingerprint, const std::vector<float>& numbers,
                          std::size_t length) {
    return Channel{name, fingerprint, SSRVLAD_VECTORS, {static_cast<std::int64_t>(length), 1, 1},
                   numbers.data(), static_cast<std::int64_t>(numbers.size() / length)};
  };
  if (!frame.length || frame.descriptor.size() % frame.length || frame.descriptor.size() / frame.length % 2 == 0 ||
      (!frame.features.empty() && frame.features.size() != kSigns))
    throw std::runtime_error(where + ": expected descriptors of an odd number of anchors, and " +
                             std::to_string(kSigns) + " bytes of features or none");
  std::vector<Channel> channels{vectors("ssr-vlad", model.descriptor, frame.descriptor, frame.length)};
  if (!frame.features.empty())
    channels.push_back({"features", model.features, SSRVLAD_SIGNS, {16, 16, 16}, frame.features.data(), 1});
  if (!frame.hog.empty()) channels.push_back(vectors("hog", model.hog, frame.hog, frame.hog.size()));
  return channels;
}

}  // namespace detail
}  // namespace ssrvlad
