// Finds sequences and single frames in a map, as `ssrvlad query` and `ssrvlad locate` do.
//
//     ssrvlad::Place place("place.onnx");
//     ssrvlad::Map town("town.npy", place.fingerprints());
//     ssrvlad::Tracker tracker(town);  // a sequence while it comes
//     const auto answer = tracker.update(place.describe(pixels, height, width));
//     if (answer->found() && answer->confidence >= 0.9F) std::cout << answer->candidates[0].pose.x;
//     const auto answers = town.query(sequence);  // all described frames of another one, in order
//
// C++17, over the core alone. Errors are std::runtime_error, or std::bad_alloc, after which a Tracker is of no use.
// Several threads may use one Map at a time, with a Tracker each.

#pragma once

#include <algorithm>
#include <cstring>
#include <fstream>
#include <limits>
#include <memory>
#include <new>
#include <optional>
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

// In metres and radians; NaN where it is not known.
struct Pose {
  double x = std::numeric_limits<double>::quiet_NaN(), y = x, heading = x;
};

struct Match {
  std::string frame;
  float score;
  Pose pose;
};

// The answer to one query: its number, from 0; candidates, best first, none for a frame that shows nothing;
// what their scores are, "cosine", "fused score" or "probability"; the probability that the first candidate is
// right; and of a tracker, whether 30 queries came before, whose mean stands for that of the sequence.
struct Answer {
  std::int64_t query = 0;
  std::vector<Match> candidates;
  std::string score_is;
  float confidence = 0;
  bool settled = true;

  bool found() const { return !candidates.empty(); }
};

// By all frames of the sequence, or each frame alone; `Tracker` has a sequence while it comes.
enum class Follow { kNo = SSRVLAD_ALONE, kOffline = SSRVLAD_OFFLINE };

// Descriptors of reference frames from `ssrvlad db export --format npy`: FILE.npy,
// FILE.npy.frames.txt and FILE.npy.fingerprint.txt; and if they exist their poses, FILE.npy.poses.npy, and
// their other channels, FILE.npy.features.npy and FILE.npy.hog.npy.
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
    read_poses(path + ".poses.npy");
    open(path);
  }

  std::size_t size() const { return frames_.size(); }
  // What is left out, in lines.
  const std::vector<std::string>& warnings() const { return warnings_; }

  // The places of the frames of a sequence, in its order: the best `top`, from 1.
  std::vector<Answer> query(const std::vector<Described>& sequence, Follow follow = Follow::kOffline,
                            std::size_t top = 5) const {
    const auto steps = steps_of(static_cast<std::int32_t>(follow), 0, top);
    const auto count = static_cast<std::int64_t>(sequence.size());
    const Queries queries(*this, sequence);
    return decided(count, steps.top, [&](auto* decision, auto* taken, auto*) {
      return ssrvlad_map_query(map_.get(), queries.channels.data(), count, &steps, threads_, decision, taken);
    });
  }

  // The place of one frame.
  Answer locate(const Described& frame, std::size_t top = 5) const {
    return query({frame}, Follow::kNo, top).front();
  }

 private:
  friend class Tracker;

  struct Channel {
    std::string name, file;
    npy::Array rows;

    bool is_signs() const { return rows.dtype == "|u1"; }
  };

  // The descriptors of queries, channel by channel, one after another.
  struct Queries {
    std::vector<std::vector<char>> packed;
    std::vector<ssrvlad_queries> channels;

    Queries(const Map& map, const std::vector<Described>& sequence)
        : packed(map.channels_.size()), channels(packed.size()) {
      for (std::size_t number = 0; number < packed.size(); ++number) {
        channels[number].anchors = map.pack(map.channels_[number], sequence, packed[number]);
        channels[number].descriptors = packed[number].data();
      }
    }
  };

  // What a call of the core decides of `count` queries; it may say the number of the first one, -1 for none.
  template <typename Call>
  std::vector<Answer> decided(std::int64_t count, std::int64_t top, const Call& call) const {
    const auto queries = static_cast<std::size_t>(count), width = static_cast<std::size_t>(top);
    std::vector<float> scores(queries * width), sure(3 * queries);
    std::vector<std::int64_t> rows(queries * width);
    std::vector<std::uint8_t> follows(queries);
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
    std::int64_t first = 0;
    detail::require(call(&decision, &taken, &first), "the descriptors");
    const char* alone = channels_.size() > 1 ? "fused score" : "cosine";
    std::vector<Answer> answers(first < 0 ? 0 : queries);
    for (std::size_t query = 0; query < answers.size(); ++query) {
      auto& answer = answers[query];
      answer.query = first + static_cast<std::int64_t>(query);
      answer.score_is = follows[query] ? "probability" : alone;
      answer.confidence = sure[query];
      for (auto at = query * width; at < (query + 1) * width && rows[at] >= 0; ++at) {
        const auto row = static_cast<std::size_t>(rows[at]);
        answer.candidates.push_back({frames_[row], std::min(1.0F, scores[at]), poses_[row]});
      }
    }
    return answers;
  }

  ssrvlad_steps steps_of(std::int32_t follow, std::int64_t delay, std::size_t top) const {
    if (top < 1 || delay < 0)
      throw std::runtime_error("expected 1 candidate or more and a delay from 0, got " + std::to_string(top) +
                               " and " + std::to_string(delay));
    ssrvlad_steps steps{};
    steps.standardise = steps.sweep = 1;
    steps.follow = follow;
    steps.delay = delay;
    steps.top = static_cast<std::int64_t>(std::min(top, size()));
    return steps;
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

  // (R, 3) float64, if the file is there.
  void read_poses(const std::string& path) {
    poses_.resize(size());
    if (!std::ifstream(path)) return;
    const auto poses = npy::load(path);
    if (poses.dtype != "<f8" || poses.bytes.size() != size() * sizeof(Pose))
      throw std::runtime_error(path + ": expected a (" + std::to_string(size()) + ", 3) array of float64");
    std::memcpy(poses_.data(), poses.bytes.data(), poses.bytes.size());
  }

  void open(const std::string& path) {
    std::vector<std::int64_t> starts;
    for (std::size_t row = 0; row < frames_.size(); ++row)
      if (!row || drive_of(frames_[row]) != drive_of(frames_[row - 1]))
        starts.push_back(static_cast<std::int64_t>(row));
    const ssrvlad_drives drives{starts.data(), static_cast<std::int64_t>(starts.size()),
                                static_cast<std::int64_t>(frames_.size())};
    map_.reset(ssrvlad_map_new(&drives));
    detail::require(map_ ? SSRVLAD_OK : SSRVLAD_WRONG_ARGUMENT, path);
    for (const auto& channel : channels_) {
      const auto& shape = channel.rows.shape;
      ssrvlad_channel rows{};
      rows.rows = channel.rows.bytes.data();
      rows.kind = channel.is_signs() ? SSRVLAD_SIGNS : SSRVLAD_VECTORS;
      rows.columns = channel.is_signs() ? shape[1] : 1;
      rows.height = channel.is_signs() ? shape[2] : 1;
      rows.size = channel.is_signs() ? shape[3] : shape[1];
      rows.trust = detail::trust_of(channel.name);
      detail::require(ssrvlad_map_add_channel(map_.get(), &rows), channel.file);
    }
  }

  static std::string drive_of(const std::string& frame) {
    const auto end = frame.rfind('/');
    return end == frame.npos ? "" : frame.substr(0, end);
  }

  // Packs the descriptors of all frames of a sequence by a channel; returns their anchors.
  std::int64_t pack(const Channel& channel, const std::vector<Described>& sequence, std::vector<char>& packed) const {
    std::int64_t anchors = 1;
    for (const auto& frame : sequence)
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
  std::vector<Pose> poses_;
  std::vector<Channel> channels_;
  std::unique_ptr<ssrvlad_map, Free> map_;
};

// A sequence while it comes, in a map that must outlive it: each answer depends on the frames before and on `delay`
// later ones. It is what `ssrvlad query --follow online` finds. A tracker belongs to one thread at a time.
class Tracker {
 public:
  explicit Tracker(const Map& map, std::int64_t delay = 0, std::size_t top = 5)
      : map_(map), steps_(map.steps_of(SSRVLAD_ONLINE, delay, top)),
        tracker_(ssrvlad_tracker_new(map.map_.get(), &steps_)) {
    detail::require(tracker_ ? SSRVLAD_OK : SSRVLAD_WRONG_ARGUMENT, "a tracker");
  }

  // How many frames it has taken: the number that the next one gets.
  std::int64_t size() const { return ssrvlad_tracker_count(tracker_.get()); }

  // Takes the next frame. The answer to it; with a delay that to the frame so many before, if there is one.
  // A frame that is refused changes nothing.
  std::optional<Answer> update(const Described& frame) {
    const Map::Queries queries(map_, {frame});
    return answer([&](auto* decision, auto* taken, auto* query) {
      return ssrvlad_tracker_update(tracker_.get(), queries.channels.data(), map_.threads_, decision, taken, query);
    });
  }

  // The answer to the first frame that waits for later ones, by those that there are; none if no frame waits.
  std::optional<Answer> finish() {
    return answer([&](auto* decision, auto* taken, auto* query) {
      return ssrvlad_tracker_finish(tracker_.get(), decision, taken, query);
    });
  }

  // Writes the state to a file, whole or not at all.
  void save(const std::string& path) {
    const auto size = ssrvlad_tracker_save(tracker_.get(), nullptr, 0);
    if (size < 0) throw std::bad_alloc();
    std::vector<char> state(static_cast<std::size_t>(size));
    if (ssrvlad_tracker_save(tracker_.get(), state.data(), size) != size) throw std::bad_alloc();
    npy::replace(path, [&](std::ostream& file) { file.write(state.data(), size); });
  }

  // Goes on from a saved state of this map and these settings, before the first frame: later answers are the same.
  // Any other state is refused, and the tracker is then of no use.
  void load(const std::string& path) {
    npy::of_content(path, [&](const std::string& state) {
      detail::require(ssrvlad_tracker_load(tracker_.get(), state.data(), static_cast<std::int64_t>(state.size())),
                      "the state");
    });
  }

 private:
  static constexpr std::int64_t kSettled = 30;  // frames, as of the core

  struct Free {
    void operator()(ssrvlad_tracker* tracker) const { ssrvlad_tracker_free(tracker); }
  };

  template <typename Call>
  std::optional<Answer> answer(const Call& call) {
    auto answers = map_.decided(1, steps_.top, call);
    if (answers.empty()) return std::nullopt;
    answers[0].settled = answers[0].query >= kSettled;
    return answers[0];
  }

  const Map& map_;
  ssrvlad_steps steps_;
  std::unique_ptr<ssrvlad_tracker, Free> tracker_;
};

}  // namespace ssrvlad
