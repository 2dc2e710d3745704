// Every function of the native core on noise of odd sizes: to be compiled with sanitisers, which end
// it where memory or arithmetic goes wrong.

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <numeric>
#include <random>
#include <vector>

#include "ssrvlad.h"
#include "ssrvlad_decide.h"
#include "ssrvlad_loops.h"
#include "ssrvlad_map.h"

namespace {
// Decides about a drive along all rows of a map, and along every other one, by scores.
int decide(std::mt19937 &random, const std::vector<int64_t> &starts, int64_t rows, int64_t queries) {
  const ssrvlad_drives drives{starts.data(), static_cast<int64_t>(starts.size()), rows};
  std::vector<int64_t> some;
  for (int64_t row = 0; row < rows; row += 2) some.push_back(row);
  const std::vector<double> stand_for(some.size(), 2.0);
  const int64_t first = 0, top = 3;
  const ssrvlad_shortlist listed{some.data(), stand_for.data(), static_cast<int64_t>(some.size()), &first, 1};
  ssrvlad_map *maps[] = {ssrvlad_map_new(&drives), ssrvlad_map_of(&drives, &listed)};
  if (!maps[0] || !maps[1] == !some.empty()) return 1;
  std::vector<float> scores(rows * queries), best(queries * top), sure(3 * queries);
  for (auto &score : scores) score = random() % 9 ? (random() % 500) / 1000.0f : -INFINITY;
  for (int64_t query = 0; query < queries; ++query)
    if (rows) scores[query * rows + query % rows] += 0.4f;
  std::vector<int64_t> found(queries * top), excluded(2 * queries);
  std::vector<uint8_t> allowed(rows, 1);
  for (auto &each : allowed) each = random() % 9 > 0;
  for (int64_t query = 0; query < queries; ++query) excluded[2 * query] = 0, excluded[2 * query + 1] = rows / 3;
  double weight;
  ssrvlad_taken taken{0, 0, &weight};
  ssrvlad_decision decision{best.data(), found.data(), sure.data(), sure.data() + queries,
                            sure.data() + 2 * queries, 0, 0, 0, 0, 0};
  const ssrvlad_channel channel{nullptr, SSRVLAD_SCORES, 1, 1, 1.0, nullptr};
  const ssrvlad_queries given{scores.data(), 1};
  for (ssrvlad_map *map : maps) {
    if (!map) continue;
    if (ssrvlad_map_add_channel(map, &channel)) return 2;
    for (const int mode : {SSRVLAD_ALONE, SSRVLAD_ONLINE, SSRVLAD_OFFLINE})
      for (const bool masked : {false, true}) {
        const ssrvlad_steps steps{0, 0, mode, mode == SSRVLAD_ONLINE ? 2 : 0, top,
                                  masked ? allowed.data() : nullptr, masked ? excluded.data() : nullptr};
        if (ssrvlad_map_query(map, &given, queries, &steps, 1, &decision, &taken)) return 3;
      }
    if (!queries || !rows) continue;
    const float before = scores[0];
    scores[0] = NAN;
    const ssrvlad_steps steps{0, 0, SSRVLAD_OFFLINE, 0, top, nullptr, nullptr};
    if (ssrvlad_map_query(map, &given, queries, &steps, 1, &decision, &taken) != SSRVLAD_WRONG_ARGUMENT) return 4;
    scores[0] = before;
  }
  for (ssrvlad_map *map : maps) ssrvlad_map_free(map);
  return 0;
}

// A map by vectors from several anchors and by signs of odd sizes. Returns 0 if all goes well.
int find(std::mt19937 &random, std::vector<int64_t> starts, int64_t rows, int64_t queries) {
  const int64_t length = 7, columns = 5, bytes = 3, anchors = 3, top = 3;
  std::vector<float> vectors(rows * length), swept(queries * anchors * length);
  std::vector<uint8_t> signs(rows * columns * bytes), seen(queries * columns * bytes);
  for (auto *some : {&vectors, &swept})
    for (auto &each : *some) each = static_cast<float>(random() % 5) - 2;
  for (auto *some : {&signs, &seen})
    for (auto &each : *some) each = static_cast<uint8_t>(random());
  if (rows > 2) std::fill_n(vectors.begin() + length, length, 0.0F);
  std::fill_n(swept.begin(), anchors * length, 0.0F);
  const ssrvlad_drives drives{starts.data(), static_cast<int64_t>(starts.size()), rows};
  ssrvlad_map *map = ssrvlad_map_new(&drives);
  const ssrvlad_channel channels[] = {{vectors.data(), SSRVLAD_VECTORS, 1, length, 1.0, nullptr},
                                      {signs.data(), SSRVLAD_SIGNS, columns, bytes, 6.0, nullptr}};
  for (const auto &channel : channels)
    if (ssrvlad_map_add_channel(map, &channel)) return 1;
  std::vector<float> scores(queries * top), sure(3 * queries), whole(queries * rows);
  std::vector<int64_t> found(queries * top);
  double weights[2];
  ssrvlad_decision decision{scores.data(), found.data(), sure.data(), sure.data() + queries,
                            sure.data() + 2 * queries, 0, 0, 0, 0, 0};
  ssrvlad_taken taken{0, 0, weights};
  const ssrvlad_queries given[] = {{swept.data(), anchors}, {seen.data(), 1}};
  for (const int on : {0, 1}) {
    const ssrvlad_steps steps{on, on, SSRVLAD_OFFLINE, 0, top, nullptr, nullptr};
    if (ssrvlad_map_query(map, given, queries, &steps, 2, &decision, &taken)) return 2;
    if (ssrvlad_map_compare(map, given, queries, &steps, 2, whole.data(), &taken)) return 3;
  }
  std::vector<float> lengths(rows, 2), best(queries * anchors * top, -INFINITY);
  std::vector<int64_t> nearest(best.size(), -1);
  std::vector<uint8_t> excluded(queries * anchors * rows);
  for (auto &each : excluded) each = random() % 2;
  if (rows > 1) lengths[1] = 0;
  for (const auto *without : {static_cast<uint8_t *>(nullptr), excluded.data()}) {
    const ssrvlad_rows some{vectors.data(), lengths.data(), without, rows, length, 5};
    if (ssrvlad_match(&some, swept.data(), queries * anchors, top, 2, best.data(), nearest.data())) return 5;
    if (!ssrvlad_match(&some, swept.data(), queries, 0, 2, best.data(), nearest.data())) return 6;
  }
  swept[length] = INFINITY;
  const ssrvlad_steps steps{1, 1, SSRVLAD_ALONE, 0, top, nullptr, nullptr};
  const int status = ssrvlad_map_query(map, given, queries, &steps, 1, &decision, &taken);
  ssrvlad_map_free(map);
  return status != SSRVLAD_WRONG_ARGUMENT;
}

// A stream of two drives by vectors from several anchors and by signs of odd sizes, of which the first
// frames are known. Returns 0 if all goes well.
int close(std::mt19937 &random, int64_t exclude, int64_t scan_above) {
  const int64_t frames = 130, known = 10, second = 65, length = 7, anchors = 3, columns = 5, bytes = 3;
  std::vector<float> vectors(known * length), swept(anchors * length);
  std::vector<uint8_t> signs(known * columns * bytes), starts(known), copied(signs.size());
  const auto draw = [&](std::vector<float> &some) {
    std::fill(some.begin(), some.end(), 0.0F);
    for (std::size_t row = 0; row < some.size(); row += length) some[row + random() % length] = 1;
  };
  draw(vectors);
  for (auto &each : signs) each = static_cast<uint8_t>(random());
  const ssrvlad_loops_channel channels[] = {{SSRVLAD_VECTORS, {length, 1, 1}, 1},
                                            {SSRVLAD_SIGNS, {columns, 1, bytes}, 6}};
  const ssrvlad_loops_settings settings{exclude, 0.8, scan_above};
  ssrvlad_loops *loops = ssrvlad_loops_new(&settings, channels, 2);
  const void *first[] = {vectors.data(), signs.data()}, *next[] = {swept.data(), signs.data()};
  if (!loops || ssrvlad_loops_extend(loops, first, nullptr, starts.data(), known)) return 1;
  const int64_t counts[] = {anchors, 1};
  for (int64_t frame = known; frame < frames; ++frame) {
    draw(swept);
    if (frame % 20 == 0) std::fill(swept.begin(), swept.end(), 0.0F);
    for (int64_t each = 0; each < columns * bytes; ++each) signs[each] = static_cast<uint8_t>(random());
    ssrvlad_loop loop;
    const double stamp = static_cast<double>(frame < 100 ? frame : 3600 + frame);
    if (ssrvlad_loops_update(loops, next, counts, stamp, frame == second, 2, &loop)) return 2;
  }
  double weights[2];
  ssrvlad_loops_weights(loops, weights);
  if (ssrvlad_loops_descriptors(loops, 1, frames - known, frames, copied.data())) return 3;
  if (ssrvlad_loops_rows(loops) != frames) return 4;
  ssrvlad_loops_free(loops);
  return 0;
}
}  // namespace

int main() {
  std::mt19937 random(1);
  if (find(random, {0, 1, 60}, 250, 70) || find(random, {0}, 1, 5) || find(random, {0}, 40, 31))
    return 8;
  for (const int64_t exclude : {0, 1, 20})
    for (const int64_t scan_above : {int64_t{1}, int64_t{40}, int64_t{SSRVLAD_SCAN_ABOVE}})
      if (close(random, exclude, scan_above)) return 9;
  if (decide(random, {0, 1, 60}, 150, 70) || decide(random, {0}, 1, 5) ||
      decide(random, {}, 0, 4) || decide(random, {0}, 40, 0))
    return 7;
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
    std::vector<float> weights(2 * 3 * length, 0.5f), offsets(6),
        scores(2 * blocks * SSRVLAD_LANES);
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
