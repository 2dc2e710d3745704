// The method in plain C++17: label maps to descriptors, and the functions of ssrvlad.h.
//
// A layer is a plane of bits, stored by rows of 64-bit words, with the leftmost pixel in the lowest
// bit. Every row ends with at least one background bit, so the bit before a row's first pixel, the
// last bit of the previous row, is off. Thinning works on tiles, 8 x 8 pixels in a word, because a
// boundary of any direction then touches few words.
//
// Compile it with -ffp-contract=off: where multiplication and addition are fused, sums are rounded
// differently.

#include <algorithm>
#include <array>
#include <atomic>
#include <cmath>
#include <cstdarg>
#include <cstdio>
#include <cstring>
#include <list>
#include <memory>
#include <vector>

#include "cpu.hpp"
#include "interface.hpp"
#include "parallel.hpp"

namespace {

using namespace places;
using Word = std::uint64_t;

constexpr int LAYERS = SSRVLAD_LAYERS;
constexpr int KINDS = LAYERS + 1;  // the categories and no layer
constexpr Word ALL = ~Word{0};
constexpr Word LEFT = 0x0101010101010101, RIGHT = LEFT << 7, TOP = 0xff, BOTTOM = TOP << 56;
constexpr double PI = 3.14159265358979323846;

constexpr int CELL_ROWS = 24, CELL_COLUMNS = 32, CELLS = CELL_ROWS * CELL_COLUMNS;
constexpr int AREA_LAYERS = 6, DIRECTIONS = 4;
constexpr double FAINT = 1e-4;  // below it, coefficients stay linear
constexpr double BOUNDARY_WIDTH = 2;  // a straight boundary is counted at 2 pixels across it

inline int lowest_bit(Word word) { return __builtin_ctzll(word); }

SSRVLAD_INLINE int count_bits(Word word) {
  word -= word >> 1 & 0x5555555555555555;
  word = (word & 0x3333333333333333) + (word >> 2 & 0x3333333333333333);
  word = (word + (word >> 4)) & 0x0f0f0f0f0f0f0f0f;
  return static_cast<int>(word * 0x0101010101010101 >> 56);
}

// ---------------------------------------------------------------------------------- planes of bits

struct Grid {
  Size height, width, pitch;  // words in a row

  Grid(Size height, Size width) : height(height), width(width), pitch(width / 64 + 1) {}
  Size words() const { return height * pitch; }
  // Bits of the image in word `i` of a row.
  Word inside(Size i) const { return i < width / 64 ? ALL : (Word{1} << width % 64) - 1; }
};

using Words = std::vector<Word>;

SSRVLAD_INLINE bool any(const Word *words, Size count) {
  Word seen = 0;
  for (Size i = 0; i < count; ++i) seen |= words[i];
  return seen != 0;
}

void complement(Word *plane, const Grid &grid) {
  for (Size y = 0; y < grid.height; ++y, plane += grid.pitch)
    for (Size i = 0; i < grid.pitch; ++i) plane[i] = ~plane[i] & grid.inside(i);
}

// Bytes whose bit k is layer k -> eight planes, and back.
Word transposed(Word bits) {  // 8 x 8 bits; Warren, Hacker's Delight, 7-3
  Word swap = (bits ^ bits >> 7) & 0x00aa00aa00aa00aa;
  bits ^= swap ^ swap << 7;
  swap = (bits ^ bits >> 14) & 0x0000cccc0000cccc;
  bits ^= swap ^ swap << 14;
  swap = (bits ^ bits >> 28) & 0x00000000f0f0f0f0;
  return bits ^ swap ^ swap << 28;
}

// ------------------------------------------------------------- label ids -> categories (Table II)

// The meaning of each id. Ids outside the table have its first or last entry, which is unknown.
template <class Entry>
class Lookup {
 public:
  template <class Meaning>
  Lookup(const ssrvlad_table &table, Meaning meaning) : origin_(table.origin), entries_(table.entries + 2) {
    entries_.front() = entries_.back() = meaning(SSRVLAD_UNKNOWN);
    for (Size i = 0; i < table.entries; ++i) entries_[i + 1] = meaning(table.categories[i]);
    for (Size id = 0; id < 256; ++id) bytes_[id] = entries_[place(id)];
  }
  SSRVLAD_INLINE Entry operator[](std::uint8_t id) const { return bytes_[id]; }
  SSRVLAD_INLINE Entry operator[](Size id) const { return entries_[place(id)]; }

 private:
  Size place(Size id) const {
    const Size last = static_cast<Size>(entries_.size()) - 1;
    return std::clamp(id, -origin_ - 1, last - 1 - origin_) + origin_ + 1;
  }
  Size origin_;
  std::vector<Entry> entries_;
  std::array<Entry, 256> bytes_;
};

template <class Id>
SSRVLAD_INLINE bool eight_alike(const Id *ids) {
  if constexpr (sizeof(Id) > 1) return false;
  Word eight;
  std::memcpy(&eight, ids, 8);
  return eight == *ids * LEFT;
}

template <class Id>
SSRVLAD_INLINE auto as_id(Id id) {
  if constexpr (sizeof(Id) == 1) return static_cast<std::uint8_t>(id);
  else return static_cast<Size>(id);
}

// Ballots count pixels: a word holds a counter of 7 bits for each category, and a bit for unknown.
constexpr int BALLOT_BITS = 7, MOST_BALLOTS = (1 << BALLOT_BITS) - 1;
constexpr Word UNKNOWN_BALLOT = Word{1} << 63;

Word ballot_of(std::uint8_t category) {
  return category < KINDS ? Word{1} << BALLOT_BITS * category : UNKNOWN_BALLOT;
}

// Whether all pixels of a cell have the same id.
SSRVLAD_INLINE bool alike(const std::uint8_t *ids, Size pitch, Size rows, Size columns) {
  if (columns < 8) return false;  // counting votes is as fast
  const Word first = *ids * LEFT;
  Word other = 0, eight;
  for (Size y = 0; y < rows; ++y, ids += pitch)
    for (Size x = 0; x < columns; x += 8) {
      std::memcpy(&eight, ids + std::min(x, columns - 8), 8);
      other |= eight ^ first;
    }
  return !other;
}
template <class Id>
SSRVLAD_INLINE bool alike(const Id *ids, Size pitch, Size rows, Size columns) {
  Id other = 0;
  const Id first = *ids;
  for (Size y = 0; y < rows; ++y, ids += pitch)
    for (Size x = 0; x < columns; ++x) other = static_cast<Id>(other | (ids[x] ^ first));
  return !other;
}

// The most common category of a cell, the lowest one in a tie. `seen` is the OR of all ballots.
template <class Id>
int winner(const Id *ids, Size pitch, Size rows, Size columns, const Lookup<Word> &lookup, Word &seen) {
  if (alike(ids, pitch, rows, columns)) {
    const Word ballot = lookup[as_id(*ids)];
    seen |= ballot;
    return std::min(lowest_bit(ballot) / BALLOT_BITS, KINDS - 1);
  }
  std::array<Word, KINDS> counted{};
  Word ballots = 0;
  const auto count = [&] {
    for (int kind = 0; kind < KINDS; ++kind) counted[kind] += ballots >> BALLOT_BITS * kind & MOST_BALLOTS;
    ballots = 0;
  };
  Size pending = 0;
  for (Size y = 0; y < rows; ++y, ids += pitch)
    for (Size x = 0; x < columns;) {
      const Size end = x + std::min(columns - x, MOST_BALLOTS - pending);
      pending += end - x;
      for (; x < end; ++x) {
        const Word ballot = lookup[as_id(ids[x])];
        ballots += ballot, seen |= ballot;
      }
      if (pending == MOST_BALLOTS) count(), pending = 0;
    }
  count();
  return static_cast<int>(std::max_element(counted.begin(), counted.end()) - counted.begin());
}

// Where each cell of a line begins, and the last ends: pixel i is in cell i * cells / pixels.
std::vector<Size> cell_bounds(Size pixels, Size cells) {
  std::vector<Size> bounds;
  for (Size cell = 0; cell <= cells; ++cell) bounds.push_back((cell * pixels + cells - 1) / cells);
  return bounds;
}

// The layers of an image that is reduced to a grid, as planes of bits. False if an id is unknown.
template <class Id>
bool vote(const Id *ids, Size height, Size width, const Lookup<Word> &lookup, const Grid &grid, Word *planes) {
  Word seen = 0;
  std::fill_n(planes, LAYERS * grid.words(), 0);
  const std::vector<Size> tops = cell_bounds(height, grid.height), lefts = cell_bounds(width, grid.width);
  for (Size row = 0; row < grid.height; ++row)
    for (Size column = 0; column < grid.width; ++column) {
      const Size top = tops[row], left = lefts[column];
      const int category = winner(ids + top * width + left, width, tops[row + 1] - top, lefts[column + 1] - left,
                                  lookup, seen);
      if (category < LAYERS)
        planes[category * grid.words() + row * grid.pitch + column / 64] |= Word{1} << column % 64;
    }
  return !(seen & UNKNOWN_BALLOT);
}

// The layers of an image as it is. A lookup entry is the bit of its layer, or bit 8 for unknown.
constexpr std::uint16_t UNKNOWN_LAYER = 256;

std::uint16_t layer_of(std::uint8_t category) {
  if (category > LAYERS) return UNKNOWN_LAYER;
  return static_cast<std::uint16_t>(category < LAYERS ? 1 << category : 0);
}

template <class Id>
bool split(const Id *ids, const Grid &grid, const Lookup<std::uint16_t> &lookup, Word *planes) {
  unsigned seen = 0;
  for (Size y = 0; y < grid.height; ++y, ids += grid.width)
    for (Size i = 0; i < grid.pitch; ++i) {
      Word layers[LAYERS] = {};
      const Size end = std::min(grid.width, i * 64 + 64);
      Size x = i * 64;
      for (; x + 8 <= end; x += 8) {
        if (eight_alike(ids + x)) {
          const unsigned layer = lookup[as_id(ids[x])];
          seen |= layer;
          if (layer & 255) layers[lowest_bit(layer)] |= Word{255} << x % 64;
          continue;
        }
        Word eight = 0;
        for (int j = 0; j < 8; ++j) {
          const unsigned layer = lookup[as_id(ids[x + j])];
          seen |= layer, eight |= Word{layer & 255} << 8 * j;
        }
        eight = transposed(eight);
        for (int k = 0; k < LAYERS; ++k) layers[k] |= (eight >> 8 * k & 255) << x % 64;
      }
      for (; x < end; ++x) {
        const unsigned layer = lookup[as_id(ids[x])];
        seen |= layer;
        if (layer & 255) layers[lowest_bit(layer)] |= Word{1} << x % 64;
      }
      for (int k = 0; k < LAYERS; ++k) planes[k * grid.words() + y * grid.pitch + i] = layers[k];
    }
  return !(seen & UNKNOWN_LAYER);
}

// ------------------------------------------------------------------------------------- morphology

// ORs each word with the bits that are `whole` words and `bits` bits later.
void or_later(Word *words, Size count, Size whole, int bits) {
  on_cpu([=](auto) {
    const Word *later = words + whole;
    if (bits == 0)
      for (Size i = 0; i < count; ++i) words[i] |= later[i];
    else
      for (Size i = 0; i < count; ++i) words[i] |= later[i] >> bits | later[i + 1] << (64 - bits);
  });
}

// Calls `spread` with the steps by which a running OR grows, doubling, to `2 * radius + 1` pixels.
template <class Spread>
void by_doubling(Size radius, Spread spread) {
  for (Size reach = 1, step; reach < 2 * radius + 1; reach += step) {
    step = std::min(reach, 2 * radius + 1 - reach);
    spread(step);
  }
}

// Dilation by a square. The plane is copied into a larger one, moved down and right by `radius`
// pixels, so that the window of a pixel begins at the pixel.
void dilate(Word *plane, const Grid &grid, Size radius, Words &larger) {
  if (radius == 0) return;
  radius = std::min(radius, std::max(grid.height, grid.width));  // covers the whole image
  const Size pitch = grid.pitch + 2 * radius / 64 + 1, rows = grid.height + 2 * radius;
  const Size total = rows * pitch, whole = radius / 64;
  const int bits = static_cast<int>(radius % 64);
  larger.assign(total + 2 * pitch, 0);
  for (Size y = 0; y < grid.height; ++y) {
    const Word *row = plane + y * grid.pitch;
    Word *moved = larger.data() + (y + radius) * pitch + whole;
    for (Size i = 0; i < grid.pitch; ++i) {
      moved[i] |= row[i] << bits;
      if (bits) moved[i + 1] |= row[i] >> (64 - bits);
    }
  }
  by_doubling(radius, [&](Size step) { or_later(larger.data(), total, step / 64, static_cast<int>(step % 64)); });
  by_doubling(radius, [&](Size step) { or_later(larger.data(), total - step * pitch, step * pitch, 0); });
  for (Size y = 0; y < grid.height; ++y)
    for (Size i = 0; i < grid.pitch; ++i)
      plane[y * grid.pitch + i] = larger[y * pitch + i] & grid.inside(i);
}

void erode(Word *plane, const Grid &grid, Size radius, Words &buffer) {
  if (radius == 0) return;
  complement(plane, grid);
  dilate(plane, grid, radius, buffer);
  complement(plane, grid);
}

// -------------------------------------------------------------------------------------- components

// Horizontal runs of a plane and the region of each, by union-find. The first run is the root.
class Regions {
 public:
  // Clears the 8-connected regions of fewer than `area` pixels, or fills such holes: 4-connected regions of background
  // that do not touch the border of the image.
  void repaint(Word *plane, const Grid &grid, Size area, bool holes) {
    if (area <= 1) return;
    find(plane, grid, holes);
    for (Size i = 0; i < count_; ++i) runs_[i].size = 0;
    for (Size y = 0; y < grid.height; ++y)
      for (Size i = rows_[y]; i < rows_[y + 1]; ++i) {
        const Run &run = runs_[i];
        const bool border = y == 0 || y == grid.height - 1 || run.first == 0 || run.end == grid.width;
        runs_[run.region].size += run.end - run.first + (holes && border ? area : 0);
      }
    for (Size y = 0; y < grid.height; ++y, plane += grid.pitch)
      for (Size i = rows_[y]; i < rows_[y + 1]; ++i)
        if (runs_[runs_[i].region].size < area) paint(plane, runs_[i].first, runs_[i].end, holes);
  }

 private:
  struct Run {
    std::int32_t first, end;
    std::int32_t region;
    Size size;  // of the region, stored at its root
  };

  void find(const Word *plane, const Grid &grid, bool holes) {
    count_ = 0;
    rows_.resize(grid.height + 1);
    Size above = 0;
    for (Size y = 0; y < grid.height; ++y, plane += grid.pitch) {
      const Size here = count_;
      rows_[y] = here;
      add_row(plane, grid, holes);
      join(above, here, holes ? 0 : 1);
      above = here;
    }
    rows_.back() = count_;
    for (Size i = 0; i < count_; ++i) runs_[i].region = runs_[runs_[i].region].region;
  }

  void add_row(const Word *row, const Grid &grid, bool holes) {
    const std::size_t most = count_ + grid.width / 2 + 1;
    if (most > runs_.size()) runs_.resize(2 * most);
    Word before = 0;
    Run *run = runs_.data() + count_;
    bool open = false;
    for (Size i = 0; i < grid.pitch; ++i) {
      const Word word = holes ? ~row[i] & grid.inside(i) : row[i];
      Word steps = word ^ (word << 1 | before);
      before = word >> 63;
      for (; steps; steps &= steps - 1) {
        const auto x = static_cast<std::int32_t>(i * 64 + lowest_bit(steps));
        if (!open) {
          run->first = x;
          run->region = static_cast<std::int32_t>(run - runs_.data());
        } else {
          (run++)->end = x;
        }
        open = !open;
      }
    }
    count_ = run - runs_.data();
  }

  std::int32_t root(std::int32_t run) {
    while (runs_[run].region != run) run = runs_[run].region = runs_[runs_[run].region].region;
    return run;
  }

  void join(Size above, Size here, std::int32_t reach) {
    const Size end = here;
    for (Size i = here; i < count_; ++i) {
      const Run run = runs_[i];
      while (above < end && runs_[above].end + reach <= run.first) ++above;
      for (Size j = above; j < end && runs_[j].first < run.end + reach; ++j) {
        const std::int32_t one = root(static_cast<std::int32_t>(i));
        const std::int32_t other = root(static_cast<std::int32_t>(j));
        runs_[std::max(one, other)].region = std::min(one, other);
      }
    }
  }

  static void paint(Word *row, Size first, Size end, bool on) {
    for (Size i = first / 64; i <= (end - 1) / 64; ++i) {
      Word bits = ALL;
      if (i == first / 64) bits &= ALL << first % 64;
      if (i == (end - 1) / 64) bits &= ALL >> (63 - (end - 1) % 64);
      row[i] = on ? row[i] | bits : row[i] & ~bits;
    }
  }

  std::vector<Run> runs_;  // of which the first count
  Size count_ = 0;
  std::vector<Size> rows_;
};

// ------------------------------------------------------------------------------------------- tiles

// A plane as tiles: pixel (y, x) of a tile is bit 8 * y + x. A background tile ends each row, and
// rows of background tiles lie above and below.
struct Tiles {
  Size rows = 0, columns = 0, pitch = 0;
  Words words;

  Size first(Size row) const { return (row + 1) * pitch + 1; }

  // Calls a function with the row, the column and the place of each tile that has foreground.
  template <class Visit>
  void visit(Visit visit) const {
    for (Size row = 0; row < rows; ++row)
      for (Size column = 0, i = first(row); column < columns; ++column, ++i)
        if (words[i]) visit(row, column, i);
  }
};

// Eight rows of a word <-> eight tiles: transposes a square of 8 x 8 bytes; it is its own inverse.
void transpose_bytes(Word square[8]) {
  for (int step = 4; step; step /= 2) {
    const int bits = 8 * step;
    const Word low = step == 4 ? 0x00000000ffffffff : step == 2 ? 0x0000ffff0000ffff : 0x00ff00ff00ff00ff;
    for (int i = 0; i < 8; ++i) {
      if (i & step) continue;
      const Word swap = (square[i] >> bits ^ square[i + step]) & low;
      square[i + step] ^= swap, square[i] ^= swap << bits;
    }
  }
}

void to_tiles(const Word *plane, const Grid &grid, Tiles &tiles) {
  tiles.rows = (grid.height + 7) / 8, tiles.columns = (grid.width + 7) / 8, tiles.pitch = tiles.columns + 1;
  tiles.words.assign((tiles.rows + 2) * tiles.pitch + 2, 0);
  for (Size row = 0; row < tiles.rows; ++row)
    for (Size i = 0; i < grid.pitch; ++i) {
      Word square[8] = {}, seen = 0;
      const Size lines = std::min<Size>(8, grid.height - 8 * row);
      for (Size y = 0; y < lines; ++y) seen |= square[y] = plane[(8 * row + y) * grid.pitch + i];
      if (!seen) continue;
      transpose_bytes(square);
      const Size count = std::min<Size>(8, tiles.columns - 8 * i);
      std::copy(square, square + count, &tiles.words[tiles.first(row) + 8 * i]);
    }
}

// The eight neighbours of each pixel of a tile, p2 to p9 in the thinning papers.
struct Ring {
  Word n, ne, e, se, s, sw, w, nw;
};

// A tile and those around it, in reading order.
using Nine = std::array<Word, 9>;

SSRVLAD_INLINE Nine nine_at(const Word *tile, Size pitch) {
  return {tile[-pitch - 1], tile[-pitch],     tile[-pitch + 1], tile[-1],       tile[0],
          tile[1],          tile[pitch - 1],  tile[pitch],      tile[pitch + 1]};
}

SSRVLAD_INLINE Ring ring_of(const Nine &nine) {
  const auto [a, b, c, d, here, f, g, h, i] = nine;
  const auto west = [](Word left, Word middle) { return (middle & ~RIGHT) << 1 | (left & RIGHT) >> 7; };
  const auto east = [](Word middle, Word right) { return (middle & ~LEFT) >> 1 | (right & LEFT) << 7; };
  const Word north_of_left = d << 8 | a >> 56, north = here << 8 | b >> 56;
  const Word north_of_right = f << 8 | c >> 56;
  const Word south_of_left = d >> 8 | g << 56, south = here >> 8 | h << 56;
  const Word south_of_right = f >> 8 | i << 56;
  return {north,           east(north, north_of_right), east(here, f), east(south, south_of_right),
          south,           west(south_of_left, south),  west(d, here), west(north_of_left, north)};
}

// The 0 -> 1 steps around each pixel, at most one in each quarter of the ring, as four planes.
struct Steps {
  Word a, b, c, d;
};

SSRVLAD_INLINE Steps steps_around(const Ring &r) {
  return {(r.ne | r.e) & ~(r.n & r.ne), (r.se | r.s) & ~(r.e & r.se),
          (r.sw | r.w) & ~(r.s & r.sw), (r.nw | r.n) & ~(r.w & r.nw)};
}

SSRVLAD_INLINE Word exactly_one(Word a, Word b, Word c, Word d) {
  return (a | b | c | d) & ~((a & b) | (c & d) | ((a | b) & (c | d)));
}

SSRVLAD_INLINE Word two_or_more(Word a, Word b, Word c, Word d) {
  return (a & b) | (c & d) | ((a | b) & (c | d));
}

// ---------------------------------------------------------------------------------------- thinning

// Pixels that a sub-iteration of Zhang & Suen, CACM 27(3), 1984, deletes: A = 1, 2 <= B <= 6 and two
// products are zero. stages/skeleton.py shows why B is not counted.
template <bool FIRST>
SSRVLAD_INLINE Word zhang_suen(Word here, const Ring &r) {
  const Steps s = steps_around(r);
  const Word north_west = r.n | r.w, south_east = r.e | r.s;
  const Word two_on = (north_west | south_east) & (r.ne | r.se | r.sw | r.nw);
  const Word needed = FIRST ? r.e & r.s & north_west : r.n & r.w & south_east;
  const Word seven_on = FIRST ? r.se & ((r.ne & ~r.e) | (r.sw & ~r.s))
                              : r.nw & ((r.sw & ~r.w) | (r.ne & ~r.n));
  return here & exactly_one(s.a, s.b, s.c, s.d) & two_on & ~(needed | seven_on);
}

// The same for algorithm A1 of Guo & Hall, CACM 32(3), 1989: C = 1, 2 <= N <= 3, a zero product.
template <bool FIRST>
SSRVLAD_INLINE Word guo_hall(Word here, const Ring &r) {
  const Word one_group = exactly_one(~r.n & (r.ne | r.e), ~r.e & (r.se | r.s),
                                     ~r.s & (r.sw | r.w), ~r.w & (r.nw | r.n));
  const Word a = r.nw | r.n, b = r.ne | r.e, c = r.se | r.s, d = r.sw | r.w;
  const Word e = r.n | r.ne, f = r.e | r.se, g = r.s | r.sw, h = r.w | r.nw;
  const Word two_at_least = two_or_more(a, b, c, d) & two_or_more(e, f, g, h);
  const Word three_at_most = ~((a & b & c & d) & (e & f & g & h));
  const Word needed = FIRST ? (r.n | r.ne | ~r.se) & r.e : (r.s | r.sw | ~r.nw) & r.w;
  return here & one_group & two_at_least & three_at_most & ~needed;
}

constexpr Size BLOCK = 128;
using Block = std::array<std::array<Word, BLOCK>, 9>;

template <Word (*RULE)(Word, const Ring &)>
SSRVLAD_INLINE void delete_from(const Block &t, Word *gone) {
  for (Size i = 0; i < BLOCK; ++i)
    gone[i] = RULE(t[4][i], ring_of({t[0][i], t[1][i], t[2][i], t[3][i], t[4][i], t[5][i], t[6][i], t[7][i], t[8][i]}));
}

void delete_pixels(const Block &around, int thinning, bool first, Word *gone) {
  on_cpu([=, &around](auto) {
    if (thinning == SSRVLAD_ZHANG_SUEN) {
      if (first) delete_from<zhang_suen<true>>(around, gone);
      else delete_from<zhang_suen<false>>(around, gone);
    } else {
      if (first) delete_from<guo_hall<true>>(around, gone);
      else delete_from<guo_hall<false>>(around, gone);
    }
  });
}

// Thins tiles until nothing changes. A sub-iteration processes only tiles in which a pixel or a
// neighbour of one changed in the two sub-iterations before.
class Thinning {
 public:
  void thin(Tiles &tiles, int thinning) {
    start(tiles);
    for (int kind = 0; due_[0].size() + due_[1].size(); kind ^= 1) {
      std::swap(due_[kind], now_);
      due_[kind].clear();
      const auto count = static_cast<Size>(now_.size());
      for (const Size place : now_) waiting_[place] &= static_cast<std::uint8_t>(~(1 << kind));
      for (Size i = 0; i < count; i += BLOCK) look_at(tiles, i, thinning, kind == 0);
      for (Size i = 0; i < count; ++i)
        if (gone_[i]) take(tiles, now_[i], gone_[i]);
    }
  }

 private:
  // At first all tiles with foreground are due, except full tiles among full tiles.
  void start(const Tiles &tiles) {
    waiting_.assign(tiles.words.size(), 0);
    gone_.resize(tiles.words.size() + BLOCK);
    tiles.visit([&](Size, Size, Size i) {
      Word all = ALL;
      for (const Word tile : nine_at(&tiles.words[i], tiles.pitch)) all &= tile;
      if (all != ALL) call(tiles, i);
    });
  }

  SSRVLAD_INLINE void call(const Tiles &tiles, Size place) {
    if (!tiles.words[place]) return;
    for (const int kind : {0, 1})
      if (!(waiting_[place] >> kind & 1)) due_[kind].push_back(static_cast<std::uint32_t>(place));
    waiting_[place] = 3;
  }

  void look_at(const Tiles &tiles, Size from, int thinning, bool first) {
    const Size count = std::min(BLOCK, static_cast<Size>(now_.size()) - from), pitch = tiles.pitch;
    for (Size i = 0; i < count; ++i) {
      const Word *tile = &tiles.words[now_[from + i]];
      std::size_t k = 0;
      for (const Size row : {-pitch, Size{0}, pitch})
        for (const Size column : {-1, 0, 1}) block_[k++][i] = tile[row + column];
    }
    delete_pixels(block_, thinning, first, &gone_[from]);
  }

  void take(Tiles &tiles, Size place, Word gone) {
    tiles.words[place] &= ~gone;
    const Size above = place - tiles.pitch, below = place + tiles.pitch;
    call(tiles, place);
    if (gone & TOP) call(tiles, above);
    if (gone & BOTTOM) call(tiles, below);
    if (gone & LEFT) {
      call(tiles, place - 1);
      if (gone & LEFT & TOP) call(tiles, above - 1);
      if (gone & LEFT & BOTTOM) call(tiles, below - 1);
    }
    if (gone & RIGHT) {
      call(tiles, place + 1);
      if (gone & RIGHT & TOP) call(tiles, above + 1);
      if (gone & RIGHT & BOTTOM) call(tiles, below + 1);
    }
  }

  std::vector<std::uint32_t> due_[2], now_;
  std::vector<std::uint8_t> waiting_;  // bit 0, bit 1: due in the next first, second sub-iteration
  Words gone_;
  Block block_{};
};

// --------------------------------------------------------------------------------------- keypoints

// End points have at most one neighbour. Intersections have three or more steps around them, and no
// such pixel to the W, NW, N or NE.
void find_keypoints(const Tiles &skeleton, Tiles &keypoints, Tiles &crossings) {
  keypoints = skeleton, crossings = skeleton;
  skeleton.visit([&](Size, Size, Size i) {
    const Ring r = ring_of(nine_at(&skeleton.words[i], skeleton.pitch));
    Word seen = 0, again = 0;
    for (const Word beside : {r.n, r.ne, r.e, r.se, r.s, r.sw, r.w, r.nw}) again |= seen & beside, seen |= beside;
    keypoints.words[i] &= ~again;
    const auto [a, b, c, d] = steps_around(r);
    crossings.words[i] &= (a & b & (c | d)) | (c & d & (a | b));
  });
  crossings.visit([&](Size, Size, Size i) {
    const Ring r = ring_of(nine_at(&crossings.words[i], crossings.pitch));
    keypoints.words[i] |= crossings.words[i] & ~(r.w | r.nw | r.n | r.ne);
  });
}

// -------------------------------------------------------- residuals around shape contexts (Eq. 1, 2)

struct Point {
  std::int32_t y, x;
};

void points_of(const Tiles &tiles, std::vector<Point> &points) {
  points.clear();
  tiles.visit([&](Size row, Size column, Size i) {
    for (Word word = tiles.words[i]; word; word &= word - 1) {
      const int bit = lowest_bit(word);
      points.push_back({static_cast<std::int32_t>(8 * row + bit / 8), static_cast<std::int32_t>(8 * column + bit % 8)});
    }
  });
}

// The centroid of a layer's pixels, rounded to the nearest pixel, halves up (Eq. 1).
bool centroid(const Word *plane, const Grid &grid, Point &centre) {
  Size area = 0, sum_y = 0, sum_x = 0;
  for (Size y = 0; y < grid.height; ++y, plane += grid.pitch)
    for (Size i = 0; i < grid.pitch; ++i) {
      const Word word = plane[i];
      if (!word) continue;
      // HALVES[b] masks the pixels whose x has bit b: their number times 2 ** b is summed over b.
      static constexpr Word HALVES[6] = {0xaaaaaaaaaaaaaaaa, 0xcccccccccccccccc, 0xf0f0f0f0f0f0f0f0,
                                         0xff00ff00ff00ff00, 0xffff0000ffff0000, 0xffffffff00000000};
      const Size count = count_bits(word);
      area += count, sum_y += y * count, sum_x += 64 * i * count;
      if (word == ALL) sum_x += 63 * 32;
      else
        for (int b = 0; b < 6; ++b) sum_x += Size{count_bits(word & HALVES[b])} << b;
    }
  if (!area) return false;
  centre.y = static_cast<std::int32_t>((2 * sum_y + area) / (2 * area));
  centre.x = static_cast<std::int32_t>((2 * sum_x + area) / (2 * area));
  return true;
}

// The bin of every offset in an image: ring * sectors + sector, or `total` if it is in no bin. The
// bin of the offset (dy, dx) is at `centre + dy * pitch + dx`.
struct Bins {
  Size height, width, pitch, centre;
  int total;
  std::vector<std::uint16_t> table;

  Bins(Size height, Size width, const std::vector<Size> &limits, int sectors)
      : height(height), width(width), pitch(2 * width - 1), centre((height - 1) * pitch + width - 1),
        total(static_cast<int>(limits.size()) * sectors),
        table((2 * height - 1) * pitch, static_cast<std::uint16_t>(total)) {
    for (Size dy = 1 - height; dy < height; ++dy)
      for (Size dx = 1 - width; dx < width; ++dx) {
        const Size squared = dy * dy + dx * dx;
        if (squared == 0 || squared > limits.back()) continue;
        int ring = 0;
        while (squared > limits[ring]) ++ring;
        table[centre + dy * pitch + dx] = static_cast<std::uint16_t>(ring * sectors + sector_of(dy, dx, sectors));
      }
  }

  // Sector m begins at the angle 2 pi m / M, from +x towards +y. Integer offsets lie on a boundary
  // only at multiples of 45 degrees; all others are farther from one than the added 1e-12.
  static int sector_of(Size dy, Size dx, int sectors) {
    const double turn = std::atan2(static_cast<double>(dy), static_cast<double>(dx)) / (2 * PI);
    const int sector = static_cast<int>(std::floor(turn * sectors + 1e-12));
    return (sector % sectors + sectors) % sectors;
  }
};

// Adds the number of context points in each bin around a reference point. Two counts per bin, to be
// summed later, are faster: successive points are often in the same bin.
void shape_context(Point reference, const std::vector<Point> &context, const Bins &bins, std::vector<Size> &counts) {
  const std::uint16_t *table = bins.table.data() + bins.centre - reference.y * bins.pitch - reference.x;
  const auto bin = [&](std::size_t i) { return table[context[i].y * bins.pitch + context[i].x]; };
  std::size_t i = 0;
  Size *const first = counts.data(), *const second = first + bins.total + 1;
  for (; i + 1 < context.size(); i += 2) ++first[bin(i)], ++second[bin(i + 1)];
  if (i < context.size()) ++first[bin(i)];
}

void normalise(double *values, Size count) {
  double squares = 0;
  for (Size i = 0; i < count; ++i) squares += values[i] * values[i];
  const double norm = std::max(std::sqrt(squares), 1e-12);  // zeros stay zeros
  for (Size i = 0; i < count; ++i) values[i] /= norm;
}

// -------------------------------------------- harmonics around the vanishing column (not in the paper)

// The column towards which ground, sidewalk and sky leave the view open, minus the middle column.
Size vanishing_column(const Word *planes, const Grid &grid, std::vector<Size> &open) {
  constexpr Size LEVELS = 64, ONE = Size{1} << 20, PULL = 20;
  constexpr int SHIFT = 6 * 8 - 20;
  open.assign(grid.width, 0);
  for (Size y = 0; y < grid.height; ++y)
    for (Size x = 0; x < grid.width; x += 64) {
      const Size i = y * grid.pitch + x / 64;
      const Word word = planes[i] | planes[grid.words() + i] | planes[5 * grid.words() + i];
      const Size count = std::min<Size>(64, grid.width - x);
      for (Size j = 0; j < count; ++j) open[x + j] += word >> j & 1;
    }
  Size moment = 0, total = grid.width * ONE / PULL;
  for (Size x = 0; x < grid.width; ++x) {
    const Size level = open[x] * LEVELS / grid.height;
    const Size squared = level * level, fourth = squared * squared;
    const Size weight = fourth * fourth >> SHIFT;
    moment += weight * (2 * x - (grid.width - 1)), total += weight;
  }
  const Size twice_from_left = moment + total + 2 * total * grid.width;  // nothing negative is divided
  return twice_from_left / (2 * total) - grid.width;
}

using Cells = std::array<double, CELLS>;

// The fraction of each of 24 x 32 cells that a layer covers, with the image moved left by `shift`
// columns. In integers up to the division: a row of W pixels has W * 32 units, a cell has W.
bool pool(const Word *plane, const Grid &grid, Size shift, Cells &cells) {
  std::array<Size, CELLS> sums{};
  std::array<Size, CELL_COLUMNS + 1> bounds;
  const Size units = grid.width * CELL_COLUMNS;
  for (Size c = 0; c <= CELL_COLUMNS; ++c)
    bounds[c] = std::max<Size>(0, std::min(units, c * grid.width + shift * CELL_COLUMNS));
  bool seen = false;
  for (Size y = 0; y < grid.height; ++y, plane += grid.pitch) {
    if (!any(plane, grid.pitch)) continue;
    seen = true;
    std::array<Size, CELL_COLUMNS> across;
    Size word = 0, before_word = 0, before = 0;
    for (std::size_t c = 0; c <= CELL_COLUMNS; ++c) {
      const Size x = bounds[c] / CELL_COLUMNS, part = bounds[c] % CELL_COLUMNS;
      for (; word < x / 64; ++word) before_word += count_bits(plane[word]);
      const Word here = plane[word] >> x % 64;
      const Size up_to = before_word + count_bits(plane[word] ^ here << x % 64);
      const Size reached = up_to * CELL_COLUMNS + (here & 1 ? part : 0);
      if (c) across[c - 1] = reached - before;
      before = reached;
    }
    const Size top = y * CELL_ROWS, bottom = top + CELL_ROWS;
    for (Size row = top / grid.height; row * grid.height < bottom; ++row) {
      const Size overlap = std::min(bottom, (row + 1) * grid.height) - std::max(top, row * grid.height);
      Size *sum = &sums[row * CELL_COLUMNS];
      for (std::size_t c = 0; c < CELL_COLUMNS; ++c) sum[c] += overlap * across[c];
    }
  }
  const auto area = static_cast<double>(grid.height * grid.width);
  for (std::size_t i = 0; i < CELLS; ++i) cells[i] = static_cast<double>(sums[i]) / area;
  return seen;
}

// Merges eight layers into six: guard rail counts as building, parking as ground.
void merge(Word *planes, const Grid &grid) {
  for (Size i = 0; i < grid.words(); ++i) {
    planes[i] |= planes[7 * grid.words() + i];
    planes[2 * grid.words() + i] |= planes[6 * grid.words() + i];
  }
}

// Adds the boundary pixels of a layer to four planes: vertical, horizontal, rising to the right,
// falling. A pixel's four diagonal neighbours decide; pixels at the edge of the image have none.
void add_boundaries(const Word *plane, const Grid &grid, Word *boundaries) {
  for (Size y = 1; y + 1 < grid.height; ++y)
    for (Size i = 0; i < grid.pitch; ++i) {
      const auto west = [&](const Word *row) { return row[i] << 1 | (i ? row[i - 1] >> 63 : 0); };
      const auto east = [&](const Word *row) { return row[i] >> 1 | (i + 1 < grid.pitch ? row[i + 1] << 63 : 0); };
      const Word *above = plane + (y - 1) * grid.pitch, *below = plane + (y + 1) * grid.pitch;
      const Word nw = west(above), ne = east(above), sw = west(below), se = east(below);
      const Word n = nw ^ ne, s = sw ^ se, w = nw ^ sw, e = ne ^ se;
      const Word seen = grid.inside(i) & (i ? ALL : ~Word{1}) &
                        ~(i == (grid.width - 1) / 64 ? Word{1} << (grid.width - 1) % 64 : 0);
      Word *here = boundaries + y * grid.pitch + i;
      here[0] |= n & s & ~(w | e) & seen;
      here[grid.words()] |= w & e & ~(n | s) & seen;
      here[2 * grid.words()] |= ((n & w & ~(s | e)) | (s & e & ~(n | w))) & seen;
      here[3 * grid.words()] |= ((n & e & ~(s | w)) | (s & w & ~(n | e))) & seen;
    }
}

// A number of a table. The last bits of <cmath> differ between platforms, and coefficients that are
// zero but for them would differ visibly; numbers of 40 binary places are the same everywhere.
double steady(double number) {
  constexpr double UNIT = 1.0 / (Size{1} << 40);
  return std::nearbyint(number / UNIT) * UNIT;
}

// Soft bins, as the weights of each cell in the bins it counts in. Ring n is centred on
// radius * inner_radius ** (1 - n / (N - 1)) of the diagonal, sector m on the angle 2 pi m / M; each of
// 4 x 4 samples of a cell is shared linearly by the two nearest rings and the two nearest sectors.
struct SoftBins {
  struct Entry {
    std::size_t bin;
    double weight;
  };
  std::size_t total;
  std::array<std::vector<Entry>, CELLS> entries;

  explicit SoftBins(const ssrvlad_settings &s) : total(s.rings * s.sectors) {
    constexpr int SAMPLES = 4;
    std::vector<Cells> weights(total, Cells{});
    for (int i = 0; i < CELL_ROWS * SAMPLES; ++i)
      for (int j = 0; j < CELL_COLUMNS * SAMPLES; ++j) {
        const double y = (i + 0.5) / SAMPLES - CELL_ROWS / 2.0;
        const double x = (j + 0.5) / SAMPLES - CELL_COLUMNS / 2.0;
        const double distance = std::hypot(y, x) / std::hypot(CELL_ROWS, CELL_COLUMNS);
        if (distance > s.radius) continue;
        const double steps = s.inner_radius < 1 ? std::log(distance / s.radius) / std::log(1 / s.inner_radius) : -1;
        const double ring = std::max(0.0, std::min<double>(s.rings - 1, (s.rings - 1) * (1 + steps)));
        const double turn = std::atan2(y, x) / (2 * PI);
        const double sector = (turn - std::floor(turn)) * s.sectors;
        for (int n = 0; n < s.rings; ++n)
          for (int m = 0; m < s.sectors; ++m) {
            const double apart = std::abs(sector - m);
            const double in_ring = std::max(0.0, 1 - std::abs(ring - n));
            const double in_sector = std::max(0.0, 1 - apart) + std::max(0.0, 1 - (s.sectors - apart));
            const int cell = i / SAMPLES * CELL_COLUMNS + j / SAMPLES;
            weights[n * s.sectors + m][cell] += in_ring * in_sector;
          }
      }
    for (std::size_t bin = 0; bin < total; ++bin) {
      double sum = 0;
      for (const double weight : weights[bin]) sum += weight;
      for (std::size_t cell = 0; cell < CELLS; ++cell)
        if (weights[bin][cell] > 0)
          entries[cell].push_back({bin, steady(weights[bin][cell] / std::max(sum, 1e-12))});
    }
  }

  void means(const Cells &cells, std::vector<double> &bins) const {
    bins.assign(total, 0);
    for (std::size_t cell = 0; cell < CELLS; ++cell)
      if (cells[cell] > 0)
        for (const Entry &entry : entries[cell]) bins[entry.bin] += entry.weight * cells[cell];
  }
};

// The smoothest waves over the bins, as the value of every wave in each bin. A wave is a cosine over
// the rings with u / 2 periods times a wave around the centre with v periods. Its length is
// (1 + f ** 2) ** (spectral_weight / 2), with f ** 2 = u ** 2 + v ** 2.
std::vector<double> harmonic_basis(const ssrvlad_settings &s) {
  std::vector<std::array<int, 4>> waves;  // f ** 2, u, v, sine
  for (int u = 0; u < s.rings; ++u)
    for (int v = 0; v < (s.sectors + 1) / 2; ++v)
      for (int sine = 0; sine <= (v ? 1 : 0); ++sine) waves.push_back({u * u + v * v, u, v, sine});
  std::sort(waves.begin(), waves.end());
  waves.resize(std::max(s.harmonics, s.boundary_harmonics));
  const std::size_t total = s.rings * s.sectors;
  std::vector<double> basis(total * waves.size()), wave;
  for (std::size_t i = 0; i < waves.size(); ++i) {
    const auto &[squared, u, v, sine] = waves[i];
    wave.clear();
    for (int n = 0; n < s.rings; ++n)
      for (int m = 0; m < s.sectors; ++m) {
        const double angle = v * (m * (2 * PI / s.sectors)) - (sine ? PI / 2 : 0.0);
        wave.push_back(std::cos(PI * u * (n + 0.5) / s.rings) * std::cos(angle));
      }
    normalise(wave.data(), static_cast<Size>(wave.size()));
    const double length = std::pow(1.0 + squared, s.spectral_weight / 2);
    for (std::size_t bin = 0; bin < total; ++bin) basis[bin * waves.size() + i] = steady(wave[bin] * length);
  }
  return basis;
}

// ------------------------------------------------------------------------------------------ a head

// A fraction of the image in pixels, rounded as in SSRVLADConfig.
Size parts(double fraction, double unit) { return static_cast<Size>(std::nearbyint(fraction * unit)); }
Size rounded(Size numerator, Size denominator) { return (2 * numerator + denominator) / (2 * denominator); }

Size radius_pixels(double fraction, const Grid &grid) {
  return rounded(parts(fraction, 1e6) * std::min(grid.height, grid.width), 1000000);
}

Size area_pixels(double fraction, const Grid &grid) {
  return (parts(fraction, 1e6) * grid.height * grid.width + 999999) / 1000000;
}

// The working memory of one thread.
struct Scratch {
  Words layers, clean, boundaries, buffer;
  Regions regions;
  Tiles tiles, keypoints, crossings;
  Thinning thinning;
  std::vector<Point> references, context;
  std::vector<Size> around_points, around_centre, columns;
  std::vector<double> values, histogram;
};

// Calls `visit` with the ids of the batch as a pointer of their type.
template <class Visit>
auto with_ids(const ssrvlad_labels &labels, Visit visit) {
  switch (labels.bytes) {
    case 1: return visit(static_cast<const std::uint8_t *>(labels.ids));
    case 2: return visit(static_cast<const std::int16_t *>(labels.ids));
    case 4: return visit(static_cast<const std::int32_t *>(labels.ids));
    default: return visit(static_cast<const std::int64_t *>(labels.ids));
  }
}

// Settings, with their tables and the working memory of threads.
class Head {
 public:
  const std::string fingerprint;

  explicit Head(const ssrvlad_settings &settings) : fingerprint(fingerprint_of(settings)), settings(settings) {
    if (settings.aggregation == SSRVLAD_RESIDUALS) return;
    soft_bins = std::make_unique<SoftBins>(settings);
    basis = harmonic_basis(settings);
  }

  Size length() const {
    if (settings.aggregation == SSRVLAD_RESIDUALS)
      return LAYERS * Size{settings.rings * settings.sectors};
    return AREA_LAYERS * Size{settings.harmonics} + DIRECTIONS * Size{settings.boundary_harmonics};
  }

  // Returns the number of pixels with an unknown id; unless it is 0, the descriptors are undefined.
  Size describe(const ssrvlad_labels &labels, const ssrvlad_table &table, int threads, float *descriptors) {
    const Lookup<Word> ballots(table, ballot_of);
    const Lookup<std::uint16_t> layers(table, layer_of);
    const Grid grid = this->grid(labels.height, labels.width);
    const Size size = labels.height * labels.width;
    const bool is_whole = grid.height == labels.height && grid.width == labels.width;
    std::atomic<bool> all_known{true};
    return with_ids(labels, [&](const auto *ids) {
      in_parallel(labels.images, threads, [&](std::atomic<Size> &next) {
        auto scratch = take_scratch();
        for (Size i; all_known && (i = next++) < labels.images;) {
          scratch->layers.resize(LAYERS * grid.words());
          Word *planes = scratch->layers.data();
          if (is_whole ? split(ids + i * size, grid, layers, planes)
                       : vote(ids + i * size, labels.height, labels.width, ballots, grid, planes))
            describe(*scratch, grid, descriptors + i * length());
          else all_known = false;
        }
        give_back(std::move(scratch));
      });
      Size unknown = 0;
      for (Size i = 0; !all_known && i < labels.images * size; ++i) unknown += layers[as_id(ids[i])] == UNKNOWN_LAYER;
      return unknown;
    });
  }

 private:
  Grid grid(Size height, Size width) const {
    const Size shorter = std::min(height, width), size = settings.working_size;
    if (size == 0 || size >= shorter) return {height, width};
    return {rounded(height * size, shorter), rounded(width * size, shorter)};
  }

  // Computes the descriptor of one image from its layers.
  void describe(Scratch &s, const Grid &grid, float *descriptor) {
    s.values.assign(length(), 0);
    if (settings.aggregation == SSRVLAD_RESIDUALS) residuals(s, grid);
    else harmonics(s, grid);
    normalise(s.values.data(), length());
    for (const double value : s.values) *descriptor++ = static_cast<float>(value);
  }

  std::unique_ptr<Scratch> take_scratch() {
    const std::lock_guard<places::Mutex> hold(mutex);
    if (spare.empty()) return std::make_unique<Scratch>();
    auto scratch = std::move(spare.back());
    spare.pop_back();
    return scratch;
  }

  void give_back(std::unique_ptr<Scratch> scratch) {
    const std::lock_guard<places::Mutex> hold(mutex);
    spare.push_back(std::move(scratch));
  }

  void clean(Scratch &s, const Grid &grid) {
    const Size opening = radius_pixels(settings.opening, grid);
    const Size closing = radius_pixels(settings.closing, grid);
    const Size hole = area_pixels(settings.hole_area, grid);
    const Size region = area_pixels(settings.region_area, grid);
    s.clean = s.layers;
    for (int k = 0; k < LAYERS; ++k) {
      Word *plane = s.clean.data() + k * grid.words();
      if (!any(plane, grid.words())) continue;
      erode(plane, grid, opening, s.buffer);
      dilate(plane, grid, opening, s.buffer);
      dilate(plane, grid, closing, s.buffer);
      erode(plane, grid, closing, s.buffer);
      s.regions.repaint(plane, grid, hole, true);
      s.regions.repaint(plane, grid, region, false);
    }
  }

  void residuals(Scratch &s, const Grid &grid) {
    const std::shared_ptr<const Bins> bins = bins_of(grid);
    clean(s, grid);
    for (int k = 0; k < LAYERS; ++k) {
      const Word *plane = s.clean.data() + k * grid.words();
      Point centre;
      if (!centroid(plane, grid, centre)) continue;
      to_tiles(plane, grid, s.tiles);
      s.thinning.thin(s.tiles, settings.thinning);
      find_keypoints(s.tiles, s.keypoints, s.crossings);
      points_of(s.keypoints, s.references);
      points_of(s.tiles, s.context);
      const auto &context = settings.context == SSRVLAD_SKELETON ? s.context : s.references;
      const auto half = bins->total + 1;
      s.around_points.assign(2 * half, 0);
      s.around_centre = s.around_points;
      for (const Point &point : s.references) shape_context(point, context, *bins, s.around_points);
      shape_context(centre, context, *bins, s.around_centre);
      double *vector = s.values.data() + Size{k} * bins->total;
      const auto number = static_cast<Size>(s.references.size());
      for (int bin = 0; bin < bins->total; ++bin) {  // Eq. 2
        const Size points = s.around_points[bin] + s.around_points[half + bin];
        const Size around_it = s.around_centre[bin] + s.around_centre[half + bin];
        vector[bin] = static_cast<double>(points - number * around_it);
      }
      normalise(vector, bins->total);
    }
  }

  void harmonics(Scratch &s, const Grid &grid) {
    const Size words = grid.words();
    merge(s.layers.data(), grid);
    const bool moved = settings.anchor == SSRVLAD_VANISHING_COLUMN;
    const Size shift = moved ? vanishing_column(s.layers.data(), grid, s.columns) : 0;
    s.boundaries.assign(DIRECTIONS * words, 0);
    double *held = s.values.data();
    for (int k = 0; k < AREA_LAYERS; ++k, held += settings.harmonics) {
      const Word *layer = s.layers.data() + k * words;
      if (!any(layer, words)) continue;
      add_boundaries(layer, grid, s.boundaries.data());
      coefficients(s, layer, grid, shift, 1, settings.harmonics, held);
    }
    const auto side = static_cast<double>(std::min(grid.height, grid.width)) / CELL_ROWS;
    for (int d = 0; d < DIRECTIONS; ++d, held += settings.boundary_harmonics)
      coefficients(s, s.boundaries.data() + d * words, grid, shift, side / BOUNDARY_WIDTH,
                   settings.boundary_harmonics, held);
  }

  // The part of the descriptor for one plane: the weighted coefficients of its soft histogram.
  void coefficients(Scratch &s, const Word *plane, const Grid &grid, Size shift, double unit,
                    int count, double *held) {
    Cells cells;
    if (!pool(plane, grid, shift, cells)) return;
    for (double &cell : cells) cell *= unit;
    soft_bins->means(cells, s.histogram);
    const std::size_t waves = basis.size() / soft_bins->total;
    for (std::size_t bin = 0; bin < soft_bins->total; ++bin) {
      const double there = std::sqrt(s.histogram[bin]);
      const double *wave = basis.data() + bin * waves;
      for (int i = 0; i < count; ++i) held[i] += there * wave[i];
    }
    for (int i = 0; i < count; ++i)
      held[i] *= std::pow(held[i] / FAINT * (held[i] / FAINT) + 1, (settings.power - 1) / 2);
  }

  // Bins for an image size; those of the last few sizes are cached.
  std::shared_ptr<const Bins> bins_of(const Grid &grid) {
    constexpr std::size_t KEPT = 4;
    const std::lock_guard<places::Mutex> hold(mutex);
    for (const auto &bins : known_bins)
      if (bins->height == grid.height && bins->width == grid.width) return bins;
    known_bins.push_front(std::make_shared<Bins>(grid.height, grid.width, ring_limits(grid), settings.sectors));
    if (known_bins.size() > KEPT) known_bins.pop_back();
    return known_bins.front();
  }

  std::vector<Size> ring_limits(const Grid &grid) const {
    const Size diagonal = grid.height * grid.height + grid.width * grid.width;
    std::vector<Size> limits;
    for (int ring = 0; ring < settings.rings; ++ring) {
      const double step = settings.rings > 1 ? 1 - ring / (settings.rings - 1.0) : 0.0;
      const double radius = settings.radius * std::pow(settings.inner_radius, step);
      limits.push_back(parts(radius * radius, 1e9) * diagonal / 1000000000);
    }
    return limits;
  }

  ssrvlad_settings settings;
  std::unique_ptr<SoftBins> soft_bins;
  std::vector<double> basis;
  places::Mutex mutex;
  std::vector<std::unique_ptr<Scratch>> spare;
  std::list<std::shared_ptr<const Bins>> known_bins;
};

// -------------------------------------------------------------------------------------- ssrvlad.h

thread_local char last_error[256];

constexpr Size MOST_PIXELS = Size{1} << 31, MOST_BYTES = Size{1} << 58;

void check(const ssrvlad_settings *settings) {
  require(settings, "settings");
  const ssrvlad_settings &s = *settings;
  require_range("opening", s.opening, 0, 0.5);
  require_range("closing", s.closing, 0, 0.5);
  require_range("hole_area", s.hole_area, 0, 1);
  require_range("region_area", s.region_area, 0, 1);
  require_range("radius", s.radius, 1e-300, 1);
  require_range("inner_radius", s.inner_radius, 1e-300, 1);
  require_range("spectral_weight", s.spectral_weight, 0, 4);
  require_range("power", s.power, 0.5, 1);
  require_range("working_size", s.working_size, 0, 1 << 14);
  require_range("rings", s.rings, 1, 64);
  require_range("sectors", s.sectors, 1, 360);
  require_range("thinning", s.thinning, SSRVLAD_ZHANG_SUEN, SSRVLAD_GUO_HALL);
  require_range("context", s.context, SSRVLAD_SKELETON, SSRVLAD_KEYPOINTS);
  require_range("aggregation", s.aggregation, SSRVLAD_RESIDUALS, SSRVLAD_HARMONICS);
  require_range("anchor", s.anchor, SSRVLAD_VANISHING_COLUMN, SSRVLAD_MIDDLE);
  const bool unused = s.aggregation == SSRVLAD_RESIDUALS;
  const int most = unused ? 1 << 12 : s.rings * (2 * ((s.sectors + 1) / 2) - 1);
  require_range("harmonics", s.harmonics, 1, std::min(most, 1 << 12));
  require_range("boundary_harmonics", s.boundary_harmonics, 1, std::min(most, 1 << 12));
}

void check(const ssrvlad_labels *labels, const ssrvlad_table *table) {
  require(labels && table, "label maps and a table");
  const auto [ids, bytes, images, height, width] = *labels;
  require(ids, "images");
  if (images < 1 || height < 1 || width < 1 || height >= MOST_PIXELS / width ||
      images > MOST_BYTES / 8 / height / width)
    refuse("expected images of up to 2^31 pixels, got %lld of %lld x %lld", static_cast<long long>(images),
           static_cast<long long>(height), static_cast<long long>(width));
  if (bytes != 1 && bytes != 2 && bytes != 4 && bytes != 8)
    refuse("expected ids of 1, 2, 4 or 8 bytes, got %d", bytes);
  require(table->categories && table->entries > 0 && table->origin >= 0 && table->origin < table->entries,
          "a table of categories with its origin among its entries");
}

}  // namespace

void places::refuse(const char *reason, ...) {
  std::va_list values;
  va_start(values, reason);
  std::vsnprintf(last_error, sizeof last_error, reason, values);
  va_end(values);
  throw Refused();
}

void places::say(const char *reason) { std::snprintf(last_error, sizeof last_error, "%s", reason); }

struct ssrvlad_head : Head {
  using Head::Head;
};

#ifndef SSRVLAD_SOURCE
#define SSRVLAD_SOURCE ""
#endif

const char *ssrvlad_last_error(void) { return last_error; }

const char *ssrvlad_source(void) { return SSRVLAD_SOURCE; }

const char *ssrvlad_simd(void) { return simd_name(); }

int ssrvlad_interface(void) { return SSRVLAD_INTERFACE; }

int ssrvlad_preset(const char *name, ssrvlad_settings *settings) {
  return guarded([&] {
    require(name && settings, "the name of a preset and settings");
    const bool paper = !std::strcmp(name, "paper");
    if (!paper && std::strcmp(name, "default")) refuse("expected the preset default or paper, got %s", name);
    ssrvlad_settings s{};
    s.opening = 0.0, s.closing = 0.01, s.hole_area = 0.002, s.region_area = 0.0005;
    s.radius = 0.5, s.inner_radius = paper ? 1.0 / 16 : 1.0 / 6;
    s.spectral_weight = 1.0, s.power = 0.75;
    s.working_size = paper ? 0 : 120;
    s.rings = paper ? 5 : 6, s.sectors = paper ? 12 : 20;
    s.harmonics = 64, s.boundary_harmonics = 24;
    s.thinning = SSRVLAD_ZHANG_SUEN, s.context = SSRVLAD_SKELETON;
    s.aggregation = paper ? SSRVLAD_RESIDUALS : SSRVLAD_HARMONICS;
    s.anchor = SSRVLAD_VANISHING_COLUMN;
    *settings = s;
  });
}

ssrvlad_head *ssrvlad_new_for(int program, const ssrvlad_settings *settings) {
  return made(program, [&] {
    check(settings);
    return new ssrvlad_head(*settings);
  });
}

void ssrvlad_free(ssrvlad_head *head) { delete head; }

int64_t ssrvlad_length(const ssrvlad_head *head) {
  return head ? head->length() : Size{SSRVLAD_WRONG_ARGUMENT};
}

const char *ssrvlad_fingerprint(const ssrvlad_head *head) { return head ? head->fingerprint.c_str() : ""; }

int64_t ssrvlad_describe(ssrvlad_head *head, const ssrvlad_labels *labels,
                         const ssrvlad_table *table, int threads, float *descriptors) {
  int64_t unknown = 0;
  const int code = guarded([&] {
    require(head && descriptors, "a head and memory for descriptors");
    check(labels, table);
    unknown = head->describe(*labels, *table, threads, descriptors);
  });
  return code ? code : unknown;
}
