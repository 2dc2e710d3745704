// Kernels: loops that are compiled for each kind of processor, in one table. The processor itself says
// which one runs: what a compiler offers for this is missing from zig's.

#ifndef SSRVLAD_CPU_HPP
#define SSRVLAD_CPU_HPP

#ifdef __FAST_MATH__
#error "compile without -ffast-math: the core needs infinity, NaN and the rounding that is written"
#endif

#ifndef __GNUC__
#error "compile with GCC or Clang: kernels are written for them"
#endif

#define SSRVLAD_INLINE inline __attribute__((always_inline))

#ifndef SSRVLAD_SIMD
#define SSRVLAD_SIMD 2  // the highest of the table that runs: tests try each
#endif

#include <algorithm>

#if defined(__x86_64__)
#define SSRVLAD_X86
#include <cpuid.h>
#include <immintrin.h>
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif

namespace places {

// What every processor of a platform has.
struct Base {
#if defined(__x86_64__)
  static constexpr const char *NAME = "SSE2";
#elif defined(__aarch64__)
  static constexpr const char *NAME = "NEON";
#elif defined(__wasm_simd128__)
  static constexpr const char *NAME = "SIMD128";
#else
  static constexpr const char *NAME = "no SIMD";
#endif

  template <class Kernel>
  static auto run(Kernel kernel) {
    return kernel(Base());
  }
};

#ifdef SSRVLAD_X86
struct Avx2 {
  static constexpr const char *NAME = "AVX2";

  template <class Kernel>
  __attribute__((target("avx2,fma,popcnt"), flatten)) static auto run(Kernel kernel) {
    return kernel(Avx2());
  }
};

struct Avx512 {
  static constexpr const char *NAME = "AVX-512";

  template <class Kernel>
  __attribute__((target("avx2,fma,popcnt,avx512f,avx512bw,avx512dq,avx512vl,avx512vpopcntdq"), flatten))
  static auto run(Kernel kernel) {
    return kernel(Avx512());
  }
};
#endif

// Which of these the processor has, and the system saves.
inline int simd_level() {
#ifdef SSRVLAD_X86
  static const int level = [] {
    constexpr unsigned FMA = 1 << 12, POPCNT = 1 << 23, OSXSAVE = 1 << 27, SAVES_AVX = 0x06;
    constexpr unsigned AVX2 = 1 << 5, F = 1 << 16, DQ = 1 << 17, BW = 1 << 30, SAVES_AVX512 = 0xe6;
    constexpr unsigned VL = 1U << 31, VPOPCNTDQ = 1 << 14;
    const auto has = [](unsigned bits, unsigned all) { return (bits & all) == all; };
    unsigned a, b, c, d, saved, high;
    if (!__get_cpuid(1, &a, &b, &c, &d) || !has(c, FMA | POPCNT | OSXSAVE)) return 0;
    __asm__ volatile("xgetbv" : "=a"(saved), "=d"(high) : "c"(0));
    if (!__get_cpuid_count(7, 0, &a, &b, &c, &d) || !has(b, AVX2) || !has(saved, SAVES_AVX)) return 0;
    const bool has_512 = has(b, F | DQ | BW | VL) && has(c, VPOPCNTDQ) && has(saved, SAVES_AVX512);
    return std::min(SSRVLAD_SIMD, has_512 ? 2 : 1);
  }();
  return level;
#else
  return 0;
#endif
}

// Calls a kernel, a function of the kind of processor, as it is compiled for this one. It should capture
// by value: then numbers stay in registers.
template <class Kernel>
auto on_cpu(const Kernel &kernel) {
  constexpr decltype(&Base::run<Kernel>) TABLE[] = {Base::run<Kernel>,
#ifdef SSRVLAD_X86
                                                    Avx2::run<Kernel>, Avx512::run<Kernel>
#endif
  };
  return TABLE[simd_level()](kernel);
}

inline const char *simd_name() {
  return on_cpu([](auto processor) { return decltype(processor)::NAME; });
}

}  // namespace places

#endif
