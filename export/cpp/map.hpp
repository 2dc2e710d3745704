// Finds drives and single frames in a map, as `ssrvlad query` and `ssrvlad locate` do.
//
//     ssrvlad::Place place("place.onnx");
//     ssrvlad::Map town("town.npy", place.fingerprints());
//     for (const auto& answer : town.query(drive))  // the described frames of a drive, in order
//       if (answer.found() && answer.confidence > 0.9F) std::cout << answer.candidates[0].frame;
//
// C++17, over the core alone. Errors are std::runtime_error, or
// std::bad_alloc. Several threads may use one Map at a time.

#pragma once

#include <algorithm>
#include <fstream>
#include <memory>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "described.hpp"
#include "npy.hpp"
#include <ssrvlad/ssrvlad_map.h>

namespace ssrvlad {

namespace detail {

// A line of a text file, also of one that was written on Windows.
inline bool read_line(std::istream& file, std::string& line) {
  if (!std::getline(file, line)) return false;
  if (!line.empty() && line.back() == '\r') line.pop_back();
  return true;
}

}  // namespace detail

struct Match {
  std::string frame;
  float score;
};

// The answer to one query: candidates, best first, none for a frame that shows nothing; what their scores
// are, "cosine", "fused score" or "probability"; and the probability that the first candidate is right.
struct Answer {
  std::vector<Match> candidates;
  std::string score_is;
  float confidence;

  bool found() const { return !candidates.empty(); }
};

// Each frame alone; by the frames before it and `delay` later ones; by all frames of the drive.
enum class Follow { kNo = SSRVLAD_ALONE, kOnline = SSRVLAD_ONLINE, kOffline = SSRVLAD_OFFLINE };

// Descriptors of reference frames from `ssrvlad db export --format npy`: FILE.npy,
// FILE.npy.frames.txt and FILE.npy.fingerprint.txt; and their other channels, FILE.npy.features.npy
// and FILE.npy.hog.npy.
class Map {
 public:
  // The fingerprints are those of the model; channels are used that both have. `threads` share a query.
  Map(const std::string& path, const Fingerprints& model, int threads = 1)
      : model_(model), threads_(threads) {
    std::ifstream names(path + ".frames.txt");
    for (std::string line; detail::read_line(names, line);) frames_.push_back(line);
    add(path, "ssr-vlad", "", model.descriptor, "<f4", 2);
    add(path, "features", ".features.npy", model.features, "|u1", 4);
    add(path, "hog", ".hog.npy", model.hog, "<f4", 2);
    if (frames_.empty()) throw std::runtime_error(path + " holds no frames");
    open(path);
  }

  std::size_t size() const { return frames_.size(); }
  // What is left out, in lines.
  const std::vector<std::string>& warnings() const { return warnings_; }

  // The places of the frames of a drive, in its order: the best `top`, from 1.
  std::vector<Answer> query(const std::vector<Described>& drive, Follow follow = Follow::kOffline,
                            std::int64_t delay = 0, std::size_t top = 5) const {
    if (top < 1 || delay < 0)
      throw std::runtime_error("expected 1 candidate or more and a delay from 0, got " +
                               std::to_string(top) + " and " + std::to_string(delay));
    top = std::min(top, size());
    std::vector<std::vector<char>> packed(channels_.size());
    std::vector<ssrvlad_queries> queries(channels_.size());
    for (std::size_t number = 0; number < channels_.size(); ++number) {
      queries[number].anchors = pack(channels_[number], drive, packed[number]);
      queries[number].descriptors = packed[number].data();
    }
    const auto count = drive.size();
    std::vector<float> scores(count * top), sure(3 * count);
    std::vector<std::int64_t> rows(count * top);
    std::vector<std::uint8_t> follows(count);
    std::vector<double> weights(channels_.size());
    ssrvlad_decision decision{};
    decision.scores = scores.data();
    decision.rows = rows.data();
    decision.right = sure.data();
    decision.spread = sure.data() + count;
    decision.together = sure.data() + 2 * count;
    decision.follows = follows.data();
    ssrvlad_taken taken{};
    taken.weights = weights.data();
    ssrvlad_steps steps{};
    steps.standardise = steps.sweep = 1;
    steps.follow = static_cast<std::int32_t>(follow);
    steps.delay = delay;
    steps.top = static_cast<std::int64_t>(top);
    require(ssrvlad_map_query(map_.get(), queries.data(), static_cast<std::int64_t>(count), &steps,
                              threads_, &decision, &taken),
            "the descriptors of the drive");
    const char* alone = channels_.size() > 1 ? "fused score" : "cosine";
    std::vector<Answer> answers;
    for (std::size_t query = 0; query < count; ++query) {
      answers.push_back({{}, follows[query] ? "probability" : alone, sure[query]});
      for (auto at = query * top; at < (query + 1) * top && rows[at] >= 0; ++at)
        answers.back().candidates.push_back(
            {frames_[static_cast<std::size_t>(rows[at])], std::min(1.0F, scores[at])});
    }
    return answers;
  }

  // The place of one frame.
  Answer locate(const Described& frame, std::size_t top = 5) const {
    return query({frame}, Follow::kNo, 0, top).front();
  }

 private:
  struct Channel {
    std::string name, file;
    npy::Array rows;

    bool is_signs() const { return rows.dtype == "|u1"; }
  };

  static void require(int status, const std::string& what) {
    if (status != SSRVLAD_OK) throw std::runtime_error(what + ": " + ssrvlad_last_error());
  }

  // Adds the array of a channel, if both sides have it.
  void add(const std::string& path, const std::string& name, const std::string& end,
           const std::string& fingerprint, const std::string& dtype, std::size_t axes) {
    const auto file = path + end;
    const bool is_here = end.empty() || std::ifstream(file).good();
    if (!is_here && !fingerprint.empty())
      warnings_.push_back("only the model has " + name + ": frames are matched without");
    if (is_here && fingerprint.empty())
      warnings_.push_back("only " + path + " has " + name + ": frames are matched without; fuse the file again");
    if (!is_here || fingerprint.empty()) return;
    Channel channel{name, file, npy::load(file)};
    const auto& shape = channel.rows.shape;
    if (channel.rows.dtype != dtype || shape.size() != axes)
      throw std::runtime_error(file + ": expected an " + (axes == 4 ? "(R, 16, 16, 16)" : "(R, D)") +
                               " array of " + (axes == 4 ? "uint8" : "float32"));
    if (static_cast<std::size_t>(shape[0]) != frames_.size())
      throw std::runtime_error(path + ".frames.txt: expected " + std::to_string(shape[0]) + " ids, got " +
                               std::to_string(frames_.size()));
    require_fingerprint(file, fingerprint);
    channels_.push_back(std::move(channel));
  }

  void require_fingerprint(const std::string& path, const std::string& fingerprint) {
    std::string own;
    std::ifstream file(path + ".fingerprint.txt");
    if (!detail::read_line(file, own))
      warnings_.push_back(path + " has no fingerprint: it may not fit the model");
    else if (own != fingerprint)
      throw std::runtime_error(path + " has fingerprint " + own + ", the model " + fingerprint +
                               ": they do not compare");
  }

  void open(const std::string& path) {
    std::vector<std::int64_t> starts;
    for (std::size_t row = 0; row < frames_.size(); ++row)
      if (!row || drive_of(frames_[row]) != drive_of(frames_[row - 1]))
        starts.push_back(static_cast<std::int64_t>(row));
    const ssrvlad_drives drives{starts.data(), static_cast<std::int64_t>(starts.size()),
                                static_cast<std::int64_t>(frames_.size())};
    map_.reset(ssrvlad_map_new(&drives));
    require(map_ ? SSRVLAD_OK : SSRVLAD_NO_MEMORY, path);
    for (const auto& channel : channels_) {
      const auto& shape = channel.rows.shape;
      ssrvlad_channel rows{};
      rows.rows = channel.rows.bytes.data();
      rows.kind = channel.is_signs() ? SSRVLAD_SIGNS : SSRVLAD_VECTORS;
      rows.columns = channel.is_signs() ? shape[1] : 1;
      rows.size = channel.is_signs() ? shape[2] * shape[3] : shape[1];
      rows.trust = detail::trust_of(channel.name);
      require(ssrvlad_map_add_channel(map_.get(), &rows), channel.file);
    }
  }

  static std::string drive_of(const std::string& frame) {
    const auto end = frame.rfind('/');
    return end == frame.npos ? "" : frame.substr(0, end);
  }

  // Packs the descriptors of all frames of a drive by a channel, one after another; returns their anchors.
  std::int64_t pack(const Channel& channel, const std::vector<Described>& drive, std::vector<char>& packed) const {
    std::int64_t anchors = 1;
    for (const auto& frame : drive)
      for (const auto& view : detail::channels_of("a query", frame, model_)) {
        if (view.name != channel.name) continue;
        const auto unit = view.bytes() / view.numbers();
        const auto expected = channel.rows.bytes.size() / static_cast<std::size_t>(channel.rows.shape[0]);
        if (view.bytes() != expected || (!packed.empty() && view.anchors != anchors))
          throw std::runtime_error("expected a database of " + std::to_string(view.numbers()) +
                                   " numbers a frame, got " + std::to_string(expected / unit));
        anchors = view.anchors;
        const auto* first = static_cast<const char*>(view.data);
        packed.insert(packed.end(), first, first + static_cast<std::size_t>(anchors) * expected);
      }
    return anchors;
  }

  struct Free {
    void operator()(ssrvlad_map* map) const { ssrvlad_map_free(map); }
  };

  Fingerprints model_;
  int threads_;
  std::vector<std::string> frames_, warnings_;
  std::vector<Channel> channels_;
  std::unique_ptr<ssrvlad_map, Free> map_;
};

}  // namespace ssrvlad
