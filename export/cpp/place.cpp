// Describes a label map with a file of `ssrvlad export`, or a photograph with one of `ssrvlad
// fuse`, and finds it in an exported database.
//
//     place head.onnx map.npy [town.npy [TOP]]
//     place place.onnx photo.ppm [town.npy [TOP]]
//
// A map is an (H, W) .npy array of uint8 or int64, or a binary PGM of 8 bits; a photograph an
// (H, W, 3) .npy array of uint8 in RGB, or a binary PPM of 8 bits. The database is
// what `ssrvlad db export --format npy` writes. Exit code 0 for success, 2 for wrong use or bad
// input, which one line on stderr names.

#include <onnxruntime_cxx_api.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <iostream>
#include <numeric>
#include <string>
#include <utility>
#include <vector>

#include "npy.hpp"

namespace {

using Vector = std::vector<float>;
using Candidate = std::pair<float, std::size_t>;  // score and row

struct Described {
  Vector descriptor;
  std::vector<std::int64_t> keypoints;
  std::int64_t unknown;
};

npy::Array load_netpbm(const std::string& path, bool colour) {
  std::ifstream file(path, std::ios::binary);
  std::string magic;
  std::int64_t width = 0, height = 0, highest = 0;
  if (!(file >> magic >> width >> height >> highest) || magic != (colour ? "P6" : "P5") || highest > 255 ||
      width < 1 || height < 1)
    throw std::runtime_error(path + ": expected a binary " + (colour ? "PPM" : "PGM") +
                             " of 8 bits without comments");
  file.get();
  npy::Array map{"|u1", {height, width}, std::vector<char>(width * height * (colour ? 3 : 1))};
  if (colour) map.shape.push_back(3);
  if (!file.read(map.bytes.data(), static_cast<std::streamsize>(map.bytes.size())))
    throw std::runtime_error(path + ": ends too early");
  return map;
}

bool ends_with(const std::string& text, const std::string& end) {
  return text.size() >= end.size() &&
         text.compare(text.size() - end.size(), end.size(), end) == 0;
}

npy::Array load_photo(const std::string& path) {
  auto photo = ends_with(path, ".ppm") ? load_netpbm(path, true) : npy::load(path);
  if (photo.shape.size() != 3 || photo.size() == 0 || photo.shape[2] != 3 || photo.dtype != "|u1")
    throw std::runtime_error(path + ": expected an (H, W, 3) photograph of uint8, got " +
                             std::to_string(photo.shape.size()) + " axes of " + photo.dtype);
  return photo;
}

npy::Array load_labels(const std::string& path) {
  auto map = ends_with(path, ".pgm") ? load_netpbm(path, false) : npy::load(path);
  if (map.shape.size() != 2 || map.size() == 0 || (map.dtype != "|u1" && map.dtype != "<i8"))
    throw std::runtime_error(path + ": expected an (H, W) map of uint8 or int64, got " +
                             std::to_string(map.shape.size()) + " axes of " + map.dtype);
  return map;
}

class Head {
 public:
  explicit Head(const std::string& path)
      : session_(environment_, std::basic_string<ORTCHAR_T>(path.begin(), path.end()).c_str(),
                 Ort::SessionOptions{}) {
    const auto input = session_.GetInputTypeInfo(0);
    const auto given = input.GetTensorTypeAndShapeInfo();  // belongs to input
    const auto type = given.GetElementType();
    photos_ = given.GetShape().size() == 4 && type == ONNX_TENSOR_ELEMENT_DATA_TYPE_UINT8;
    if (session_.GetInputCount() != 1 || (given.GetShape().size() != 3 && !photos_))
      throw std::runtime_error(path +
                               ": expected a file of `ssrvlad export --input labels` or `fuse`");
    wide_ = type == ONNX_TENSOR_ELEMENT_DATA_TYPE_INT64;
    fingerprint_ = property("ssrvlad.fingerprint");
    if (fingerprint_.empty()) throw std::runtime_error(path + ": no metadata ssrvlad.fingerprint");
  }

  // Descriptors of another fingerprint do not compare.
  const std::string& fingerprint() const { return fingerprint_; }

  // Whether the file takes photographs, not label maps.
  bool takes_photos() const { return photos_; }

  Described describe(npy::Array& map) {
    if ((map.dtype == "<i8") != wide_)
      throw std::runtime_error("the graph takes " + std::string(wide_ ? "int64" : "uint8") +
                               " labels, got " + map.dtype);
    std::vector<std::int64_t> shape{1};
    shape.insert(shape.end(), map.shape.begin(), map.shape.end());
    const auto type =
        wide_ ? ONNX_TENSOR_ELEMENT_DATA_TYPE_INT64 : ONNX_TENSOR_ELEMENT_DATA_TYPE_UINT8;
    const auto memory = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
    const auto input = Ort::Value::CreateTensor(memory, map.bytes.data(), map.bytes.size(),
                                                shape.data(), shape.size(), type);
    const char* inputs[] = {photos_ ? "image" : "labels"};
    const char* outputs[] = {"descriptor", "keypoints", "unknown"};
    const auto found = session_.Run(Ort::RunOptions{}, inputs, &input, 1, outputs, 3);
    return {values<float>(found[0]), values<std::int64_t>(found[1]),
            values<std::int64_t>(found[2])[0]};
  }

 private:
  std::string property(const char* name) {
    Ort::AllocatorWithDefaultOptions allocator;
    const auto text = session_.GetModelMetadata().LookupCustomMetadataMapAllocated(name, allocator);
    return text ? text.get() : "";
  }

  template <typename T>
  static std::vector<T> values(const Ort::Value& tensor) {
    const T* first = tensor.GetTensorData<T>();
    return {first, first + tensor.GetTensorTypeAndShapeInfo().GetElementCount()};
  }

  Ort::Env environment_{ORT_LOGGING_LEVEL_ERROR, "ssrvlad"};
  Ort::Session session_;
  bool wide_ = false;
  bool photos_ = false;
  std::string fingerprint_;
};

float length_of(const float* vector, std::size_t size) {
  return std::sqrt(std::inner_product(vector, vector + size, vector, 0.0F));
}

// Rows with the highest cosines (Eq. 4), best first, the earlier of equals. A zero vector, the
// descriptor of an empty frame, matches nothing.
std::vector<Candidate> search(const npy::Array& database, const Vector& query, std::size_t top) {
  std::vector<Candidate> found;
  const float own = length_of(query.data(), query.size());
  for (std::size_t row = 0; own > 0 && row < static_cast<std::size_t>(database.shape[0]); ++row) {
    const float* reference = database.as<float>() + row * query.size();
    const float other = length_of(reference, query.size());
    if (other == 0) continue;
    const float product = std::inner_product(query.begin(), query.end(), reference, 0.0F);
    found.emplace_back(product / own / other, row);
  }
  const auto last = found.begin() + static_cast<std::ptrdiff_t>(std::min(top, found.size()));
  std::partial_sort(found.begin(), last, found.end(), [](const Candidate& a, const Candidate& b) {
    return a.first != b.first ? a.first > b.first : a.second < b.second;
  });
  found.erase(last, found.end());
  return found;
}

npy::Array load_database(const std::string& path, const Head& head, std::size_t length) {
  auto database = npy::load(path);
  if (database.dtype != "<f4" || database.shape.size() != 2 ||
      database.shape[1] != static_cast<std::int64_t>(length))
    throw std::runtime_error(path + ": expected (R, " + std::to_string(length) + ") float32");
  std::string carried;
  if (!(std::ifstream(path + ".fingerprint.txt") >> carried))
    std::cerr << path << " carries no fingerprint: whether it fits the model cannot be checked\n";
  else if (carried != head.fingerprint())
    throw std::runtime_error(path + " has fingerprint " + carried + ", the model " +
                             head.fingerprint() + ": they do not compare");
  return database;
}

std::vector<std::string> load_frames(const std::string& path, std::size_t count) {
  std::ifstream file(path);
  std::vector<std::string> frames;
  for (std::string line; std::getline(file, line);) frames.push_back(line);
  if (frames.size() != count)
    throw std::runtime_error(path + ": expected " + std::to_string(count) + " ids, got " +
                             std::to_string(frames.size()));
  return frames;
}

std::size_t number(const std::string& text) {
  if (text.empty() || text.size() > 9 || text.find_first_not_of("0123456789") != text.npos)
    throw std::runtime_error("TOP: expected a number, got " + text);
  return std::stoul(text);
}

void run(const std::vector<std::string>& arguments) {
  Head head(arguments[0]);
  auto map = head.takes_photos() ? load_photo(arguments[1]) : load_labels(arguments[1]);
  const auto described = head.describe(map);
  if (described.unknown > 0)
    throw std::runtime_error(arguments[1] + ": " + std::to_string(described.unknown) +
                             " pixels have an id outside the label space");
  const auto& descriptor = described.descriptor;
  std::printf("descriptor: %zu numbers, norm %.6f\nkey-points:", descriptor.size(),
              static_cast<double>(length_of(descriptor.data(), descriptor.size())));
  for (auto count : described.keypoints) std::printf(" %lld", static_cast<long long>(count));
  std::printf("\n");
  if (arguments.size() < 3) return;
  const auto database = load_database(arguments[2], head, descriptor.size());
  const auto frames = load_frames(arguments[2] + ".frames.txt", database.shape[0]);
  const std::size_t top = arguments.size() > 3 ? number(arguments[3]) : 5;
  for (const auto& [score, row] : search(database, descriptor, top))
    std::printf("%s %.6f\n", frames[row].c_str(), static_cast<double>(score));
}

}  // namespace

int main(int count, char** values) {
  const std::vector<std::string> arguments(values + 1, values + count);
  if (arguments.size() < 2 || arguments.size() > 4) {
    std::cerr << "usage: place head.onnx map.npy|photo.ppm [town.npy [TOP]]\n";
    return 2;
  }
  try {
    run(arguments);
  } catch (const std::exception& error) {
    std::cerr << "place: " << error.what() << "\n";
    return 2;
  }
  return 0;
}
