// Every function of the native core on noise of odd sizes: to be compiled with sanitisers, which end
// it where memory or arithmetic goes wrong.

#include <cstdio>
#include <random>
#include <vector>

#include "ssrvlad.h"

int main() {
  std::mt19937 random(1);
  const int64_t sizes[][2] = {{1, 1}, {1, 200}, {200, 1}, {7, 63}, {64, 64}, {65, 129}, {131, 190}};
  std::vector<uint8_t> categories(64);
  for (std::size_t id = 0; id < categories.size(); ++id) categories[id] = id < 9 ? id : 255;
  const ssrvlad_table table{categories.data(), 64, 0};
  for (const auto &[height, width] : sizes) {
    const int64_t images = 3, pixels = images * height * width;
    std::vector<uint8_t> planes(pixels), target(pixels), other(pixels);
    std::vector<int64_t> ids(pixels);
    for (auto &byte : planes) byte = random() & random();
    for (auto &id : ids) id = random() % 9;
    ssrvlad_open_and_close(planes.data(), images, height, width, 2, 70, target.data());
    ssrvlad_fill_holes(planes.data(), images, height, width, 20, target.data());
    ssrvlad_drop_regions(planes.data(), images, height, width, 5, target.data());
    for (int rule = 0; rule < 2; ++rule)
      ssrvlad_thin(planes.data(), images, height, width, rule, target.data());
    ssrvlad_keypoints(planes.data(), images, height, width, target.data(), other.data());
    for (const char *preset : {"default", "paper"}) {
      ssrvlad_settings settings;
      if (ssrvlad_preset(preset, &settings)) return 1;
      settings.working_size = settings.working_size ? 30 : 0;
      ssrvlad_head *head = ssrvlad_new(&settings);
      std::vector<float> descriptors(images * ssrvlad_length(head));
      ssrvlad_labels labels{ids.data(), 8, images, height, width};
      if (ssrvlad_describe(head, &labels, &table, 3, descriptors.data())) return 2;
      labels.ids = planes.data(), labels.bytes = 1;
      ssrvlad_describe(head, &labels, &table, 1, descriptors.data());
      ids[0] = INT64_MIN, labels.ids = ids.data(), labels.bytes = 8;
      if (ssrvlad_describe(head, &labels, &table, 2, descriptors.data()) != 1) return 3;
      ids[0] = 0;
      ssrvlad_free(head);
    }
  }
  for (const int64_t rows : {1, 63, 130}) {
    const int64_t columns = 5, words = 3, length = 7, blocks = (rows + 63) / 64;
    std::vector<uint64_t> signs(rows * columns * words), query(2 * columns * words);
    for (auto &word : signs) word = random();
    for (auto &word : query) word = random();
    std::vector<int8_t> codes(blocks * length * SSRVLAD_LANES);
    for (auto &code : codes) code = static_cast<int8_t>(random());
    std::vector<float> weights(2 * 3 * length, 0.5f), offsets(6), scores(2 * blocks * SSRVLAD_LANES);
    for (const int64_t reach : {0, 2, 4})
      if (ssrvlad_scan_signs(query.data(), 2, signs.data(), rows, columns, words, 190, reach, 2,
                             scores.data()))
        return 4;
    if (ssrvlad_scan_signs(query.data(), 2, signs.data(), rows, columns, words, 190, 5, 2,
                           scores.data()) != SSRVLAD_WRONG_ARGUMENT)
      return 5;
    if (ssrvlad_scan_vectors(weights.data(), offsets.data(), 2, 3, codes.data(), blocks, length, 2,
                             scores.data()))
      return 6;
  }
  std::puts("clean");
}
