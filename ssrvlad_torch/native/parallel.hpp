// Jobs that are shared among threads. WebAssembly has none: there one thread does them all.

#ifndef SSRVLAD_PARALLEL_HPP
#define SSRVLAD_PARALLEL_HPP

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <exception>
#include <mutex>
#include <new>
#include <system_error>
#include <vector>

#if !defined(__wasm__)
#include <thread>
#endif

namespace places {

#if defined(__wasm__)
struct Mutex {
  void lock() {}
  void unlock() {}
};
#else
using Mutex = std::mutex;
#endif

// Shares `count` jobs among threads, one of them the caller's: each takes the number of its next job
// from the counter until there are no more.
template <class Job>
void in_parallel([[maybe_unused]] std::int64_t count, [[maybe_unused]] int threads, Job job) {
  std::atomic<std::int64_t> next{0};
  std::atomic<bool> failed{false};
  const auto work = [&]() noexcept {
    try {
      job(next);
    } catch (const std::exception &) {  // bad_alloc, or length_error of sizes beyond memory
      failed = true;
    }
  };
#if defined(__wasm__)
  work();
#else
  std::vector<std::thread> others;
  try {
    const auto more = std::max<std::int64_t>(1, std::min<std::int64_t>(threads, count)) - 1;
    others.reserve(static_cast<std::size_t>(more));
    for (std::int64_t i = 0; i < more; ++i) others.emplace_back(work);
  } catch (const std::system_error &) {  // no more threads available: fewer do the work
  } catch (const std::bad_alloc &) {
    failed = true;
  }
  if (!failed) work();
  for (std::thread &other : others) other.join();
#endif
  if (failed) throw std::bad_alloc();
}

// Calls a function with the first and the last row of each of several blocks of rows.
template <class Function>
void over_blocks(std::int64_t rows, std::int64_t size, int threads, Function function) {
  const std::int64_t blocks = (rows + size - 1) / size;
  in_parallel(blocks, threads, [&](std::atomic<std::int64_t> &next) {
    for (std::int64_t block; (block = next++) < blocks;)
      function(block * size, std::min(rows, (block + 1) * size));
  });
}

}  // namespace places

#endif
