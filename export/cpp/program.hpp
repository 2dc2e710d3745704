// What the example programs share. Not installed.

#pragma once

#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <iostream>
#include <stdexcept>
#include <string>

#include "place.hpp"

namespace program {

// A whole number that an argument gives.
inline std::int64_t number(const std::string& name, const std::string& text, std::int64_t least = 0) {
  const bool is_number =
      !text.empty() && text.size() < 10 && text.find_first_not_of("0123456789") == text.npos;
  if (!is_number || std::stoll(text) < least)
    throw std::runtime_error(name + ": expected a whole number from " + std::to_string(least) +
                             " to 999999999, got " + text);
  return std::stoll(text);
}

// The file `head`, or with a network the two files of `ssrvlad fuse --split`.
inline ssrvlad::Place opened(const std::string& network, const std::string& head, bool check) {
  const Ort::SessionOptions session;  // append a provider for the network here
  return network.empty() ? ssrvlad::Place(head, session, check)
                         : ssrvlad::Place(network, head, session, check);
}

// The exit code of a program that has skipped some of its frames.
inline int finished(std::size_t skipped, std::size_t frames) {
  if (!skipped) return 0;
  std::cerr << "skipped " << skipped << " of " << frames << " frames\n";
  return 3;
}

// The exit code of a program: of a job, or 2 and a line on stderr for an error.
template <typename Job>
int run(const char* name, const Job& job) {
  try {
    const int code = job();
    if (std::fflush(stdout) || std::ferror(stdout))
      throw std::runtime_error("standard output cannot be written");
    return code;
  } catch (const std::exception& error) {
    std::cerr << name << ": " << error.what() << "\n";
    return 2;
  }
}

}  // namespace program
