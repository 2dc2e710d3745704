// Describes a label map or a photograph and finds it in an exported database: an example for
// place.hpp.
//
//     place head.onnx map.npy [town.npy [TOP]]
//     place place.onnx photo.ppm [town.npy [TOP]]
//     place --network net.onnx head.onnx photo.ppm [town.npy [TOP]]
//
// A map is an (H, W) .npy array of uint8, int32 or int64, or a binary 8-bit PGM; a photograph is an
// (H, W, 3) .npy array of uint8 in RGB, or a binary 8-bit PPM. The database is written by
// `ssrvlad db export --format npy`; features and HOG are used where the file and the database have some.
// The frame is judged alone, without the steps of `ssrvlad query`; ../README.md has what that
// costs. --unchecked does not run the golden pair first. Exit code 0 for success, 2 for wrong use
// or bad input, with one line on stderr.

#include "place.hpp"

#include <cstdio>

namespace {

npy::Array load_netpbm(const std::string& path, bool colour) {
  std::ifstream file(path, std::ios::binary);
  std::string magic;
  std::int64_t width = 0, height = 0, highest = 0;
  if (!(file >> magic >> width >> height >> highest) || magic != (colour ? "P6" : "P5") ||
      highest > 255 || (colour && highest < 255) || width < 1 || height < 1 || width > 1 << 20 ||
      height > 1 << 20)
    throw std::runtime_error(
        path + ": expected a binary " +
        (colour ? "PPM whose largest value is 255" : "PGM of 8 bits") + ", without comments");
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

npy::Array load(const std::string& path, bool photograph) {
  auto map = ends_with(path, photograph ? ".ppm" : ".pgm") ? load_netpbm(path, photograph)
                                                           : npy::load(path);
  const bool fits = photograph ? map.shape.size() == 3 && map.shape[2] == 3 && map.dtype == "|u1"
                               : map.shape.size() == 2 && (map.dtype == "|u1" || map.dtype == "<i4" ||
                                                           map.dtype == "<i8");
  if (!fits || map.size() == 0)
    throw std::runtime_error(path + ": expected an " +
                             (photograph ? "(H, W, 3) photograph of uint8"
                                         : "(H, W) map of uint8, int32 or int64") +
                             ", got " + std::to_string(map.shape.size()) + " axes of " + map.dtype);
  return map;
}

std::size_t number(const std::string& text) {
  if (text.empty() || text.size() > 9 || text.find_first_not_of("0123456789") != text.npos)
    throw std::runtime_error("TOP: expected a number, got " + text);
  return std::stoul(text);
}

ssrvlad::Described describe(const ssrvlad::Place& place, const std::string& path) {
  const auto map = load(path, place.takes_photographs());
  try {
    if (map.dtype == "<i4")
      return place.describe(map.as<std::int32_t>(), map.shape[0], map.shape[1]);
    if (map.dtype == "<i8")
      return place.describe(map.as<std::int64_t>(), map.shape[0], map.shape[1]);
    return place.describe(map.as<std::uint8_t>(), map.shape[0], map.shape[1]);
  } catch (const std::exception& error) {
    throw std::runtime_error(path + ": " + error.what());
  }
}

void run(const std::string& network, const std::vector<std::string>& arguments, bool check) {
  const Ort::SessionOptions options;  // append a provider for the network here
  const auto place = network.empty() ? ssrvlad::Place(arguments[0], options, check)
                                     : ssrvlad::Place(network, arguments[0], options, check);
  const auto described = describe(place, arguments[1]);
  std::printf("descriptor: %zu numbers, norm %.6f\n", described.descriptor.size(),
              static_cast<double>(ssrvlad::detail::length_of(described.descriptor.data(),
                                                             described.length)));
  if (arguments.size() < 3) return;
  const ssrvlad::Database database(arguments[2], place.fingerprints());
  const auto top = arguments.size() > 3 ? number(arguments[3]) : 5;
  for (const auto& match : database.match(described, top))
    std::printf("%s %.6f\n", match.frame.c_str(), static_cast<double>(match.score));
}

}  // namespace

int main(int count, char** values) {
  std::vector<std::string> arguments(values + 1, values + count);
  std::string network;
  bool check = true;
  while (!arguments.empty() && arguments[0].compare(0, 2, "--") == 0) {
    const bool named = arguments[0] == "--network" && arguments.size() > 1;
    if (!named && arguments[0] != "--unchecked") break;
    if (named) network = arguments[1];
    check = check && named;
    arguments.erase(arguments.begin(), arguments.begin() + (named ? 2 : 1));
  }
  if (arguments.size() < 2 || arguments.size() > 4) {
    std::cerr << "usage: place [--unchecked] [--network net.onnx] head.onnx map.npy|photo.ppm "
                 "[town.npy [TOP]]\n";
    return 2;
  }
  try {
    run(network, arguments, check);
  } catch (const std::exception& error) {
    std::cerr << "place: " << error.what() << "\n";
    return 2;
  }
  return 0;
}
