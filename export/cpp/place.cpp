// Describes a label map or a photograph and finds it in an exported database: an example for
// place.hpp and map.hpp.
//
//     place head.onnx map.npy [town.npy [TOP]]
//     place place.onnx photo.ppm [town.npy [TOP]]
//     place --network net.onnx head.onnx photo.ppm [town.npy [TOP]]
//
// A map is an (H, W) .npy array of uint8, int32 or int64, or a binary 8-bit PGM; a photograph is an
// (H, W, 3) .npy array of uint8 in RGB, or a binary 8-bit PPM. The database is written by
// `ssrvlad db export --format npy`; features and HOG are used where the file and the database have some.
// The frame is judged alone, as by `ssrvlad locate`; follow.cpp finds drives. --unchecked does not run
// the golden pair first. Exit code 0 for success, 2 for wrong use or bad input, with one line on stderr.

#include <cstdio>

#include "frames.hpp"
#include "map.hpp"
#include "program.hpp"

namespace {

void run(const std::string& network, const std::vector<std::string>& arguments, bool check) {
  const auto place = program::opened(network, arguments[0], check);
  const auto described = ssrvlad::describe(place, arguments[1]);
  const float* numbers = described.descriptor.data();
  const double square = std::inner_product(numbers, numbers + described.length, numbers, 0.0);
  std::printf("descriptor: %zu numbers, norm %.6f\n", described.descriptor.size(), std::sqrt(square));
  if (arguments.size() < 3) return;
  const ssrvlad::Map town(arguments[2], place.fingerprints());
  const auto top = arguments.size() > 3 ? program::number("TOP", arguments[3], 1) : 5;
  const auto answer = town.locate(described, static_cast<std::size_t>(top));
  for (const auto& match : answer.candidates)
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
  return program::run("place", [&] {
    run(network, arguments, check);
    return 0;
  });
}
