// The products of products.hpp: tiles of rows and panels of vectors whose sums stay in registers.

#include "products.hpp"

namespace places {

namespace {

constexpr Size LANES = 32, ROWS = 12;  // of a panel, and of a tile

#if !defined(__aarch64__)
// a * b + c, rounded once. The product of two floats is exact in double precision. A sum that is not
// exact is cut towards zero and its last bit set, which rounds to single precision as the exact one.
inline float fused(double a, double b, double c) {
  const double product = a * b, sum = product + c, part = sum - product;
  const double lost = (product - (sum - part)) + (c - part);
  const std::uint64_t inexact = lost != 0 ? 1 : 0;
  const std::uint64_t above = ((bits_of(lost) ^ bits_of(sum)) >> 63) & inexact;
  const std::uint64_t bits = (bits_of(sum) - above) | inexact;
  return static_cast<float>(of_bits(bits));
}

// Whether values are 0 or so large that sums of products have all the digits of single precision.
bool are_normal(const float *values, Size count) {
  constexpr float LEAST = 0x1p-40F;
  int small = 0;
  for (Size i = 0; i < count; ++i) small |= (values[i] != 0) & (std::abs(values[i]) < LEAST);
  return !small;
}

// Fills sums (ROWS, LANES) with the products of numbers of a panel (length, LANES), of which some lanes
// count, and of rows. As `fused`, for sums in double precision that are rounded to single. Where two
// roundings may differ from one, for a sum in the middle between two numbers, all is done again.
void tile(Base, const float *panel, const float *const *rows, Size length, Size lanes, float *sums) {
  constexpr Size AT_ONCE = 16;
  constexpr std::uint64_t DROPPED = (1ULL << 29) - 1, HALF = 1ULL << 28;
  const bool normal = are_normal(panel, length * LANES);
  for (Size row = 0; row < ROWS; ++row, sums += LANES) {
    const float *numbers = rows[row];
    const bool exact = normal && are_normal(numbers, length);
    for (Size first = 0; first < lanes; first += AT_ONCE) {
      double kept[AT_ONCE] = {};
      std::uint64_t unclear[AT_ONCE] = {};
      for (Size n = 0; n < length && exact; ++n) {
        const float *others = panel + n * LANES + first;
        for (Size lane = 0; lane < AT_ONCE; ++lane) {
          const double sum = static_cast<double>(numbers[n]) * others[lane] + kept[lane];
          const double scaled = sum * (DROPPED + 2);
          kept[lane] = scaled - (scaled - sum);
          unclear[lane] |= (bits_of(sum) & DROPPED) == HALF ? 1 : 0;
        }
      }
      for (Size lane = 0; lane < AT_ONCE; ++lane) {
        float sum = static_cast<float>(kept[lane]);
        if (!exact || unclear[lane]) {
          sum = 0;
          for (Size n = 0; n < length; ++n)
            sum = fused(panel[n * LANES + first + lane], numbers[n], sum);
        }
        sums[first + lane] = sum;
      }
    }
  }
}
#endif

#ifdef SSRVLAD_X86
__attribute__((target("avx512f"))) void tile(Avx512, const float *panel, const float *const *rows,
                                                     Size length, Size, float *sums) {
  __m512 some[ROWS], others[ROWS];
#pragma GCC unroll 12
  for (int row = 0; row < ROWS; ++row) some[row] = others[row] = _mm512_setzero_ps();
  for (Size n = 0; n < length; ++n, panel += LANES) {
    const __m512 low = _mm512_loadu_ps(panel), high = _mm512_loadu_ps(panel + 16);
#pragma GCC unroll 12
    for (int row = 0; row < ROWS; ++row) {
      const __m512 number = _mm512_set1_ps(rows[row][n]);
      some[row] = _mm512_fmadd_ps(low, number, some[row]);
      others[row] = _mm512_fmadd_ps(high, number, others[row]);
    }
  }
#pragma GCC unroll 12
  for (int row = 0; row < ROWS; ++row) {
    _mm512_storeu_ps(sums + row * LANES, some[row]);
    _mm512_storeu_ps(sums + row * LANES + 16, others[row]);
  }
}

__attribute__((target("avx2,fma"))) void tile(Avx2, const float *panel, const float *const *rows,
                                                    Size length, Size, float *sums) {
  for (int first = 0; first < ROWS; first += 3) {
    __m256 kept[3][4];
#pragma GCC unroll 12
    for (int at = 0; at < 12; ++at) kept[at / 4][at % 4] = _mm256_setzero_ps();
    for (Size n = 0; n < length; ++n)
#pragma GCC unroll 3
      for (int row = 0; row < 3; ++row) {
        const __m256 number = _mm256_set1_ps(rows[first + row][n]);
#pragma GCC unroll 4
        for (int part = 0; part < 4; ++part)
          kept[row][part] = _mm256_fmadd_ps(_mm256_loadu_ps(panel + n * LANES + part * 8), number,
                                            kept[row][part]);
      }
#pragma GCC unroll 12
    for (int at = 0; at < 12; ++at)
      _mm256_storeu_ps(sums + (first + at / 4) * LANES + at % 4 * 8, kept[at / 4][at % 4]);
  }
}
#endif

#if defined(__aarch64__)
void tile(Base, const float *panel, const float *const *rows, Size length, Size, float *sums) {
  for (int first = 0; first < ROWS; first += 3) {
    float32x4_t kept[3][8];
#pragma GCC unroll 24
    for (int at = 0; at < 24; ++at) kept[at / 8][at % 8] = vdupq_n_f32(0);
    for (Size n = 0; n < length; ++n)
#pragma GCC unroll 3
      for (int row = 0; row < 3; ++row)
#pragma GCC unroll 8
        for (int part = 0; part < 8; ++part)
          kept[row][part] = vfmaq_n_f32(kept[row][part], vld1q_f32(panel + n * LANES + part * 4),
                                        rows[first + row][n]);
#pragma GCC unroll 24
    for (int at = 0; at < 24; ++at)
      vst1q_f32(sums + (first + at / 8) * LANES + at % 8 * 4, kept[at / 8][at % 8]);
  }
}
#endif

}  // namespace

Panels::Panels(const float *vectors, Size count, Size anchors, Size length)
    : count_(count), length_(length), items_(std::min(LANES, std::max<Size>(1, count))) {
  lanes_ = std::max<Size>(1, std::min(anchors, LANES / items_));
  panels_ = (anchors + lanes_ - 1) / lanes_;
  const Size groups = (count + items_ - 1) / items_;
  packed_.resize(static_cast<std::size_t>(groups * panels_ * LANES * length));
  for (Size item = 0; item < count; ++item) {
    std::vector<const float *> kept;
    for (const float *each = vectors + item * anchors * length, *end = each + anchors * length;
         each < end; each += length)
      if (std::any_of(each, each + length, [](float number) { return number != 0; }))
        kept.push_back(each);
    for (Size anchor = 0; !kept.empty() && anchor < panels_ * lanes_; ++anchor) {
      const float *vector = kept[static_cast<std::size_t>(anchor) % kept.size()];
      float *panel = packed_.data() + (item / items_ * panels_ + anchor / lanes_) * LANES * length;
      const Size lane = item % items_ * lanes_ + anchor % lanes_;
      for (Size n = 0; n < length; ++n) panel[n * LANES + lane] = vector[n];
    }
  }
}

void Panels::best(const float *rows, Size count, float *scores, Size pitch) const {
  float sums[ROWS * LANES], highest[ROWS * LANES];
  for (Size first = 0; first < count_; first += items_) {
    const float *group = packed_.data() + first / items_ * panels_ * LANES * length_;
    const Size items = std::min(items_, count_ - first);
    for (Size start = 0; start < count; start += ROWS) {
      const float *of[ROWS];
      for (Size row = 0; row < ROWS; ++row)
        of[row] = rows + std::min(start + row, count - 1) * length_;
      for (Size panel = 0; panel < panels_; ++panel) {
        float *target = panel ? sums : highest;
        std::fill_n(target, ROWS * LANES, 0.0F);
        const float *numbers = group + panel * LANES * length_;
        const Size length = length_, lanes = items * lanes_;
        on_cpu([=, &of](auto processor) { tile(processor, numbers, of, length, lanes, target); });
        if (panel)
          for (Size at = 0; at < ROWS * LANES; ++at) highest[at] = std::max(highest[at], sums[at]);
      }
      for (Size item = 0; item < items; ++item) {
        float *to = scores + (first + item) * pitch + start;
        for (Size row = 0; row < std::min(ROWS, count - start); ++row) {
          const float *lane = highest + row * LANES + item * lanes_;
          to[row] = *std::max_element(lane, lane + lanes_);
        }
      }
    }
  }
}

}  // namespace places
