// Finds loop closures in sequences: an example for loops.hpp. `loops --help` says how it is called.

#include <csignal>
#include <cstdio>
#include <filesystem>
#include <iostream>
#include <new>
#include <set>

#include <ssrvlad/loops.hpp>

#include "program.hpp"

#if !defined(_WIN32)
#include <fcntl.h>
#include <unistd.h>
#endif

namespace {

constexpr std::size_t kCheckpoint = 500;  // frames

volatile std::sig_atomic_t interrupted = 0;  // by this signal

#if defined(_WIN32)
void interrupt(int signal) { interrupted = signal; }
#else
const int nothing = ::open("/dev/null", O_RDONLY | O_CLOEXEC);

// Standard input ends with it, also for a call that waits: the call is begun anew.
void interrupt(int signal) {
  interrupted = signal;
  ::dup2(nothing, STDIN_FILENO);
}
#endif

const program::Usage usage{
    "loops", "[--exclude N] [--threshold P] [--memory drive.npy] place.onnx FOLDER...",
    R"(Prints one JSON object a line, as `loops_onnx.py` and `ssrvlad loops --no-sweep --json` do, without stamps.

Each FOLDER is a sequence of label maps, .npy or PGM, or photographs, .npy or PPM, in natural order; - reads
the names of files from standard input. The last N frames (50) are no candidates; a loop has a confidence of
P (0.8) or more. With --memory the stream in the file, if it exists, goes on, and is saved there, every 500
frames, of more than 5000 whenever there are a tenth more, and when the program ends; frames whose ids it has
are omitted. Exit code 0 for success, 2 for wrong use, with one line on standard error, 3 for finished with
some frames skipped, 130 interrupted by SIGINT, 143 by SIGTERM.
)",
    2, std::size_t(-1), {"--exclude", "--threshold", "--memory"}, {}};

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

void print(const ssrvlad::Loop& loop) {
  using ssrvlad::quoted;
  std::printf("{\"frame\": %s, \"reason\": \"%s\", ", quoted(loop.frame).c_str(), loop.reason.c_str());
  if (loop.candidate.empty()) std::printf("\"candidate\": null, \"score\": null, \"confidence\": null");
  else
    std::printf("\"candidate\": %s, \"score\": %.17g, \"confidence\": %.17g",
                quoted(loop.candidate).c_str(), loop.score, loop.confidence);
  std::printf(", \"ahead\": null, \"candidates\": [");
  for (std::size_t at = 0; at < loop.candidates.size(); ++at)
    std::printf("%s{\"frame\": %s, \"confidence\": %.17g}", at ? ", " : "",
                quoted(loop.candidates[at].frame).c_str(), loop.candidates[at].confidence);
  std::printf("]}\n");
  std::fflush(stdout);
}

int find_loops(const program::Arguments& arguments) {
  const auto memory = arguments.value("--memory");
  ssrvlad::LoopSettings settings;
  settings.exclude = program::number("--exclude", arguments.value("--exclude", "50"));
  settings.threshold = fraction(arguments.value("--threshold", "0.8"));
  ssrvlad::require_frames(arguments.sources(1));
  const auto place = program::opened(arguments, arguments.files[0]);
  const bool goes_on = !memory.empty() && std::filesystem::exists(memory);
  auto loops = goes_on ? ssrvlad::Loops::load(memory, place.fingerprints(), settings)
                       : ssrvlad::Loops(place.fingerprints(), settings);
  std::size_t saved = 0;  // frames
  const auto save = [&] {
    if (!memory.empty()) loops.save(memory);
    saved = loops.size();
  };
  save();  // an error is known before the drive
  for (const int signal : {SIGINT, SIGTERM}) std::signal(signal, interrupt);
  const std::set<std::string> known(loops.frames().begin(), loops.frames().end());
  std::size_t skipped = 0, omitted = 0;
  const auto take = [&](const ssrvlad::Frame& frame) {
    if (interrupted) return;
    if (known.count(frame.id)) {
      ++omitted;
      return;
    }
    try {
      print(loops.update(frame.id, ssrvlad::describe(place, frame.path.string())));
    } catch (const std::runtime_error& error) {
      program::note(error.what());
      ++skipped;
      return;
    }
    if (loops.size() - saved >= std::max(kCheckpoint, saved / 10)) save();
  };
  std::size_t count = 0;
  try {
    count = ssrvlad::for_each_frame(arguments.sources(1), place.takes_photographs(), take);
  } catch (const std::bad_alloc&) {
    save();
    throw;
  }
  save();
  if (omitted) std::cerr << "omitted " << omitted << " frames: " << memory << " has their ids\n";
  return interrupted ? 128 + interrupted : program::finished(skipped, count);
}

}  // namespace

int main(int count, char** values) { return program::run(usage, count, values, find_loops); }
