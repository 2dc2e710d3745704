// Describes a label map without any other library; prints the descriptor, one number a line.
//
//     describe PRESET categories.npy map.npy
//
// PRESET is `default` or `paper`. The categories are a (256,) .npy array of uint8, the category of
// each id: 0 to 7 (Table II), 8 for no layer, 255 for an id that must not occur. In Python, for a
// label space of this package:
//
//     categories = np.full(256, 255, np.uint8)
//     for label in label_space("camvid-11").classes:
//         categories[label.id] = label.category_index
//
// The map is an (H, W) .npy array of uint8 or int64. Exit code 0 for success, 2 for wrong use or bad
// input, with one line on stderr.

#include <cstdio>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "../npy.hpp"
#include <ssrvlad/ssrvlad.h>

namespace {

using Head = std::unique_ptr<ssrvlad_head, decltype(&ssrvlad_free)>;

npy::Array load(const std::string& path, std::size_t axes) {
  auto array = npy::load(path);
  if (array.shape.size() != axes || array.size() == 0 ||
      (array.dtype != "|u1" && (axes != 2 || array.dtype != "<i8")))
    throw std::runtime_error(path + ": expected " +
                             (axes == 2 ? "an (H, W) map of uint8 or int64" : "(256,) uint8") +
                             ", got " + std::to_string(array.shape.size()) + " axes of " +
                             array.dtype);
  return array;
}

std::vector<float> describe(const std::string& preset, const npy::Array& categories,
                            const npy::Array& map) {
  ssrvlad_settings settings;
  if (ssrvlad_preset(preset.c_str(), &settings) != SSRVLAD_OK) throw std::runtime_error(ssrvlad_last_error());
  const Head head(ssrvlad_new(&settings), ssrvlad_free);
  if (!head) throw std::runtime_error(ssrvlad_last_error());
  const ssrvlad_table table{categories.as<std::uint8_t>(), categories.shape[0], 0};
  const ssrvlad_labels labels{map.bytes.data(), map.dtype == "|u1" ? 1 : 8, 1, map.shape[0],
                              map.shape[1]};
  std::vector<float> numbers(static_cast<std::size_t>(ssrvlad_length(head.get())));
  const auto status = ssrvlad_describe(head.get(), &labels, &table, 1, numbers.data());
  if (status > 0)
    throw std::runtime_error(std::to_string(status) + " pixels have an id without a category");
  if (status != SSRVLAD_OK) throw std::runtime_error(ssrvlad_last_error());
  return numbers;
}

}  // namespace

int main(int count, char** arguments) {
  const bool help = count == 2 && arguments[1] == std::string("--help");
  if (count != 4) {
    std::fputs("usage: describe PRESET categories.npy map.npy\n", help ? stdout : stderr);
    return help ? 0 : 2;
  }
  try {
    const auto categories = load(arguments[2], 1), map = load(arguments[3], 2);
    for (const float number : describe(arguments[1], categories, map)) std::printf("%.9g\n", number);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 2;
  }
}
