// Prints the least processor time of some queries of a drive in a made-up map by vectors and by signs.

#include <algorithm>
#include <cstdio>
#include <ctime>
#include <random>
#include <vector>

#include "ssrvlad_map.h"

int main() {
  constexpr int64_t ROWS = 3000, QUERIES = 100, LENGTH = 480, ANCHORS = 9, COLUMNS = 16, BYTES = 256, TOP = 5;
  std::mt19937 noise(1);
  std::vector<float> vectors(ROWS * LENGTH), swept(QUERIES * ANCHORS * LENGTH);
  std::vector<unsigned char> signs(ROWS * COLUMNS * BYTES);
  for (float &number : vectors) number = static_cast<float>(noise() % 2001) / 1000 - 1;
  for (unsigned char &byte : signs) byte = static_cast<unsigned char>(noise());
  for (int64_t n = 0; n < QUERIES * ANCHORS * LENGTH; ++n)
    swept[n] = vectors[(100 + n / ANCHORS / LENGTH) * LENGTH + n % LENGTH] + static_cast<float>(noise() % 2001) / 1000 - 1;
  const int64_t starts[] = {0};
  const ssrvlad_drives drives{starts, 1, ROWS};
  ssrvlad_map *map = ssrvlad_map_new(&drives);
  ssrvlad_channel shapes{}, cells{};
  shapes.rows = vectors.data(), shapes.kind = SSRVLAD_VECTORS, shapes.columns = 1, shapes.size = LENGTH, shapes.trust = 1;
  cells.rows = signs.data(), cells.kind = SSRVLAD_SIGNS, cells.columns = COLUMNS, cells.size = BYTES, cells.trust = 6;
  if (ssrvlad_map_add_channel(map, &shapes) || ssrvlad_map_add_channel(map, &cells)) return 1;
  ssrvlad_queries queries[2] = {};
  queries[0].descriptors = swept.data(), queries[0].anchors = ANCHORS;
  queries[1].descriptors = signs.data() + 100 * COLUMNS * BYTES, queries[1].anchors = 1;
  std::vector<float> numbers(4 * QUERIES * TOP);
  std::vector<int64_t> rows(QUERIES * TOP);
  double weights[2], least = 1e9;
  ssrvlad_decision decision{};
  decision.scores = numbers.data(), decision.rows = rows.data(), decision.right = numbers.data() + QUERIES * TOP;
  decision.spread = decision.right + QUERIES, decision.together = decision.spread + QUERIES;
  ssrvlad_taken taken{};
  taken.weights = weights;
  ssrvlad_steps steps{};
  steps.standardise = steps.sweep = 1, steps.follow = SSRVLAD_OFFLINE, steps.top = TOP;
  for (int time = 0; time < 3; ++time) {
    const std::clock_t start = std::clock();
    if (ssrvlad_map_query(map, queries, QUERIES, &steps, 1, &decision, &taken)) return 2;
    least = std::min(least, static_cast<double>(std::clock() - start) / CLOCKS_PER_SEC);
  }
  std::printf("%.4f\n", least);
  ssrvlad_map_free(map);
}
