// What the example programs share. Not installed.

#pragma once

#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <iostream>
#include <map>
#include <new>
#include <set>
#include <stdexcept>
#include <string>
#include <vector>

#include <ssrvlad/place.hpp>

#include "frames.hpp"

namespace program {

// How a program is called: `line` names its options and files, `text` explains them. Options have a value,
// but for flags.
struct Usage {
  std::string name, line, text;
  std::size_t least_files, most_files;
  std::set<std::string> options, flags;
};

struct Arguments {
  std::map<std::string, std::string> options;  // flags are empty
  std::vector<std::string> files;

  bool has(const std::string& option) const { return options.count(option) > 0; }
  std::string value(const std::string& option, const std::string& otherwise = "") const {
    const auto at = options.find(option);
    return at == options.end() ? otherwise : at->second;
  }
  // Where frames are: files or folders.
  std::vector<std::string> sources(std::size_t first) const {
    return {files.begin() + static_cast<std::ptrdiff_t>(first), files.end()};
  }
};

// A whole number that an argument gives.
inline std::int64_t number(const std::string& name, const std::string& text, std::int64_t least = 0) {
  const bool is_number =
      !text.empty() && text.size() < 10 && text.find_first_not_of("0123456789") == text.npos;
  if (!is_number || std::stoll(text) < least)
    throw std::runtime_error(name + ": expected a whole number from " + std::to_string(least) +
                             " to 999999999, got " + text);
  return std::stoll(text);
}

inline Arguments parsed(const Usage& usage, int count, char** values) {
  Arguments arguments;
  for (int at = 1; at < count; ++at) {
    const std::string argument = values[at];
    if (usage.flags.count(argument)) arguments.options[argument];
    else if (usage.options.count(argument) && at + 1 < count) arguments.options[argument] = values[++at];
    else if (argument.compare(0, 2, "--") == 0) throw std::runtime_error("usage: " + usage.name + usage.line);
    else arguments.files.push_back(argument);
  }
  if (arguments.files.size() < usage.least_files || arguments.files.size() > usage.most_files)
    throw std::runtime_error("usage: " + usage.name + usage.line);
  return arguments;
}

// The file `head`, or with --network the two files of `ssrvlad fuse --split`.
inline ssrvlad::Place opened(const Arguments& arguments, const std::string& head) {
  const Ort::SessionOptions session;  // append a provider for the network here
  const bool check = !arguments.has("--unchecked");
  return arguments.has("--network") ? ssrvlad::Place(arguments.value("--network"), head, session, check)
                                    : ssrvlad::Place(head, session, check);
}

// A text in one line: control characters, such as a newline in the name of a file, are escaped.
inline std::string printable(const std::string& text) {
  std::string line;
  for (const char letter : text) {
    const auto code = static_cast<unsigned char>(letter);
    char escape[8];
    std::snprintf(escape, sizeof escape, "\\x%02x", code);
    line += code < 0x20 || code == 0x7f ? escape : std::string(1, letter);
  }
  return line;
}

// Prints a line on standard error.
inline void note(const std::string& text) { std::cerr << printable(text) << "\n"; }

// The exit code of a program that has skipped some of its frames.
inline int finished(std::size_t skipped, std::size_t frames) {
  if (!skipped) return 0;
  std::cerr << "skipped " << skipped << " of " << frames << " frames\n";
  return 3;
}

// The exit code of a program: of a job, or 2 and a line on stderr for an error. --help prints how it is called.
template <typename Job>
int run(Usage usage, int count, char** values, const Job& job) {
  usage.options.insert("--network");
  usage.flags.insert("--unchecked");
  usage.line = " [--network net.onnx] [--unchecked] " + usage.line;
  try {
    const bool help = std::find(values + 1, values + count, std::string("--help")) != values + count;
    if (help)
      std::printf("usage: %s%s\n\n%s\n--network net.onnx is the network of `ssrvlad fuse --split`. "
                  "--unchecked does not run the golden pair first.\n",
                  usage.name.c_str(), usage.line.c_str(), usage.text.c_str());
    const int code = help ? 0 : job(parsed(usage, count, values));
    if (std::fflush(stdout) || std::ferror(stdout))
      throw std::runtime_error("standard output cannot be written");
    return code;
  } catch (const std::bad_alloc&) {
    note(usage.name + ": not enough memory");
    return 2;
  } catch (const std::exception& error) {
    note(std::string(usage.name) + ": " + error.what());
    return 2;
  }
}

}  // namespace program
