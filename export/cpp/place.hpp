// Places from label maps and photographs: files of `ssrvlad export` and `ssrvlad fuse`.
//
//     ssrvlad::Place place("place.onnx");
//     ssrvlad::Database town("town.npy", place.fingerprint());
//     auto seen = place.describe(pixels, height, width);
//     for (const auto& match : town.match(seen, 5)) std::cout << match.frame << match.score;
//
// Header-only, C++ 17, over the C++ API of ONNX Runtime, and zlib. Every error is a
// std::runtime_error, an Ort::Exception where the runtime raises it. A Place may be used by several
// threads at a time.

#pragma once

#include <onnxruntime_cxx_api.h>
#include <zlib.h>

#include <algorithm>
#include <cctype>
#include <cmath>
#include <cstdint>
#include <fstream>
#include <iostream>
#include <limits>
#include <map>
#include <memory>
#include <numeric>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "npy.hpp"

namespace ssrvlad {

constexpr const char* kFormat = "2";
constexpr float kTolerance = 1e-6F;
// Fraction of a golden image's pixels that may get another label on another runtime, and the least
// cosine of the descriptors of two label maps that differ so little.
constexpr double kMostOtherPixels = 0.01;
constexpr float kLeastCosine = 0.8F;

// What is known about a frame. Of a file of `export --sweep` there are several descriptors, one
// after another, one for each anchor. All zeros: the frame is empty, and matches nothing.
struct Described {
  std::vector<float> descriptor;
  std::size_t length = 0;  // of one descriptor
};

struct Match {
  std::string frame;
  float score;
};

// How the golden pair came out: see `Place::golden`.
struct Golden {
  float difference = 0;     // largest of a descriptor, infinite if a count differs
  double other_pixels = 0;  // fraction with another label than was recorded
  float cosine = 1;         // to the descriptor that is expected

  bool holds() const {
    const bool roughly = other_pixels > 0 && cosine >= kLeastCosine;
    return other_pixels <= kMostOtherPixels && (difference <= kTolerance || roughly);
  }
};

namespace detail {

constexpr std::uint64_t kMostGolden = std::uint64_t{64} << 20;

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

// Reads the JSON of the golden pair: objects of arrays of numbers and of texts without escapes.
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
    const auto found = text_.substr(at_, end - at_);
    at_ = end + 1;
    return found;
  }

  std::int64_t number() {
    std::size_t read = 0;
    std::int64_t found = 0;
    try {
      found = std::stoll(text_.substr(at_, 24), &read);
    } catch (const std::exception&) {
      fail();
    }
    at_ += read;
    return found;
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
  std::uint32_t held = 0;
  int bits = 0;
  for (char letter : text) {
    if (letter == '=') break;
    const auto digit = digits.find(letter);
    if (digit == std::string::npos) Reader::fail();
    held = held << 6 | static_cast<std::uint32_t>(digit);
    bits += 6;
    if (bits < 8) continue;
    bits -= 8;
    bytes.push_back(static_cast<char>(held >> bits & 255));
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
    if (axis < 0 || (axis > 0 && size > kMostGolden / static_cast<std::uint64_t>(axis)))
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
  Tensors found;
  Reader reader(json);
  reader.entries('{', '}', [&] {
    const auto name = reader.text();
    reader.expect(':');
    found.emplace(name, golden_tensor(reader));
  });
  return found;
}

inline float length_of(const float* vector, std::size_t size) {
  return std::sqrt(std::inner_product(vector, vector + size, vector, 0.0F));
}

// A session with what its file says about itself.
class Session {
 public:
  Session(const std::string& path, const Ort::SessionOptions& options)
      : path_(path),
        session_(environment(), std::basic_string<ORTCHAR_T>(path.begin(), path.end()).c_str(),
                 options) {
    if (property("ssrvlad.fingerprint").empty())
      throw std::runtime_error(path + ": no metadata ssrvlad.fingerprint");
    const auto written = property("ssrvlad.format");
    if (written != kFormat)
      throw std::runtime_error(path + ": a file of format " + (written.empty() ? "1" : written) +
                               "; expected " + kFormat + ": export it again");
    if (session_.GetInputCount() != 1)
      throw std::runtime_error(path + ": expected one input, got " +
                               std::to_string(session_.GetInputCount()));
    Ort::AllocatorWithDefaultOptions allocator;
    input_ = session_.GetInputNameAllocated(0, allocator).get();
    const auto given = session_.GetInputTypeInfo(0);
    const auto form = given.GetTensorTypeAndShapeInfo();  // belongs to given
    type_ = form.GetElementType();
    shape_ = form.GetShape();
    if (input_ != "labels" && input_ != "image")
      throw std::runtime_error(path + ": takes " + input_ +
                               "; expected a file of `ssrvlad export --input labels` or `fuse`");
  }

  const std::string& path() const { return path_; }
  const std::string& input() const { return input_; }
  ONNXTensorElementDataType type() const { return type_; }

  // A file of fixed size takes no other.
  void refuse_unless_fits(const std::vector<std::int64_t>& shape) const {
    const char* axes[] = {"images", "rows", "columns"};
    for (std::size_t axis = 0; axis < 3; ++axis)
      if (shape_[axis] > 0 && shape_[axis] != shape[axis])
        throw std::runtime_error(path_ + " takes " + std::to_string(shape_[axis]) + " " + axes[axis] +
                                 ", got " + std::to_string(shape[axis]));
  }

  std::string property(const char* name) const {
    Ort::AllocatorWithDefaultOptions allocator;
    const auto text = session_.GetModelMetadata().LookupCustomMetadataMapAllocated(name, allocator);
    return text ? text.get() : "";
  }

  // The tensors lie in the memory of the CPU, wherever they were made.
  std::vector<Ort::Value> run(const Ort::Value& given, const std::vector<const char*>& names) const {
    const char* input = input_.c_str();
    return session_.Run(Ort::RunOptions{}, &input, &given, 1, names.data(), names.size());
  }

  // Runs the golden pair that is in the file.
  Golden golden() const {
    auto tensors = golden_tensors(property("ssrvlad.golden"));
    if (!tensors.count(input_))
      throw std::runtime_error(path_ + ": no golden pair for input " + input_);
    auto& given = tensors[input_];
    const auto value = value_of(given.bytes.data(), given.bytes.size(), given.shape, given.type);
    std::vector<const char*> names;
    for (const auto& [name, tensor] : tensors)
      if (name != input_) names.push_back(name.c_str());
    const auto found = run(value, names);
    Golden golden;
    for (std::size_t at = 0; at < names.size(); ++at) {
      const auto& expected = tensors[names[at]];
      if (found[at].GetTensorTypeAndShapeInfo().GetShape() != expected.shape)
        return {std::numeric_limits<float>::infinity(), 1, 0};
      compare(names[at], found[at], expected, golden);
    }
    return golden;
  }

  static Ort::Value value_of(const void* data, std::size_t size,
                             const std::vector<std::int64_t>& shape,
                             ONNXTensorElementDataType type) {
    const auto memory = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
    return Ort::Value::CreateTensor(memory, const_cast<void*>(data), size, shape.data(),
                                    shape.size(), type);
  }

 private:
  static const Ort::Env& environment() {
    static const Ort::Env shared(ORT_LOGGING_LEVEL_ERROR, "ssrvlad");
    return shared;
  }

  static void compare(const std::string& name, const Ort::Value& found, const Tensor& expected,
                      Golden& golden) {
    if (name == "descriptor") {
      const float* got = found.GetTensorData<float>();
      const float* wanted = expected.as<float>();
      for (std::size_t at = 0; at < expected.count<float>(); ++at) {
        const float step = std::abs(got[at] - wanted[at]);
        if (!(step <= golden.difference))
          golden.difference = std::isnan(step) ? std::numeric_limits<float>::infinity() : step;
      }
      const auto length = static_cast<std::size_t>(expected.shape.back());
      for (std::size_t at = 0; at < expected.count<float>(); at += length) {
        const float cosine = std::inner_product(got + at, got + at + length, wanted + at, 0.0F);
        if (!(cosine >= golden.cosine)) golden.cosine = std::isnan(cosine) ? 0 : cosine;
      }
      return;
    }
    const char* got = static_cast<const char*>(found.GetTensorRawData());
    const auto width = type_of(name_of(expected.type)).second;
    std::size_t others = 0;
    for (std::size_t at = 0; at < expected.bytes.size(); at += width)
      others += !std::equal(got + at, got + at + width, expected.bytes.data() + at);
    if (name == "labels")
      golden.other_pixels = static_cast<double>(others * width) / expected.bytes.size();
    else if (others)
      golden.difference = std::numeric_limits<float>::infinity();
  }

  std::string path_;
  mutable Ort::Session session_;  // running it changes nothing that can be seen
  std::string input_;
  ONNXTensorElementDataType type_ = ONNX_TENSOR_ELEMENT_DATA_TYPE_UNDEFINED;
  std::vector<std::int64_t> shape_;  // -1 where it takes any
};

}  // namespace detail

// Describes label maps or photographs.
//
// As it is loaded it runs the golden pair that is in every file, and refuses a runtime that gives
// something else, unless `check` is false.
class Place {
 public:
  // One file: the head alone, or with a network before it.
  explicit Place(const std::string& model, const Ort::SessionOptions& options = Ort::SessionOptions{},
                 bool check = true)
      : head_(model, options) {
    if (check) refuse_unless_right();
  }

  // The two files of `ssrvlad fuse --split`: the network where its options say, the head on the
  // CPU. The label map goes from one to the other as it lies in memory.
  Place(const std::string& network, const std::string& head,
        const Ort::SessionOptions& network_options, bool check = true)
      : head_(head, Ort::SessionOptions{}),
        network_(std::make_unique<detail::Session>(network, network_options)) {
    for (const char* name : {"ssrvlad.fingerprint", "ssrvlad.label_space"})
      if (network_->property(name) != head_.property(name))
        throw std::runtime_error(network + " and " + head + " differ in " + name +
                                 ": expected the two files");
    if (network_->input() != "image" || head_.input() != "labels")
      throw std::runtime_error(network + " and " + head + ": expected a network and a head");
    if (check) refuse_unless_right();
  }

  // Descriptors of another fingerprint do not compare.
  std::string fingerprint() const { return head_.property("ssrvlad.fingerprint"); }

  // Whether photographs are described, not label maps.
  bool takes_photographs() const { return first().input() == "image"; }

  // A label map of (height, width) ids, or a photograph of (height, width, 3) in RGB, row after
  // row. Refuses ids outside the label space.
  Described describe(const std::uint8_t* pixels, std::int64_t height, std::int64_t width) const {
    return describe_bytes(pixels, height, width, "uint8");
  }

  // A label map of wide ids.
  Described describe(const std::int32_t* labels, std::int64_t height, std::int64_t width) const {
    return describe_bytes(labels, height, width, "int32");
  }
  Described describe(const std::int64_t* labels, std::int64_t height, std::int64_t width) const {
    return describe_bytes(labels, height, width, "int64");
  }

  // Runs the golden pair of the file, or of both. Where the network labels some pixels of a golden
  // image otherwise, the descriptor of one file is another too, and only a gross fault of the head
  // shows; of two files the head is always compared exactly.
  Golden golden() const {
    auto golden = head_.golden();
    if (network_ && golden.holds()) golden.other_pixels = network_->golden().other_pixels;
    return golden;
  }

 private:
  const detail::Session& first() const { return network_ ? *network_ : head_; }

  void refuse_unless_right() const {
    const auto found = golden();
    if (found.holds()) return;
    throw std::runtime_error(
        first().path() + " is computed wrong here: the golden pair differs by " +
        std::to_string(found.difference) + ", " + std::to_string(100 * found.other_pixels) +
        " % of its labels are others");
  }

  Described describe_bytes(const void* data, std::int64_t height, std::int64_t width,
                           const char* dtype) const {
    const auto [type, bytes] = detail::type_of(dtype);
    if (type != first().type())
      throw std::runtime_error(first().path() + " takes " + detail::name_of(first().type()) +
                               ", got " + dtype);
    if (height < 1 || width < 1) throw std::runtime_error("expected at least one pixel");
    std::vector<std::int64_t> shape{1, height, width};
    first().refuse_unless_fits(shape);
    if (takes_photographs()) shape.push_back(3);
    const auto size = static_cast<std::size_t>(height * width) * bytes * (takes_photographs() ? 3 : 1);
    const auto given = detail::Session::value_of(data, size, shape, type);
    const std::vector<const char*> names{"descriptor", "unknown"};
    std::vector<Ort::Value> labels;
    if (network_) labels = network_->run(given, {"labels"});
    const auto found = head_.run(network_ ? labels[0] : given, names);
    const auto unknown = found[1].GetTensorData<std::int64_t>()[0];
    if (unknown > 0)
      throw std::runtime_error(std::to_string(unknown) +
                               " pixels have an id outside the label space");
    Described described;
    const auto form = found[0].GetTensorTypeAndShapeInfo();
    const float* numbers = found[0].GetTensorData<float>();
    described.descriptor.assign(numbers, numbers + form.GetElementCount());
    for (const float number : described.descriptor)
      if (!std::isfinite(number))
        throw std::runtime_error("the frame is too wide, or has too many keypoints, for such a file");
    described.length = static_cast<std::size_t>(form.GetShape().back());
    return described;
  }

  detail::Session head_;
  std::unique_ptr<detail::Session> network_;
};

// Descriptors of reference frames as `ssrvlad db export --format npy` writes them: FILE.npy,
// FILE.npy.frames.txt and FILE.npy.fingerprint.txt.
class Database {
 public:
  Database(const std::string& path, const std::string& fingerprint) : array_(npy::load(path)) {
    if (array_.dtype != "<f4" || array_.shape.size() != 2)
      throw std::runtime_error(path + ": expected an (R, D) array of float32");
    std::string own;
    if (!(std::ifstream(path + ".fingerprint.txt") >> own))
      std::cerr << path << " carries no fingerprint: whether it fits the model cannot be checked\n";
    else if (own != fingerprint)
      throw std::runtime_error(path + " has fingerprint " + own + ", the model " + fingerprint +
                               ": they do not compare");
    std::ifstream names(path + ".frames.txt");
    for (std::string line; std::getline(names, line);) frames_.push_back(line);
    if (frames_.size() != static_cast<std::size_t>(array_.shape[0]))
      throw std::runtime_error(path + ".frames.txt: expected " + std::to_string(array_.shape[0]) +
                               " ids, got " + std::to_string(frames_.size()));
  }

  std::size_t size() const { return frames_.size(); }

  // The frames with the highest cosines (Eq. 4), best first, the earlier of equals. Of several
  // anchors the best counts.
  std::vector<Match> match(const Described& query, std::size_t top) const {
    const auto length = static_cast<std::size_t>(array_.shape[1]);
    if (query.length != length)
      throw std::runtime_error("expected a database of " + std::to_string(query.length) +
                               " numbers a frame, got " + std::to_string(length));
    std::vector<std::pair<float, std::size_t>> found;
    for (std::size_t row = 0; row < size(); ++row) {
      const float* reference = array_.as<float>() + row * length;
      const float own = detail::length_of(reference, length);
      float best = -2;
      for (const float* one = query.descriptor.data();
           one < query.descriptor.data() + query.descriptor.size(); one += length) {
        const float other = detail::length_of(one, length);
        if (own > 0 && other > 0)
          best = std::max(best, std::inner_product(one, one + length, reference, 0.0F) / own / other);
      }
      if (best > -2) found.emplace_back(best, row);
    }
    const auto last = found.begin() + static_cast<std::ptrdiff_t>(std::min(top, found.size()));
    std::partial_sort(found.begin(), last, found.end(), [](const auto& a, const auto& b) {
      return a.first != b.first ? a.first > b.first : a.second < b.second;
    });
    std::vector<Match> matches;
    for (auto each = found.begin(); each != last; ++each)
      matches.push_back({frames_[each->second], each->first});
    return matches;
  }

 private:
  npy::Array array_;
  std::vector<std::string> frames_;
};

}  // namespace ssrvlad
