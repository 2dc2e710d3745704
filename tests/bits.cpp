// Prints what the core finds in made-up drives, every bit of it: scores, decisions and loops. On all
// processors it prints the same.

#include <cstdio>
#include <random>
#include <vector>

#include "ssrvlad_loops.h"
#include "ssrvlad_map.h"

namespace {

constexpr int64_t ROWS = 140, QUERIES = 60, LENGTH = 48, ANCHORS = 3, COLUMNS = 6, BYTES = 16, TOP = 3;
constexpr int64_t SIGNS = COLUMNS * BYTES, FIRST = 40;

std::mt19937 noise(1);

float number() { return static_cast<float>(noise() % 2001) / 1000 - 1; }

// Descriptors of a map, and of a drive along some of its rows that sees them changed.
struct Town {
  std::vector<float> vectors, swept;
  std::vector<unsigned char> signs, seen;

  Town() : vectors(ROWS * LENGTH), swept(QUERIES * ANCHORS * LENGTH), signs(ROWS * SIGNS), seen(QUERIES * SIGNS) {
    for (auto &each : vectors) each = number();
    for (auto &each : signs) each = static_cast<unsigned char>(noise());
    for (int64_t query = 0; query < QUERIES; ++query) {
      const int64_t row = FIRST + query;
      for (int64_t n = 0; n < ANCHORS * LENGTH; ++n)
        swept[query * ANCHORS * LENGTH + n] = vectors[row * LENGTH + n % LENGTH] + number();
      for (int64_t n = 0; n < SIGNS; ++n)
        seen[query * SIGNS + n] = signs[row * SIGNS + n] ^ static_cast<unsigned char>(noise() & noise());
    }
  }
};

void print(const std::vector<float> &numbers) {
  for (const float each : numbers) std::printf("%a\n", static_cast<double>(each));
}

int find(const Town &town) {
  const int64_t starts[] = {0, 33, 100};
  const ssrvlad_drives drives = {starts, 3, ROWS};
  const ssrvlad_channel channels[] = {{town.vectors.data(), SSRVLAD_VECTORS, 1, LENGTH, 1, nullptr},
                                      {town.signs.data(), SSRVLAD_SIGNS, COLUMNS, BYTES, 6, nullptr}};
  const ssrvlad_queries queries[] = {{town.swept.data(), ANCHORS}, {town.seen.data(), 1}};
  ssrvlad_map *map = ssrvlad_map_new(&drives);
  for (const auto &channel : channels)
    if (ssrvlad_map_add_channel(map, &channel)) return 1;
  std::vector<float> scores(QUERIES * ROWS);
  for (const int standardise : {0, 1})
    for (const int sweep : {0, 1}) {
      double weights[2];
      ssrvlad_taken taken = {0, 0, weights};
      const ssrvlad_steps steps = {standardise, sweep, SSRVLAD_ALONE, 0, TOP, nullptr, nullptr};
      if (ssrvlad_map_compare(map, queries, QUERIES, &steps, 1, scores.data(), &taken)) return 2;
      for (int64_t query = 0; query < QUERIES; query += 7)
        print({scores.begin() + query * ROWS, scores.begin() + (query + 1) * ROWS});
    }
  for (const int follow : {SSRVLAD_ALONE, SSRVLAD_ONLINE, SSRVLAD_OFFLINE}) {
    std::vector<float> found(QUERIES * TOP), sure(3 * QUERIES);
    std::vector<int64_t> rows(QUERIES * TOP);
    double weights[2];
    ssrvlad_decision decision = {found.data(), rows.data(), sure.data(), sure.data() + QUERIES,
                                 sure.data() + 2 * QUERIES, 0, 0, 0, 0, 0};
    ssrvlad_taken taken = {0, 0, weights};
    const ssrvlad_steps steps = {1, 1, follow, 0, TOP, nullptr, nullptr};
    if (ssrvlad_map_query(map, queries, QUERIES, &steps, 1, &decision, &taken)) return 3;
    for (const int64_t row : rows) std::printf("%lld\n", static_cast<long long>(row));
    print(found), print(sure);
    std::printf("%d %a %a %a\n", decision.followed, decision.gain, weights[0], weights[1]);
  }
  ssrvlad_map_free(map);
  return 0;
}

int close(const Town &town) {
  const ssrvlad_loops_channel channels[] = {{SSRVLAD_VECTORS, {LENGTH, 1, 1}, 1},
                                            {SSRVLAD_SIGNS, {COLUMNS, BYTES, 1}, 6}};
  const ssrvlad_loops_settings settings = {20, 0.8, SSRVLAD_SCAN_ABOVE};
  ssrvlad_loops *loops = ssrvlad_loops_new(&settings, channels, 2);
  if (!loops) return 4;
  std::vector<float> unit(LENGTH);
  for (int64_t frame = 0; frame < ROWS + QUERIES; ++frame) {
    const bool again = frame >= ROWS;
    const float *vector = again ? town.swept.data() + (frame - ROWS) * ANCHORS * LENGTH
                                : town.vectors.data() + frame * LENGTH;
    float squares = 0;
    for (int64_t n = 0; n < LENGTH; ++n) squares += vector[n] * vector[n];
    float length = 1;  // by Newton's steps, the same everywhere
    for (int step = 0; step < 30; ++step) length = (length + squares / length) / 2;
    for (int64_t n = 0; n < LENGTH; ++n) unit[n] = vector[n] / length;
    const void *seen = again ? town.seen.data() + (frame - ROWS) * SIGNS : town.signs.data() + frame * SIGNS;
    const void *descriptors[] = {unit.data(), seen};
    ssrvlad_loop loop;
    if (ssrvlad_loops_update(loops, descriptors, nullptr, static_cast<double>(frame), frame == ROWS, 1, &loop))
      return 5;
    std::printf("%d %lld %a %a\n", loop.reason, static_cast<long long>(loop.candidate), loop.score,
                loop.probability);
  }
  ssrvlad_loops_free(loops);
  return 0;
}

}  // namespace

int main() {
  const Town town;
  if (const int status = find(town)) return status;
  return close(town);
}
