// Finds drives along an exported map: an example for map.hpp.
//
//     follow [--network net.onnx] [--unchecked] [--online DELAY | --alone] place.onnx town.npy TOP FOLDER...
//
// Each folder is a drive of label maps, .npy or PGM, or photographs, .npy or PPM, in natural order. Prints
// one JSON object a line, as `follow_onnx.py --json` does: the places of `ssrvlad query`. Exit code 0 for
// success, 2 for wrong use, with one line on stderr, 3 for finished with some frames skipped.

#include <cstdio>
#include <set>

#include "frames.hpp"
#include "map.hpp"
#include "program.hpp"

namespace {

struct Options {
  std::string network;
  bool check = true;
  ssrvlad::Follow follow = ssrvlad::Follow::kOffline;
  std::int64_t delay = 0;
  std::vector<std::string> rest;
};

Options parsed(const std::vector<std::string>& arguments) {
  Options options;
  for (std::size_t at = 0; at < arguments.size(); ++at) {
    const auto& each = arguments[at];
    if (each == "--unchecked") {
      options.check = false;
    } else if (each == "--alone") {
      options.follow = ssrvlad::Follow::kNo;
    } else if (each == "--network" && at + 1 < arguments.size()) {
      options.network = arguments[++at];
    } else if (each == "--online" && at + 1 < arguments.size()) {
      options.follow = ssrvlad::Follow::kOnline;
      options.delay = program::number("DELAY", arguments[++at]);
    } else {
      options.rest.push_back(each);
    }
  }
  if (options.rest.size() < 4 || options.rest[0].compare(0, 2, "--") == 0)
    throw std::runtime_error(
        "usage: follow [--network net.onnx] [--unchecked] [--online DELAY | --alone] place.onnx town.npy "
        "TOP FOLDER...");
  return options;
}

void print(const std::string& frame, bool empty, const ssrvlad::Answer& answer) {
  std::printf("{\"query\": %s, \"candidates\": [", ssrvlad::quoted(frame).c_str());
  for (std::size_t at = 0; at < answer.candidates.size(); ++at)
    std::printf("%s{\"frame\": %s, \"score\": %.9g}", at ? ", " : "",
                ssrvlad::quoted(answer.candidates[at].frame).c_str(),
                static_cast<double>(answer.candidates[at].score));
  std::printf("], \"empty\": %s, \"score_is\": \"%s\", \"confidence\": %.9g}\n", empty ? "true" : "false",
              answer.score_is.c_str(), static_cast<double>(answer.confidence));
}

int run(const Options& options) {
  const auto& files = options.rest;
  const auto place = program::opened(options.network, files[0], options.check);
  const ssrvlad::Map town(files[1], place.fingerprints());
  const auto top = static_cast<std::size_t>(program::number("TOP", files[2], 1));
  const auto frames = ssrvlad::find_frames({files.begin() + 3, files.end()}, place.takes_photographs());
  std::set<std::string> ids;
  std::size_t skipped = 0;
  for (std::size_t first = 0, last = 0; first < frames.size(); first = last) {
    std::vector<std::string> names;
    std::vector<ssrvlad::Described> drive;
    for (; last < frames.size() && frames[last].drive() == frames[first].drive(); ++last) try {
        const auto path = frames[last].path.string();
        if (ids.count(frames[last].id))
          throw std::runtime_error(path + ": a second frame " + frames[last].id);
        drive.push_back(ssrvlad::describe(place, path));
        ids.insert(frames[last].id);
        names.push_back(frames[last].id);
      } catch (const std::runtime_error& error) {
        std::cerr << error.what() << "\n";
        ++skipped;
      }
    const auto answers = town.query(drive, options.follow, options.delay, top);
    for (std::size_t at = 0; at < answers.size(); ++at) {
      const auto& numbers = drive[at].descriptor;
      const bool empty = std::all_of(numbers.begin(), numbers.end(), [](float x) { return x == 0; });
      print(names[at], empty, answers[at]);
    }
  }
  return program::finished(skipped, frames.size());
}

}  // namespace

int main(int count, char** values) {
  return program::run("follow", [&] { return run(parsed({values + 1, values + count})); });
}
