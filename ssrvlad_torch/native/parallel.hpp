// Jobs that are shared among threads.

#ifndef SSRVLAD_PARALLEL_HPP
#define SSRVLAD_PARALLEL_HPP

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <new>
#include <system_error>
#include <thread>
#include <vector>

namespace places {

// Shares `count` jobs among threads, one of them the caller's: each takes the number of its next job
// from the counter until there are no more. False if out of memory.
template <class Job>
bool in_parallel(std::int64_t count, int threads, Job job) {
  std::atomic<std::int64_t> next{0};
  std::atomic<bool> failed{false};
  const auto work = [&]() noexcept {
    try {
      job(next);
    } catch (const std::bad_alloc &) {
      failed = true;
    }
  };
  std::vector<std::thread> others;
  try {
    for (std::int64_t i = 1; i < std::min<std::int64_t>(threads, count); ++i)
      others.emplace_back(work);
  } catch (const std::system_error &) {  // no more threads available: fewer do the work
  }
  work();
  for (std::thread &other : others) other.join();
  return !failed;
}

// Calls a function with the first and the last row of each of several blocks of rows.
template <class Function>
void over_blocks(std::int64_t rows, std::int64_t size, int threads, Function function) {
  const std::int64_t blocks = (rows + size - 1) / size;
  const bool done = in_parallel(blocks, threads, [&](std::atomic<std::int64_t> &next) {
    for (std::int64_t block; (block = next++) < blocks;)
      function(block * size, std::min(rows, (block + 1) * size));
  });
  if (!done) throw std::bad_alloc();
}

}  // namespace places

#endif
