// Finds drives along an exported map: an example for map.hpp. `follow --help` says how it is called.

#include <cstdio>
#include <set>
#include <thread>

#include <ssrvlad/map.hpp>

#include "program.hpp"

namespace {

const program::Usage usage{
    "follow", "[--online DELAY | --alone] place.onnx town.npy TOP FOLDER...",
    R"(Prints one JSON object a line, as `run_onnx.py --follow --json` does: the places of `ssrvlad query`.

Each FOLDER is a drive of label maps, .npy or PGM, or photographs, .npy or PPM, in natural order. Each frame
is found by all frames of its drive; by those before it and DELAY later ones; or alone. Exit code 0 for
success, 2 for wrong use, with one line on standard error, 3 for finished with some frames skipped.
)",
    4, std::size_t(-1), {"--online"}, {"--alone"}};

void print(const std::string& frame, bool empty, const ssrvlad::Answer& answer) {
  std::printf("{\"query\": %s, \"candidates\": [", ssrvlad::quoted(frame).c_str());
  for (std::size_t at = 0; at < answer.candidates.size(); ++at)
    std::printf("%s{\"frame\": %s, \"score\": %.9g}", at ? ", " : "",
                ssrvlad::quoted(answer.candidates[at].frame).c_str(),
                static_cast<double>(answer.candidates[at].score));
  std::printf("], \"empty\": %s, \"score_is\": \"%s\", \"confidence\": %.9g}\n", empty ? "true" : "false",
              answer.score_is.c_str(), static_cast<double>(answer.confidence));
}

int follow(const program::Arguments& arguments) {
  const auto& files = arguments.files;
  const auto top = static_cast<std::size_t>(program::number("TOP", files[2], 1));
  const auto delay = program::number("DELAY", arguments.value("--online", "0"));
  const auto how = arguments.has("--alone")    ? ssrvlad::Follow::kNo
                   : arguments.has("--online") ? ssrvlad::Follow::kOnline
                                               : ssrvlad::Follow::kOffline;
  npy::require(files[1]);
  ssrvlad::require_frames(arguments.sources(3));
  const auto place = program::opened(arguments, files[0]);
  const auto frames = ssrvlad::find_frames(arguments.sources(3), place.takes_photographs());
  const ssrvlad::Map town(files[1], place.fingerprints(), static_cast<int>(std::thread::hardware_concurrency()));
  for (const auto& warning : town.warnings()) std::cerr << warning << "\n";
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
    const auto answers = town.query(drive, how, delay, top);
    for (std::size_t at = 0; at < answers.size(); ++at) {
      const auto& numbers = drive[at].descriptor;
      const bool empty = std::all_of(numbers.begin(), numbers.end(), [](float x) { return x == 0; });
      print(names[at], empty, answers[at]);
    }
  }
  return program::finished(skipped, frames.size());
}

}  // namespace

int main(int count, char** values) { return program::run(usage, count, values, follow); }
