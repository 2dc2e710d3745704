// The products of products.hpp: tiles of rows and panels of vectors whose sums stay in registers.

#include "products.hpp"

#include "parallel.hpp"
#include "ssrvlad.h"

namespace places {

namespace {

constexpr Size PANEL = 32, ROWS = 12;  // lanes of a panel, rows of a tile

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

// Fills sums (ROWS, PANEL) with the products of numbers of a panel (length, PANEL), of which some lanes
// count, and of rows.
void tile(Base, const float *panel, const float *const *rows, Size length, Size lanes, float *sums) {
  for (Size row = 0; row < ROWS; ++row, sums += PANEL) {
    std::fill_n(sums, lanes, 0.0F);
    for (Size n = 0; n < length; ++n)
      for (Size lane = 0; lane < lanes; ++lane)
        sums[lane] = fused(panel[n * PANEL + lane], rows[row][n], sums[lane]);
  }
}
#endif

#ifdef SSRVLAD_X86
__attribute__((target("avx512f"))) void tile(Avx512, const float *panel, const float *const *rows,
                                                     Size length, Size, float *sums) {
  __m512 low_sums[ROWS], high_sums[ROWS];
#pragma GCC unroll 12
  for (int row = 0; row < ROWS; ++row) low_sums[row] = high_sums[row] = _mm512_setzero_ps();
  for (Size n = 0; n < length; ++n, panel += PANEL) {
    const __m512 low = _mm512_loadu_ps(panel), high = _mm512_loadu_ps(panel + 16);
#pragma GCC unroll 12
    for (int row = 0; row < ROWS; ++row) {
      const __m512 number = _mm512_set1_ps(rows[row][n]);
      low_sums[row] = _mm512_fmadd_ps(low, number, low_sums[row]);
      high_sums[row] = _mm512_fmadd_ps(high, number, high_sums[row]);
    }
  }
#pragma GCC unroll 12
  for (int row = 0; row < ROWS; ++row) {
    _mm512_storeu_ps(sums + row * PANEL, low_sums[row]);
    _mm512_storeu_ps(sums + row * PANEL + 16, high_sums[row]);
  }
}

__attribute__((target("avx2,fma"))) void tile(Avx2, const float *panel, const float *const *rows,
                                                    Size length, Size, float *sums) {
  for (int first = 0; first < ROWS; first += 3) {
    __m256 summed[3][4];
#pragma GCC unroll 12
    for (int at = 0; at < 12; ++at) summed[at / 4][at % 4] = _mm256_setzero_ps();
    for (Size n = 0; n < length; ++n)
#pragma GCC unroll 3
      for (int row = 0; row < 3; ++row) {
        const __m256 number = _mm256_set1_ps(rows[first + row][n]);
#pragma GCC unroll 4
        for (int part = 0; part < 4; ++part)
          summed[row][part] = _mm256_fmadd_ps(_mm256_loadu_ps(panel + n * PANEL + part * 8), number,
                                            summed[row][part]);
      }
#pragma GCC unroll 12
    for (int at = 0; at < 12; ++at)
      _mm256_storeu_ps(sums + (first + at / 4) * PANEL + at % 4 * 8, summed[at / 4][at % 4]);
  }
}
#endif

#if defined(__aarch64__)
void tile(Base, const float *panel, const float *const *rows, Size length, Size, float *sums) {
  for (int first = 0; first < ROWS; first += 3) {
    float32x4_t summed[3][8];
#pragma GCC unroll 24
    for (int at = 0; at < 24; ++at) summed[at / 8][at % 8] = vdupq_n_f32(0);
    for (Size n = 0; n < length; ++n)
#pragma GCC unroll 3
      for (int row = 0; row < 3; ++row)
#pragma GCC unroll 8
        for (int part = 0; part < 8; ++part)
          summed[row][part] = vfmaq_n_f32(summed[row][part], vld1q_f32(panel + n * PANEL + part * 4),
                                        rows[first + row][n]);
#pragma GCC unroll 24
    for (int at = 0; at < 24; ++at)
      vst1q_f32(sums + (first + at / 8) * PANEL + at % 8 * 4, summed[at / 8][at % 8]);
  }
}
#endif

}  // namespace

Panels::Panels(const float *vectors, Size count, Size anchors, Size length)
    : count_(count), length_(length), items_(std::min(PANEL, std::max<Size>(1, count))) {
  lanes_ = std::max<Size>(1, std::min(anchors, PANEL / items_));
  panels_ = (anchors + lanes_ - 1) / lanes_;
  const Size groups = (count + items_ - 1) / items_;
  packed_.resize(static_cast<std::size_t>(groups * panels_ * PANEL * length));
  for (Size item = 0; item < count; ++item) {
    std::vector<const float *> nonzero;
    for (const float *next = vectors + item * anchors * length, *end = next + anchors * length;
         next < end; next += length)
      if (std::any_of(next, next + length, [](float number) { return number != 0; }))
        nonzero.push_back(next);
    for (Size anchor = 0; !nonzero.empty() && anchor < panels_ * lanes_; ++anchor) {
      const float *vector = nonzero[static_cast<std::size_t>(anchor) % nonzero.size()];
      float *panel = packed_.data() + (item / items_ * panels_ + anchor / lanes_) * PANEL * length;
      const Size lane = item % items_ * lanes_ + anchor % lanes_;
      for (Size n = 0; n < length; ++n) panel[n * PANEL + lane] = vector[n];
    }
  }
}

void Panels::best(const float *rows, Size count, float *scores, Size pitch) const {
  float sums[ROWS * PANEL], highest[ROWS * PANEL];
  for (Size first = 0; first < count_; first += items_) {
    const float *group = packed_.data() + first / items_ * panels_ * PANEL * length_;
    const Size items = std::min(items_, count_ - first);
    for (Size start = 0; start < count; start += ROWS) {
      const float *of[ROWS];
      for (Size row = 0; row < ROWS; ++row)
        of[row] = rows + std::min(start + row, count - 1) * length_;
      for (Size panel = 0; panel < panels_; ++panel) {
        float *target = panel ? sums : highest;
        std::fill_n(target, ROWS * PANEL, 0.0F);
        const float *numbers = group + panel * PANEL * length_;
        const Size length = length_, lanes = items * lanes_;
        on_cpu([=, &of](auto processor) { tile(processor, numbers, of, length, lanes, target); });
        if (panel)
          for (Size at = 0; at < ROWS * PANEL; ++at) highest[at] = std::max(highest[at], sums[at]);
      }
      for (Size item = 0; item < items; ++item) {
        float *to = scores + (first + item) * pitch + start;
        for (Size row = 0; row < std::min(ROWS, count - start); ++row) {
          const float *lane = highest + row * PANEL + item * lanes_;
          to[row] = *std::max_element(lane, lane + lanes_);
        }
      }
    }
  }
}

}  // namespace places
