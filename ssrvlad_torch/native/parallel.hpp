// Jobs that threads share.

#ifndef SSRVLAD_PARALLEL_HPP
#define SSRVLAD_PARALLEL_HPP

#include <atomic>
#include <new>
#include <system_error>
#include <thread>
#include <vector>

#include "numbers.hpp"

namespace places {

// Shares `count` jobs among threads, one of them the caller's. False if out of memory.
template <class Job>
bool in_parallel(Size count, int threads, Job job) {
  std::atomic<Size> next{0};
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
    for (Size i = 1; i < std::min<Size>(threads, count); ++i) others.emplace_back(work);
  } catch (const std::system_error &) {  // no more threads available: fewer do the work
  }
  work();
  for (std::thread &other : others) other.join();
  return !failed;
}

}  // namespace places

#endif
