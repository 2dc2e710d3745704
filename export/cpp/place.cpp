// Describes a label map or a photograph and finds it in an exported database: an example for
// place.hpp and map.hpp. `place --help` says how it is called.

#include <cstdio>

#include <ssrvlad/map.hpp>

#include "program.hpp"

namespace {

const program::Usage usage{
    "place", "place.onnx FRAME [town.npy [TOP]]",
    R"(Prints the norm of the descriptor of a frame, the confidence that the first of its TOP places (5) is right, and
these places with their scores.

FRAME is a label map, an (H, W) .npy array of uint8, int32 or int64 or a binary 8-bit PGM, or for a model
of `ssrvlad fuse` a photograph, an (H, W, 3) .npy array of uint8 in RGB or a binary 8-bit PPM. town.npy is
written by `ssrvlad db export --format npy`; features and HOG are used where the model and the database have
some. The frame is judged alone, as by `ssrvlad locate`; `follow` finds drives. Exit code 0 for success, 2
for wrong use or bad input, with one line on standard error.
)",
    2, 4, {}, {}};

int find(const program::Arguments& arguments) {
  const auto& files = arguments.files;
  const auto top = files.size() > 3 ? program::number("TOP", files[3], 1) : 5;
  ssrvlad::require_frames({files[1]});
  if (files.size() > 2) npy::require(files[2]);
  const auto place = program::opened(arguments, files[0]);
  const auto described = ssrvlad::describe(place, files[1]);
  const float* numbers = described.descriptor.data();
  const double square = std::inner_product(numbers, numbers + described.length, numbers, 0.0);
  std::printf("descriptor: %zu numbers, norm %.6f", described.descriptor.size(), std::sqrt(square));
  if (files.size() < 3) {
    std::printf("\n");
    return 0;
  }
  const ssrvlad::Map town(files[2], place.fingerprints());
  for (const auto& warning : town.warnings()) program::note(warning);
  const auto answer = town.locate(described, static_cast<std::size_t>(top));
  std::printf(", confidence %.2f\n", static_cast<double>(answer.confidence));
  for (const auto& match : answer.candidates)
    std::printf("%s %.6f\n", program::printable(match.frame).c_str(), static_cast<double>(match.score));
  return 0;
}

}  // namespace

int main(int count, char** values) { return program::run(usage, count, values, find); }
