// Finds sequences in an exported map: an example for map.hpp. `follow --help` says how it is called.

#include <cmath>
#include <cstdio>
#include <deque>
#include <set>
#include <thread>

#include <ssrvlad/map.hpp>

#include "program.hpp"

namespace {

const program::Usage usage{
    "follow", "[--online [--delay N] | --alone] place.onnx town.npy TOP FOLDER...",
    R"(Prints one JSON object a line, as `run_onnx.py --follow --json` does: the places of `ssrvlad query`.

Each FOLDER is a sequence of label maps, .npy or PGM, or photographs, .npy or PPM, in natural order; - reads
the names of the files of one sequence from standard input. Each frame is found by all frames of its sequence;
with --online by those before it, or with --delay also by N later ones, and its answer is printed as soon as it
is known; or alone. Exit code 0 for success, 2 for wrong use, with one line on standard error, 3 for finished
with some frames skipped.
)",
    4, std::size_t(-1), {"--delay"}, {"--online", "--alone"}};

// A frame whose answer is not known yet.
struct Waiting {
  std::string frame;
  bool empty;
};

std::string json(double number) {
  char text[32];
  std::snprintf(text, sizeof text, "%.17g", number);
  return std::isnan(number) ? "null" : text;
}

void print(const Waiting& query, const ssrvlad::Answer& answer) {
  std::string candidates, poses;
  for (const auto& [frame, score, pose] : answer.candidates) {
    const std::string comma = candidates.empty() ? "" : ", ";
    candidates += comma + "{\"frame\": " + ssrvlad::quoted(frame) + ", \"score\": " + json(score) + "}";
    poses += comma + "{\"x\": " + json(pose.x) + ", \"y\": " + json(pose.y) + ", \"heading\": " +
             json(pose.heading) + "}";
  }
  std::printf("{\"query\": %s, \"candidates\": [%s], \"empty\": %s, \"score_is\": \"%s\", \"confidence\": %s, "
              "\"settled\": %s, \"poses\": [%s]}\n",
              ssrvlad::quoted(query.frame).c_str(), candidates.c_str(), query.empty ? "true" : "false",
              answer.score_is.c_str(), json(answer.confidence).c_str(), answer.settled ? "true" : "false",
              poses.c_str());
  std::fflush(stdout);
}

int follow(const program::Arguments& arguments) {
  const auto& files = arguments.files;
  const auto sources = arguments.sources(3);
  const auto top = static_cast<std::size_t>(program::number("TOP", files[2], 1));
  const auto delay = program::number("--delay", arguments.value("--delay", "0"));
  const bool online = arguments.has("--online"), live = ssrvlad::come_live(sources);
  if (delay && !online) throw std::runtime_error("--delay: expected with --online");
  npy::require(files[1]);
  ssrvlad::require_frames(sources);
  const auto place = program::opened(arguments, files[0]);
  const ssrvlad::Map town(files[1], place.fingerprints(), static_cast<int>(std::thread::hardware_concurrency()));
  for (const auto& warning : town.warnings()) program::note(warning);

  auto tracker = std::make_unique<ssrvlad::Tracker>(town, delay, top);
  std::vector<ssrvlad::Described> sequence;
  std::deque<Waiting> waiting;
  const auto show = [&](const ssrvlad::Answer& answer) {
    print(waiting.front(), answer);
    waiting.pop_front();
  };
  const auto finish = [&] {
    const auto how = arguments.has("--alone") ? ssrvlad::Follow::kNo : ssrvlad::Follow::kOffline;
    for (const auto& answer : town.query(sequence, how, top)) show(answer);
    while (const auto answer = tracker->finish()) show(*answer);
    sequence.clear();
    tracker = std::make_unique<ssrvlad::Tracker>(town, delay, top);
  };
  std::set<std::string> ids;
  std::string last;
  std::size_t skipped = 0;
  const auto take = [&](const ssrvlad::Frame& frame) {
    if (!live && frame.sequence() != last) finish();
    last = frame.sequence();
    ssrvlad::Described described;
    try {
      if (ids.count(frame.id)) throw std::runtime_error(frame.path.string() + ": a second frame " + frame.id);
      described = ssrvlad::describe(place, frame.path.string());
    } catch (const std::runtime_error& error) {
      program::note(error.what());
      ++skipped;
      return;
    }
    ids.insert(frame.id);
    const auto& numbers = described.descriptor;
    waiting.push_back({frame.id, std::all_of(numbers.begin(), numbers.end(), [](float x) { return x == 0; })});
    if (!online) sequence.push_back(std::move(described));
    else if (const auto answer = tracker->update(described)) show(*answer);
  };
  const auto count = ssrvlad::for_each_frame(sources, place.takes_photographs(), take);
  finish();
  return program::finished(skipped, count);
}

}  // namespace

int main(int count, char** values) { return program::run(usage, count, values, follow); }
