// Finds drives and single frames in a map, as `ssrvlad query` and `ssrvlad locate` do.
//
//     ssrvlad::Place place("place.onnx");
//     ssrvlad::Map town("town.npy", place.fingerprints());
//     for (const auto& answer : town.query(drive))  // the described frames of a drive, in order
//       if (answer.found() && answer.confidence > 0.9F) std::cout << answer.candidates[0].frame;
//
// Header-only, C++17, over the library `ssrvlad` of ssrvlad_map.h. Errors are std::runtime_error, or
// std::bad_alloc. Several threads may use one Map at a time.

#pragma once

#include <algorithm>
#include <fstream>
#include <iostream>
#include <memory>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "library.hpp"
#include "npy.hpp"
#include "place.hpp"
#include "ssrvlad_map.h"

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
  // The fingerprints are those of the model; channels are used that both have.
  Map(const std::string& path, const Fingerprints& model) {
    detail::require_interface();
    std::ifstream names(path + ".frames.txt");
    for (std::string line; detail::read_line(names, line);) frames_.push_back(line);
    add(path, "", model.descriptor, "<f4", 2, 1.0);
    add(path, ".features.npy", model.features, "|u1", 4, 6.0);
    add(path, ".hog.npy", model.hog, "<f4", 2, 2.0);
    if (frames_.empty()) throw std::runtime_error(path + " holds no frames");
    open(path);
  }

  std::size_t size() const { return frames_.size(); }

  // The places of the frames of a drive, in its order: the best `top`, from 1.
  std::vector<Answer> query(const std::vector<Described>& drive, Follow follow = Follow::kOffline,
                            std::int64_t delay = 0, std::size_t top = 5) const {
    if (top < 1 || delay < 0)
      throw std::runtime_error("expected 1 candidate or more and a delay from 0, got " +
                               std::to_string(top) + " and " + std::to_string(delay));
    top = std::min(top, size());
    std::vector<std::vector<char>> packed;
    std::vector<ssrvlad_queries> queries;
    for (const auto& channel : channels_) {
      std::int64_t anchors;
      packed.push_back(pack(channel, drive, anchors));
      queries.push_back({packed.back().data(), anchors});
    }
    const auto count = drive.size();
    std::vector<float> scores(count * top), sure(3 * count);
    std::vector<std::int64_t> rows(count * top);
    std::vector<double> weights(channels_.size());
    ssrvlad_decision decision{};
    decision.scores = scores.data();
    decision.rows = rows.data();
    decision.right = sure.data();
    decision.spread = sure.data() + count;
    decision.together = sure.data() + 2 * count;
    ssrvlad_taken taken{};
    taken.weights = weights.data();
    ssrvlad_steps steps{};
    steps.standardise = steps.sweep = 1;
    steps.follow = static_cast<std::int32_t>(follow);
    steps.delay = delay;
    steps.top = static_cast<std::int64_t>(top);
    const int threads = static_cast<int>(std::max(1U, std::thread::hardware_concurrency()));
    require(ssrvlad_map_query(map_.get(), queries.data(), static_cast<std::int64_t>(count), &steps,
                              threads, &decision, &taken),
            "the descriptors of the drive");
    const char* alone = channels_.size() > 1 ? "fused score" : "cosine";
    std::vector<Answer> answers;
    for (std::size_t query = 0; query < count; ++query) {
      answers.push_back({{}, decision.followed ? "probability" : alone, sure[query]});
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
    std::string name;  // of the file, after that of the database
    npy::Array rows;
    double trust;

    bool is_signs() const { return rows.dtype == "|u1"; }
  };

  static void require(int status, const std::string& what) {
    if (status == SSRVLAD_NO_MEMORY) throw std::bad_alloc();
    if (status != SSRVLAD_OK)
      throw std::runtime_error("the library ssrvlad refuses " + what + ": expected finite numbers");
  }

  // Adds the array of a channel, if both sides have it.
  void add(const std::string& path, const std::string& end, const std::string& fingerprint,
           const std::string& dtype, std::size_t axes, double trust) {
    const auto file = path + end;
    const bool is_here = end.empty() || std::ifstream(file).good();
    const auto name = end.empty() ? end : end.substr(1, end.size() - 5);
    if (!is_here && !fingerprint.empty())
      std::cerr << "only the model has " << name << ": frames are matched without\n";
    if (is_here && fingerprint.empty())
      std::cerr << "only " << path << " has " << name
                << ": frames are matched without; fuse the file again\n";
    if (!is_here || fingerprint.empty()) return;
    Channel channel{end, npy::load(file), trust};
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

  static void require_fingerprint(const std::string& path, const std::string& fingerprint) {
    std::string own;
    std::ifstream file(path + ".fingerprint.txt");
    if (!detail::read_line(file, own))
      std::cerr << path << " has no fingerprint: it may not fit the model\n";
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
    if (!map_) throw std::bad_alloc();
    for (const auto& channel : channels_) {
      const auto& shape = channel.rows.shape;
      const auto size = shape.size() == 2 ? shape[1] : shape[2] * shape[3];
      const ssrvlad_channel given{channel.rows.bytes.data(),
                                  channel.is_signs() ? SSRVLAD_SIGNS : SSRVLAD_VECTORS,
                                  channel.is_signs() ? shape[1] : 1, size, channel.trust, nullptr};
      require(ssrvlad_map_add_channel(map_.get(), &given), path + channel.name);
    }
  }

  static std::string drive_of(const std::string& frame) {
    const auto end = frame.rfind('/');
    return end == frame.npos ? "" : frame.substr(0, end);
  }

  // The descriptors of all frames of a drive by a channel, one after another, and their anchors.
  static std::vector<char> pack(const Channel& channel, const std::vector<Described>& drive,
                                std::int64_t& anchors) {
    std::vector<char> packed;
    anchors = 1;
    for (const auto& frame : drive) {
      const auto& vector = channel.name.empty() ? frame.descriptor : frame.hog;
      const char* first = channel.is_signs() ? reinterpret_cast<const char*>(frame.features.data())
                                             : reinterpret_cast<const char*>(vector.data());
      const auto size = channel.is_signs() ? frame.features.size() : vector.size() * sizeof(float);
      const auto one = channel.name.empty() ? frame.length * sizeof(float) : size;
      const auto unit = channel.is_signs() ? 1 : sizeof(float);
      const auto expected = channel.rows.bytes.size() / static_cast<std::size_t>(channel.rows.shape[0]);
      if (one != expected || (!packed.empty() && size != static_cast<std::size_t>(anchors) * one))
        throw std::runtime_error("expected a database of " + std::to_string(one / unit) +
                                 " numbers a frame, got " + std::to_string(expected / unit));
      anchors = static_cast<std::int64_t>(size / one);
      if (anchors % 2 == 0)
        throw std::runtime_error("expected descriptors from an odd number of anchors, the usual one in the "
                                 "middle, got " + std::to_string(anchors));
      packed.insert(packed.end(), first, first + size);
    }
    return packed;
  }

  struct Free {
    void operator()(ssrvlad_map* map) const { ssrvlad_map_free(map); }
  };

  std::vector<std::string> frames_;
  std::vector<Channel> channels_;
  std::unique_ptr<ssrvlad_map, Free> map_;
};

}  // namespace ssrvlad
