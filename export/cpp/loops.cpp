// Finds loop closures in drives: an example for loops.hpp.
//
//     loops [--network net.onnx] [--unchecked] [--exclude N] [--threshold P] [--memory drive.npy]
//           place.onnx FOLDER...
//
// Each folder is a drive of label maps, .npy or PGM, or photographs, .npy or PPM, in natural order.
// Prints one JSON object a line, as `loops_onnx.py` and `ssrvlad loops --no-sweep --json` do, without
// stamps. With --memory the stream in the file, if it exists, goes on, and is saved there, every 500
// frames and when the program ends; frames whose ids it has are omitted. Exit code 0 for success, 2 for
// wrong use, with one line on stderr, 3 for finished with some frames skipped, 130 interrupted.

#include "loops.hpp"

#include <csignal>
#include <cstdio>
#include <iostream>
#include <set>

#include "frames.hpp"
#include "program.hpp"

namespace {

constexpr std::size_t kCheckpoint = 500;  // frames
constexpr int kInterrupted = 130;

volatile std::sig_atomic_t interrupted = 0;

struct Options {
  std::string network, memory;
  bool check = true;
  ssrvlad::LoopSettings settings;
  std::vector<std::string> rest;
};

double fraction(const std::string& text) {
  std::size_t read = 0;
  double value = -1;
  try {
    value = std::stod(text, &read);
  } catch (const std::logic_error&) {
  }
  if (read != text.size() || !(value >= 0 && value <= 1))
    throw std::runtime_error("--threshold: expected a number from 0 to 1, got " + text);
  return value;
}

Options parsed(const std::vector<std::string>& arguments) {
  Options options;
  for (std::size_t at = 0; at < arguments.size(); ++at) {
    const auto& each = arguments[at];
    const bool more = at + 1 < arguments.size();
    if (each == "--unchecked") options.check = false;
    else if (each == "--network" && more) options.network = arguments[++at];
    else if (each == "--memory" && more) options.memory = arguments[++at];
    else if (each == "--threshold" && more) options.settings.threshold = fraction(arguments[++at]);
    else if (each == "--exclude" && more)
      options.settings.exclude = program::number("--exclude", arguments[++at]);
    else options.rest.push_back(each);
  }
  if (options.rest.size() < 2 || options.rest[0].compare(0, 2, "--") == 0)
    throw std::runtime_error(
        "usage: loops [--network net.onnx] [--unchecked] [--exclude N] [--threshold P] "
        "[--memory drive.npy] place.onnx FOLDER...");
  return options;
}

void print(const ssrvlad::Loop& loop) {
  using ssrvlad::quoted;
  std::printf("{\"frame\": %s, \"reason\": \"%s\", ", quoted(loop.frame).c_str(), loop.reason.c_str());
  if (loop.candidate.empty()) std::printf("\"candidate\": null, \"score\": null, \"probability\": null");
  else
    std::printf("\"candidate\": %s, \"score\": %.17g, \"probability\": %.17g",
                quoted(loop.candidate).c_str(), loop.score, loop.probability);
  std::printf(", \"ahead\": null, \"candidates\": [");
  for (std::size_t at = 0; at < loop.candidates.size(); ++at)
    std::printf("%s{\"frame\": %s, \"probability\": %.17g}", at ? ", " : "",
                quoted(loop.candidates[at].frame).c_str(), loop.candidates[at].probability);
  std::printf("]}\n");
  std::fflush(stdout);
}

int run(const Options& options) {
  const auto& files = options.rest;
  const auto place = program::opened(options.network, files[0], options.check);
  const bool goes_on = !options.memory.empty() && std::ifstream(options.memory).good();
  auto loops = goes_on ? ssrvlad::Loops::load(options.memory, place.fingerprints(), options.settings)
                       : ssrvlad::Loops(place.fingerprints(), options.settings);
  const auto frames = ssrvlad::find_frames({files.begin() + 1, files.end()}, place.takes_photographs());
  const auto save = [&] {
    if (!options.memory.empty()) loops.save(options.memory);
  };
  save();  // an error is known before the drive
  std::signal(SIGINT, [](int) { interrupted = 1; });
  const std::set<std::string> known(loops.frames().begin(), loops.frames().end());
  std::size_t skipped = 0, omitted = 0;
  for (const auto& frame : frames) {
    if (interrupted) break;
    if (known.count(frame.id)) {
      ++omitted;
      continue;
    }
    try {
      print(loops.update(frame.id, ssrvlad::describe(place, frame.path.string())));
    } catch (const std::runtime_error& error) {
      std::cerr << error.what() << "\n";
      ++skipped;
      continue;
    }
    if (loops.size() % kCheckpoint == 0) save();
  }
  save();
  if (omitted) std::cerr << "omitted " << omitted << " frames: " << options.memory << " has their ids\n";
  return interrupted ? kInterrupted : program::finished(skipped, frames.size());
}

}  // namespace

int main(int count, char** values) {
  return program::run("loops", [&] { return run(parsed({values + 1, values + count})); });
}
