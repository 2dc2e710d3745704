// The golden pair in the metadata of a file: an input with its outputs. Part of `place.hpp`.

#pragma once

#include <onnxruntime_cxx_api.h>
#include <zlib.h>

#include <bitset>
#include <cctype>
#include <cstdint>
#include <map>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

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

// Reads the JSON of the golden pair: objects, arrays of numbers, and strings without escapes.
class Reader {
 public:
  explicit Reader(const std::string& text) : text_(text) {}

  bool accept(char letter) {
    while (at_ < text_.size() && std::isspace(static_cast<unsigned char>(text_[at_]))) ++at_;
    if (at_ >= text_.size() || text_[at_] != letter) return false;
    ++at_;
    return true;
  }

  void expect(char letter) {
    if (!accept(letter)) fail();
  }

  std::string text() {
    expect('"');
    const auto end = text_.find('"', at_);
    if (end == std::string::npos) fail();
    const auto content = text_.substr(at_, end - at_);
    at_ = end + 1;
    return content;
  }

  std::int64_t number() {
    std::size_t length = 0;
    std::int64_t value = 0;
    try {
      value = std::stoll(text_.substr(at_, 24), &length);
    } catch (const std::exception&) {
      fail();
    }
    at_ += length;
    return value;
  }

  template <typename Entry>
  void entries(char open, char close, const Entry& entry) {
    expect(open);
    if (accept(close)) return;
    do entry();
    while (accept(','));
    expect(close);
  }

  [[noreturn]] static void fail() { throw std::runtime_error("the golden pair is damaged"); }

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
    if (digit == std::string::npos) Reader::fail();
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
  Reader::fail();
}

inline const char* name_of(ONNXTensorElementDataType type) {
  if (type == ONNX_TENSOR_ELEMENT_DATA_TYPE_UINT8) return "uint8";
  return type == ONNX_TENSOR_ELEMENT_DATA_TYPE_INT32 ? "int32" : "int64";
}

inline Tensor golden_tensor(Reader& reader) {
  Tensor tensor;
  std::string data, dtype;
  reader.entries('{', '}', [&] {
    const auto key = reader.text();
    reader.expect(':');
    if (key == "shape")
      reader.entries('[', ']', [&] { tensor.shape.push_back(reader.number()); });
    else
      (key == "data" ? data : dtype) = reader.text();
  });
  const auto [type, width] = type_of(dtype);
  std::uint64_t size = width;
  for (const auto axis : tensor.shape) {
    if (axis < 0 || (axis > 0 && size > kMaxGoldenBytes / static_cast<std::uint64_t>(axis)))
      throw std::runtime_error("the golden pair is larger than 64 MiB");
    size *= static_cast<std::uint64_t>(axis);
  }
  tensor.type = type;
  tensor.bytes.resize(size);
  const auto compressed = from_base64(data);
  uLongf length = size;
  if (uncompress(reinterpret_cast<Bytef*>(tensor.bytes.data()), &length,
                 reinterpret_cast<const Bytef*>(compressed.data()), compressed.size()) != Z_OK ||
      length != size)
    Reader::fail();
  return tensor;
}

inline Tensors golden_tensors(const std::string& json) {
  Tensors tensors;
  Reader reader(json);
  reader.entries('{', '}', [&] {
    const auto name = reader.text();
    reader.expect(':');
    tensors.emplace(name, golden_tensor(reader));
  });
  return tensors;
}

}  // namespace detail
}  // namespace ssrvlad
