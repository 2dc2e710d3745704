// Descriptors of label maps and photographs with files of `ssrvlad export` and `ssrvlad fuse`.
//
//     ssrvlad::Place place("place.onnx");
//     auto seen = place.describe(pixels, height, width);
//
// map.hpp finds them in a database. C++17; needs the C++ API of ONNX Runtime, and zlib. Errors
// are std::runtime_error, or Ort::Exception from the runtime. Several threads may use one Place at a time.

#pragma once

#include <onnxruntime_cxx_api.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <memory>
#include <numeric>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "described.hpp"
#include "golden.hpp"

namespace ssrvlad {

constexpr const char* kFormat = "2";

namespace detail {

// A session and the metadata of its file.
class Session {
 public:
  Session(const std::string& path, const Ort::SessionOptions& options)
      : path_(path),
        session_(environment(), std::basic_string<ORTCHAR_T>(path.begin(), path.end()).c_str(),
                 options) {
    if (property("ssrvlad.fingerprint").empty())
      throw std::runtime_error(path + ": no metadata ssrvlad.fingerprint");
    const auto format = property("ssrvlad.format");
    if (format != kFormat)
      throw std::runtime_error(path + ": a file of format " + (format.empty() ? "1" : format) +
                               "; expected " + kFormat + ": export it again");
    if (session_.GetInputCount() != 1)
      throw std::runtime_error(path + ": expected one input, got " +
                               std::to_string(session_.GetInputCount()));
    Ort::AllocatorWithDefaultOptions allocator;
    input_ = session_.GetInputNameAllocated(0, allocator).get();
    const auto info = session_.GetInputTypeInfo(0);
    const auto tensor = info.GetTensorTypeAndShapeInfo();  // belongs to info
    type_ = tensor.GetElementType();
    shape_ = tensor.GetShape();
    if (input_ != "labels" && input_ != "image")
      throw std::runtime_error(path + ": takes " + input_ +
                               "; expected a file of `ssrvlad export --input labels` or `fuse`");
  }

  const std::string& path() const { return path_; }
  const std::string& input() const { return input_; }
  ONNXTensorElementDataType type() const { return type_; }

  // Refuses another size than that of a file of fixed size.
  void require_shape(const std::vector<std::int64_t>& shape) const {
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

  // The outputs are in CPU memory, for any provider.
  std::vector<Ort::Value> run(const Ort::Value& value, const std::vector<const char*>& names) const {
    const char* input = input_.c_str();
    return session_.Run(Ort::RunOptions{}, &input, &value, 1, names.data(), names.size());
  }

  // Runs the golden pair of the file.
  Golden golden() const {
    Tensors tensors;
    try {
      tensors = golden_tensors(property("ssrvlad.golden"));
    } catch (const std::runtime_error& error) {
      throw std::runtime_error(path_ + ": " + error.what());
    }
    if (!tensors.count(input_) || tensors.size() < 2 || (input_ == "labels" && !tensors.count("descriptor")))
      throw std::runtime_error(path_ + ": no golden pair for input " + input_);
    auto& input = tensors[input_];
    const auto value = value_of(input.bytes.data(), input.bytes.size(), input.shape, input.type);
    std::vector<const char*> names;
    for (const auto& [name, tensor] : tensors)
      if (name != input_) names.push_back(name.c_str());
    const auto outputs = run(value, names);
    Golden golden;
    for (std::size_t at = 0; at < names.size(); ++at) {
      const auto& expected = tensors[names[at]];
      const auto info = outputs[at].GetTensorTypeAndShapeInfo();
      if (info.GetShape() != expected.shape || info.GetElementType() != expected.type)
        return {std::numeric_limits<float>::infinity(), 1, 0};
      compare(names[at], outputs[at], expected, golden);
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

  static void compare(const std::string& name, const Ort::Value& output, const Tensor& expected,
                      Golden& golden) {
    if (name == "descriptor" || name == "hog") {
      const float* got = output.GetTensorData<float>();
      const float* recorded = expected.as<float>();
      float& largest = name == "hog" ? golden.hog : golden.difference;
      for (std::size_t at = 0; at < expected.count<float>(); ++at) {
        const float step = std::abs(got[at] - recorded[at]);
        if (!(step <= largest))
          largest = std::isnan(step) ? std::numeric_limits<float>::infinity() : step;
      }
      if (name == "hog") return;
      const auto length = static_cast<std::size_t>(expected.shape.back());
      for (std::size_t at = 0; at < expected.count<float>(); at += length) {
        const float cosine = std::inner_product(got + at, got + at + length, recorded + at, 0.0F);
        if (!(cosine >= golden.cosine)) golden.cosine = std::isnan(cosine) ? 0 : cosine;
      }
      return;
    }
    if (name == "features") {
      const auto size = expected.bytes.size();
      if (size != output.GetTensorTypeAndShapeInfo().GetElementCount()) refuse_golden();
      const auto bits =
          different(output.GetTensorData<std::uint8_t>(), expected.as<std::uint8_t>(), size);
      golden.other_signs = static_cast<double>(bits) / static_cast<double>(8 * size);
      return;
    }
    const char* got = static_cast<const char*>(output.GetTensorRawData());
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
  mutable Ort::Session session_;  // Run is thread-safe, but not const
  std::string input_;
  ONNXTensorElementDataType type_ = ONNX_TENSOR_ELEMENT_DATA_TYPE_UNDEFINED;
  std::vector<std::int64_t> shape_;  // -1 for a dynamic axis
};

}  // namespace detail

// Describes label maps or photographs.
//
// The constructor runs the golden pair of every file and refuses a runtime that gives other
// outputs, unless `check` is false.
class Place {
 public:
  // One file: the head alone, or a network and the head.
  explicit Place(const std::string& model, const Ort::SessionOptions& options = Ort::SessionOptions{},
                 bool check = true)
      : head_(model, options) {
    if (check) require_golden();
  }

  // The two files of `ssrvlad fuse --split`: the network with its options, the head on the CPU. The
  // label map is not copied between them.
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
    if (check) require_golden();
  }

  Fingerprints fingerprints() const {
    return {head_.property("ssrvlad.fingerprint"), first().property("ssrvlad.features"),
            first().property("ssrvlad.hog")};
  }

  // Whether it takes photographs, not label maps.
  bool takes_photographs() const { return first().input() == "image"; }

  // A label map of (height, width) ids, or a photograph of (height, width, 3) bytes in RGB, row by
  // row. Throws for ids outside the label space.
  Described describe(const std::uint8_t* pixels, std::int64_t height, std::int64_t width) const {
    return describe_bytes(pixels, height, width, "uint8");
  }

  // A label map of 32-bit or 64-bit ids.
  Described describe(const std::int32_t* labels, std::int64_t height, std::int64_t width) const {
    return describe_bytes(labels, height, width, "int32");
  }
  Described describe(const std::int64_t* labels, std::int64_t height, std::int64_t width) const {
    return describe_bytes(labels, height, width, "int64");
  }

  // Runs the golden pair of the file, or of both. Where some labels of a golden image differ, the
  // descriptor of a single file differs too, so only a large error of the head is found; of two
  // files the head is always compared exactly.
  Golden golden() const {
    auto golden = head_.golden();
    if (!network_ || !golden.holds()) return golden;
    const auto network = network_->golden();
    golden.other_pixels = network.other_pixels;
    golden.other_signs = network.other_signs;
    golden.hog = network.hog;
    return golden;
  }

 private:
  const detail::Session& first() const { return network_ ? *network_ : head_; }

  void require_golden() const {
    const auto result = golden();
    if (result.holds()) return;
    const auto& wrong = network_ && head_.golden().holds() ? *network_ : head_;
    throw std::runtime_error(
        wrong.path() + " is computed wrong here: the golden pair differs by " +
        std::to_string(result.difference) + ", and " + std::to_string(100 * result.other_pixels) +
        " % of its labels and " + std::to_string(100 * result.other_signs) +
        " % of its features differ, and HOG by " + std::to_string(result.hog));
  }

  Described describe_bytes(const void* data, std::int64_t height, std::int64_t width,
                           const char* dtype) const {
    const auto [type, bytes] = detail::type_of(dtype);
    if (type != first().type())
      throw std::runtime_error(first().path() + " takes " + detail::name_of(first().type()) +
                               ", got " + dtype);
    if (height < 1 || width < 1) throw std::runtime_error("expected at least one pixel");
    std::vector<std::int64_t> shape{1, height, width};
    first().require_shape(shape);
    if (takes_photographs()) shape.push_back(3);
    const auto size = static_cast<std::size_t>(height * width) * bytes * (takes_photographs() ? 3 : 1);
    const auto input = detail::Session::value_of(data, size, shape, type);
    std::vector<const char*> names{"descriptor", "unknown"}, of_network{"labels"};
    const auto given = fingerprints();
    auto& of_pictures = network_ ? of_network : names;
    if (!given.features.empty()) of_pictures.push_back("features");
    if (!given.hog.empty()) of_pictures.push_back("hog");
    std::vector<Ort::Value> seen;
    if (network_) seen = network_->run(input, of_network);
    const auto outputs = head_.run(network_ ? seen[0] : input, names);
    const auto unknown = outputs[1].GetTensorData<std::int64_t>()[0];
    if (unknown > 0)
      throw std::runtime_error(std::to_string(unknown) +
                               " pixels have an id outside the label space");
    Described described;
    const auto info = outputs[0].GetTensorTypeAndShapeInfo();
    const float* numbers = outputs[0].GetTensorData<float>();
    described.descriptor.assign(numbers, numbers + info.GetElementCount());
    for (const float number : described.descriptor)
      if (!std::isfinite(number))
        throw std::runtime_error(
            "the frame is too wide, or has too many keypoints, for an exported file");
    described.length = static_cast<std::size_t>(info.GetShape().back());
    const auto& channels = network_ ? seen : outputs;
    if (!given.hog.empty()) {
      const float* histograms = channels.back().GetTensorData<float>();
      const auto count = channels.back().GetTensorTypeAndShapeInfo().GetElementCount();
      described.hog.assign(histograms, histograms + count);
    }
    if (given.features.empty()) return described;
    const auto& signs = channels[network_ ? 1 : 2];
    const auto* first_byte = signs.GetTensorData<std::uint8_t>();
    const auto count = signs.GetTensorTypeAndShapeInfo().GetElementCount();
    described.features.assign(first_byte, first_byte + count);
    if (std::all_of(first_byte, first_byte + count, [](auto byte) { return byte == 0; }))
      throw std::runtime_error(
          "the activations of the network are not finite, or the same everywhere");
    return described;
  }

  detail::Session head_;
  std::unique_ptr<detail::Session> network_;
};

}  // namespace ssrvlad
