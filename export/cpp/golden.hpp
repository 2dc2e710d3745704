// The golden pair in the metadata of a file: an input with its outputs. Part of `place.hpp`.

#pragma once

#include <onnxruntime_cxx_api.h>
#include <zlib.h>

#include <bitset>
#include <cstdint>
#include <map>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "npy.hpp"

namespace ssrvlad {

constexpr float kTolerance = 1e-6F;
// Fraction of a golden image's pixels whose label may differ on another runtime, and the smallest
// cosine of the descriptors of two label maps that differ so little.
constexpr double kMaxOtherPixels = 0.01;
constexpr float kMinCosine = 0.8F;
// Fraction of the signs of a golden image's features that may differ.
constexpr double kMaxOtherSigns = 0.01;

// The result of a golden pair: see `Place::golden`.
struct Golden {
  float difference = 0;     // largest difference of the descriptor, infinite if a count differs
  double other_pixels = 0;  // fraction of pixels with another label than recorded
  float cosine = 1;         // cosine to the expected descriptor
  double other_signs = 0;   // fraction of other signs of the features
  float hog = 0;            // largest difference of HOG

  bool holds() const {
    const bool is_similar = other_pixels > 0 && cosine >= kMinCosine;
    return other_pixels <= kMaxOtherPixels && other_signs <= kMaxOtherSigns && hog <= kTolerance &&
           (difference <= kTolerance || is_similar);
  }
};

namespace detail {

constexpr std::uint64_t kMaxGoldenBytes = std::uint64_t{64} << 20;

struct Tensor {
  ONNXTensorElementDataType type = ONNX_TENSOR_ELEMENT_DATA_TYPE_UNDEFINED;
  std::vector<std::int64_t> shape;
  std::vector<char> bytes;

  template <typename T>
  const T* as() const { return reinterpret_cast<const T*>(bytes.data()); }

  template <typename T>
  std::size_t count() const { return bytes.size() / sizeof(T); }
};

using Tensors = std::map<std::string, Tensor>;

// The number of bits that differ.
inline std::size_t different(const std::uint8_t* one, const std::uint8_t* other, std::size_t size) {
  std::size_t count = 0;
  for (std::size_t at = 0; at < size; ++at) count += std::bitset<8>(one[at] ^ other[at]).count();
  return count;
}

[[noreturn]] inline void refuse_golden() { throw std::runtime_error("the golden pair is damaged"); }

// Takes what stands between two marks of a text, from left to right.
class Cursor {
 public:
  explicit Cursor(const std::string& text) : text_(text) {}

  bool sees(const char* mark) const { return text_.find(mark, at_) != text_.npos; }

  std::string between(const std::string& open, const std::string& close) {
    const auto mark = text_.find(open, at_), first = mark + open.size();
    const auto last = mark == text_.npos ? mark : text_.find(close, first);
    if (last == text_.npos) refuse_golden();
    at_ = last + close.size();
    return text_.substr(first, last - first);
  }

 private:
  const std::string& text_;
  std::size_t at_ = 0;
};

inline std::string from_base64(const std::string& text) {
  static const std::string digits =
      "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
  std::string bytes;
  std::uint32_t buffer = 0;
  int bits = 0;
  for (char letter : text) {
    if (letter == '=') break;
    const auto digit = digits.find(letter);
    if (digit == std::string::npos) refuse_golden();
    buffer = buffer << 6 | static_cast<std::uint32_t>(digit);
    bits += 6;
    if (bits < 8) continue;
    bits -= 8;
    bytes.push_back(static_cast<char>(buffer >> bits & 255));
  }
  return bytes;
}

inline std::pair<ONNXTensorElementDataType, std::size_t> type_of(const std::string& dtype) {
  if (dtype == "uint8") return {ONNX_TENSOR_ELEMENT_DATA_TYPE_UINT8, 1};
  if (dtype == "int32") return {ONNX_TENSOR_ELEMENT_DATA_TYPE_INT32, 4};
  if (dtype == "int64") return {ONNX_TENSOR_ELEMENT_DATA_TYPE_INT64, 8};
  if (dtype == "float32") return {ONNX_TENSOR_ELEMENT_DATA_TYPE_FLOAT, 4};
  refuse_golden();
}

inline const char* name_of(ONNXTensorElementDataType type) {
  if (type == ONNX_TENSOR_ELEMENT_DATA_TYPE_UINT8) return "uint8";
  return type == ONNX_TENSOR_ELEMENT_DATA_TYPE_INT32 ? "int32" : "int64";
}

inline Tensor tensor_of(const std::string& data, const std::string& dtype, const std::string& shape) {
  const auto [type, width] = type_of(dtype);
  Tensor tensor{type, npy::lengths(shape), {}};
  std::uint64_t size = width;
  for (const auto axis : tensor.shape) {
    if (axis > 0 && size > kMaxGoldenBytes / static_cast<std::uint64_t>(axis))
      throw std::runtime_error("the golden pair is larger than 64 MiB");
    size *= static_cast<std::uint64_t>(axis);
  }
  tensor.bytes.resize(size);
  const auto compressed = from_base64(data);
  uLongf length = size;
  if (uncompress(reinterpret_cast<Bytef*>(tensor.bytes.data()), &length,
                 reinterpret_cast<const Bytef*>(compressed.data()), compressed.size()) != Z_OK ||
      length != size)
    refuse_golden();
  return tensor;
}

// The arrays in the JSON that `ssrvlad export` writes: {"name": {"data": "...", "dtype": "uint8", "shape": [2, 9]}}.
inline Tensors golden_tensors(const std::string& json) {
  Tensors tensors;
  for (Cursor cursor(json); cursor.sees("\"data\"");) {
    const auto name = cursor.between("\"", "\": {"), data = cursor.between("\"data\": \"", "\"");
    const auto dtype = cursor.between("\"dtype\": \"", "\""), shape = cursor.between("\"shape\": [", "]");
    tensors.emplace(name, tensor_of(data, dtype, shape));
  }
  return tensors;
}

}  // namespace detail
}  // namespace ssrvlad
