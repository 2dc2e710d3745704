// Prints what the core says of made-up label maps and drives, every bit of it: descriptors, scores,
// decisions and loops. On all processors it prints the same.

#include <cstdio>
#include <cstdlib>
#include <random>
#include <vector>

#include "ssrvlad_loops.h"
#include "ssrvlad_map.h"

namespace {

constexpr int64_t ROWS = 140, QUERIES = 60, LENGTH = 48, ANCHORS = 3, COLUMNS = 6, HEIGHT = 2, BYTES = 16;

constexpr int64_t FIRST = 40, TOP = 3;

std::mt19937 noise(1);

float number() { return static_cast<float>(noise() % 2001) / 1000 - 1; }

void expect_ok(int status) {
  if (status) std::exit(1);
}

void print(const std::vector<float> &numbers) {
  for (const float number : numbers) std::printf("%.9g\n", static_cast<double>(number));
}

// Descriptors of a map, and of a drive along some of its rows that sees them changed.
struct Town {
  static constexpr int64_t SIGNS = COLUMNS * BYTES, SWEPT = ANCHORS * LENGTH;
  std::vector<float> vectors, swept;
  std::vector<unsigned char> signs, seen;
  std::vector<int64_t> starts{0, 33, 100}, rows;
  std::vector<float> scores, sure;
  ssrvlad_map *map;
  ssrvlad_queries queries[2];
  double weights[2];
  ssrvlad_taken taken{0, 0, weights};

  Town() : vectors(ROWS * LENGTH), swept(QUERIES * SWEPT), signs(ROWS * SIGNS),
           seen(QUERIES * SIGNS), rows(QUERIES * TOP), scores(rows.size()), sure(3 * QUERIES) {
    for (float &each : vectors) each = number();
    for (unsigned char &each : signs) each = static_cast<unsigned char>(noise());
    for (int64_t query = 0; query < QUERIES; ++query) {
      const int64_t row = FIRST + query;
      for (int64_t n = 0; n < SWEPT; ++n)
        swept[query * SWEPT + n] = vectors[row * LENGTH + n % LENGTH] + number();
      for (int64_t n = 0; n < SIGNS; ++n)
        seen[query * SIGNS + n] = signs[row * SIGNS + n] ^ static_cast<unsigned char>(noise() & noise());
    }
    const ssrvlad_drives drives = {starts.data(), 3, ROWS};
    map = ssrvlad_map_new(&drives);
    const ssrvlad_channel channels[] = {
        {vectors.data(), SSRVLAD_VECTORS, 1, 1, LENGTH, 1, nullptr},
        {signs.data(), SSRVLAD_SIGNS, COLUMNS, HEIGHT, BYTES / HEIGHT, 6, nullptr}};
    for (const auto &channel : channels) expect_ok(ssrvlad_map_add_channel(map, &channel));
    queries[0] = {swept.data(), ANCHORS}, queries[1] = {seen.data(), 1};
  }
  ~Town() { ssrvlad_map_free(map); }

  ssrvlad_decision decide(int follow) {
    float *right = sure.data(), *spread = right + QUERIES;
    ssrvlad_decision decision = {scores.data(), rows.data(), right, spread, spread + QUERIES, 0, 0, 0, 0, 0};
    const ssrvlad_steps steps = {1, 1, follow, 0, TOP, nullptr, nullptr};
    expect_ok(ssrvlad_map_query(map, queries, QUERIES, &steps, 1, &decision, &taken));
    return decision;
  }
};

void find(Town &town) {
  std::vector<float> scores(QUERIES * ROWS);
  for (const int standardise : {0, 1})
    for (const int sweep : {0, 1}) {
      const ssrvlad_steps steps = {standardise, sweep, SSRVLAD_ALONE, 0, TOP, nullptr, nullptr};
      expect_ok(ssrvlad_map_compare(town.map, town.queries, QUERIES, &steps, 1, scores.data(), &town.taken));
      for (int64_t query = 0; query < QUERIES; query += 7)
        print({scores.begin() + query * ROWS, scores.begin() + (query + 1) * ROWS});
    }
  for (const int follow : {SSRVLAD_ALONE, SSRVLAD_ONLINE, SSRVLAD_OFFLINE}) {
    const ssrvlad_decision decision = town.decide(follow);
    for (const int64_t row : town.rows) std::printf("%lld\n", static_cast<long long>(row));
    print(town.scores), print(town.sure);
    std::printf("%d %.17g %.17g %.17g\n", decision.followed, decision.gain, town.weights[0], town.weights[1]);
  }
}

void close(const Town &town) {
  const ssrvlad_loops_channel channels[] = {{SSRVLAD_VECTORS, {LENGTH, 1, 1}, 1},
                                            {SSRVLAD_SIGNS, {COLUMNS, BYTES, 1}, 6}};
  const ssrvlad_loops_settings settings = {20, 0.8, SSRVLAD_SCAN_ABOVE};
  ssrvlad_loops *loops = ssrvlad_loops_new(&settings, channels, 2);
  std::vector<float> unit(LENGTH);
  for (int64_t frame = 0; frame < ROWS + QUERIES; ++frame) {
    const bool again = frame >= ROWS;
    const float *vector = again ? town.swept.data() + (frame - ROWS) * town.SWEPT : town.vectors.data() + frame * LENGTH;
    float squares = 0;
    for (int64_t n = 0; n < LENGTH; ++n) squares += vector[n] * vector[n];
    float length = 1;  // by Newton's steps, the same everywhere
    for (int step = 0; step < 30; ++step) length = (length + squares / length) / 2;
    for (int64_t n = 0; n < LENGTH; ++n) unit[n] = vector[n] / length;
    const void *seen = again ? town.seen.data() + (frame - ROWS) * town.SIGNS : town.signs.data() + frame * town.SIGNS;
    const void *descriptors[] = {unit.data(), seen};
    ssrvlad_loop loop;
    expect_ok(ssrvlad_loops_update(loops, descriptors, nullptr, static_cast<double>(frame), frame == ROWS, 1, &loop));
    std::printf("%d %lld %.17g %.17g\n", loop.reason, static_cast<long long>(loop.candidate), loop.score, loop.probability);
  }
  ssrvlad_loops_free(loops);
}

// Label maps of blocks, each with some odd pixels.
void describe(const char *preset) {
  constexpr int64_t IMAGES = 4, HEIGHT = 181, WIDTH = 243;
  std::vector<unsigned char> categories(256), blocks(IMAGES * 400), ids(IMAGES * HEIGHT * WIDTH);
  for (unsigned char &category : categories) category = static_cast<unsigned char>(noise() % 9);
  for (unsigned char &block : blocks) block = static_cast<unsigned char>(noise());
  for (int64_t pixel = 0; pixel < static_cast<int64_t>(ids.size()); ++pixel) {
    const int64_t image = pixel / (HEIGHT * WIDTH), y = pixel / WIDTH % HEIGHT, x = pixel % WIDTH;
    const int64_t grain = 13 * (image + 1);
    ids[pixel] = noise() % 40 ? blocks[image * 400 + y / grain * 20 + x / grain] : static_cast<unsigned char>(noise());
  }
  ssrvlad_settings settings;
  expect_ok(ssrvlad_preset(preset, &settings));
  ssrvlad_head *head = ssrvlad_new(&settings);
  std::vector<float> descriptors(IMAGES * ssrvlad_length(head));
  const ssrvlad_labels labels = {ids.data(), 1, IMAGES, HEIGHT, WIDTH};
  const ssrvlad_table table = {categories.data(), 256, 0};
  expect_ok(ssrvlad_describe(head, &labels, &table, 1, descriptors.data()));
  print(descriptors);
  ssrvlad_free(head);
}

}  // namespace

int main() {
  describe("default"), describe("paper");
  Town town;
  find(town), close(town);
}
