// Loop closures in a live stream: has this place been seen before? The rules are those of `ssrvlad
// loops`.
//
//     ssrvlad::Loops loops(place.fingerprints());
//     const auto loop = loops.update("drive/000001", place.describe(pixels, height, width), stamp);
//     if (loop.accepted()) std::cout << loop.candidate << " " << loop.confidence;
//     loops.save("drive.npy");
//     auto tomorrow = ssrvlad::Loops::load("drive.npy", place.fingerprints());
//
// C++17, over the core alone. Errors are std::runtime_error, or std::bad_alloc, after which a stream can be saved
// but takes no more frames. A stream belongs to one thread at a time.
//
// A saved stream is one .npy array of records, which NumPy reads as `np.load("drive.npy")["ssr-vlad"]`:
// of each frame its id `frame`, its `stamp`, float64 seconds, NaN where it is not known, and the
// descriptors of its channels, `ssr-vlad` and, where the model gives them, `features` and `hog`. The
// titles of these fields are the fingerprints.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <memory>
#include <stdexcept>
#include <string>
#include <unordered_map>
#include <utility>
#include <vector>

#include "described.hpp"
#include "npy.hpp"
#include <ssrvlad/ssrvlad_loops.h>

namespace ssrvlad {

struct LoopSettings {
  std::int64_t exclude = 50;  // number of the last frames of a sequence, which are no candidates
  double threshold = 0.8;     // least confidence of a loop
  int threads = 1;            // that share the comparison with many frames
};

// An earlier frame, and the confidence that the place is near it.
struct LoopPlace {
  std::string frame;
  double confidence;
};

// The result of a frame; without a candidate its numbers are NaN.
struct Loop {
  std::string frame;
  std::string reason;  // accepted, empty_frame, no_candidate, too_recent, ambiguous or below_threshold
  std::string candidate;  // id of the most probable old frame, or empty
  double score = std::numeric_limits<double>::quiet_NaN();        // a cosine, without the mean so far
  double confidence = std::numeric_limits<double>::quiet_NaN();  // that the place is near the candidate
  std::vector<LoopPlace> candidates;                              // the most probable places, best first

  bool accepted() const { return reason == "accepted"; }
};

class Loops {
 public:
  // A stream without frames. The fingerprints are those of the model that describes its frames.
  explicit Loops(Fingerprints model, LoopSettings settings = {})
      : model_(std::move(model)), settings_(settings) {
    if (settings.exclude < 0 || !(settings.threshold >= 0 && settings.threshold <= 1))
      throw std::runtime_error("expected exclude from 0 and a threshold from 0 to 1, got " +
                               std::to_string(settings.exclude) + " and " +
                               std::to_string(settings.threshold));
  }

  std::size_t size() const { return frames_.size(); }
  const std::vector<std::string>& frames() const { return frames_; }
  bool contains(const std::string& frame) const { return rows_.count(frame) > 0; }

  // Looks for the place of the next frame, `<sequence>/<name>`, among the earlier ones, then stores it.
  // The stamp is in seconds, not less than those of earlier frames of the sequence. A frame that is
  // refused changes nothing.
  Loop update(const std::string& frame, const Described& seen,
              double stamp = std::numeric_limits<double>::quiet_NaN()) {
    ssrvlad_loop found;
    take(frame, seen, stamp, &found);
    return result(frame, found);
  }

  // Writes all frames to a file, whole or not at all.
  void save(const std::string& path) const;

  // The stream in a file, as if its frames had come. The last hundred frames are gone through again,
  // from the usual anchor, which alone is stored: the stream goes on where it was.
  static Loops load(const std::string& path, const Fingerprints& model, LoopSettings settings = {});

 private:
  static constexpr std::size_t kReplayed = 100;
  using Channel = detail::Channel;

  static Loops restored(const std::string& content, const Fingerprints& model, LoopSettings settings);

  // A channel in the header of a saved stream, as NumPy writes it.
  static std::string field(const Channel& channel) {
    const auto [columns, rows, bytes] = channel.shape;
    const bool vectors = channel.kind == SSRVLAD_VECTORS;
    return "(('" + channel.fingerprint + "', '" + channel.name + "'), '" + (vectors ? "<f4" : "|u1") + "', (" +
           std::to_string(columns) + "," +
           (vectors ? "" : " " + std::to_string(rows) + ", " + std::to_string(bytes)) + "))";
  }

  struct Free {
    void operator()(ssrvlad_loops* stream) const { ssrvlad_loops_free(stream); }
  };

  // Takes the next frame, with a result or as one that is known.
  void take(const std::string& frame, const Described& seen, double stamp, ssrvlad_loop* found) {
    const auto sequence = checked(frame, stamp);
    const auto channels = detail::channels_of("frame " + frame, seen, model_);
    if (frames_.empty()) open(channels);
    require_same(frame, channels);
    std::vector<const void*> descriptors;
    std::vector<std::int64_t> anchors;
    for (const auto& channel : channels) {
      descriptors.push_back(channel.data);
      anchors.push_back(channel.anchors);
    }
    const std::uint8_t starts = sequence != sequence_;
    const int status = found
                           ? ssrvlad_loops_update(stream_.get(), descriptors.data(), anchors.data(),
                                                  stamp, starts, settings_.threads, found)
                           : ssrvlad_loops_extend(stream_.get(), descriptors.data(), &stamp, &starts, 1);
    detail::require(status, "frame " + frame);
    rows_[frame] = frames_.size();
    times_.push_back(stamp);
    frames_.push_back(frame);
    sequence_ = sequence;
    if (!std::isnan(stamp)) stamps_[sequence] = stamp;
  }

  void open(const std::vector<Channel>& channels) {
    std::vector<ssrvlad_loops_channel> given;
    for (const auto& channel : channels) {
      const auto [columns, rows, bytes] = channel.shape;
      given.push_back({channel.kind, {columns, rows, bytes}, detail::trust_of(channel.name)});
    }
    const ssrvlad_loops_settings settings{settings_.exclude, settings_.threshold, SSRVLAD_SCAN_ABOVE};
    stream_.reset(ssrvlad_loops_new(&settings, given.data(), static_cast<int>(given.size())));
    if (!stream_) throw std::runtime_error(ssrvlad_last_error());
    channels_ = channels;
  }

  void require_same(const std::string& frame, const std::vector<Channel>& channels) const {
    const auto fields = [](const std::vector<Channel>& some) {
      std::string text;
      for (const auto& channel : some)
        text += (text.empty() ? "" : ", ") + channel.name + " of " + std::to_string(channel.bytes()) +
                " bytes";
      return text;
    };
    const auto expected = fields(channels_), got = fields(channels);
    if (expected != got)
      throw std::runtime_error("frame " + frame + ": expected descriptors " + expected + ", got " + got);
  }

  // The sequence of the next frame.
  std::string checked(const std::string& frame, double stamp) const {
    const auto slash = frame.rfind('/');
    if (slash == frame.npos || slash == 0 || slash + 1 == frame.size())
      throw std::runtime_error("expected a frame's id <sequence>/<name>, got " + frame);
    if (contains(frame)) throw std::runtime_error("frame " + frame + " was there before");
    const auto sequence = frame.substr(0, slash);
    const auto last = stamps_.find(sequence);
    if (std::isinf(stamp) || (last != stamps_.end() && stamp < last->second))
      throw std::runtime_error("frame " + frame +
                               ": expected a finite stamp, not less than the last one");
    return sequence;
  }

  Loop result(const std::string& frame, const ssrvlad_loop& found) const {
    static const char* const kReasons[] = {"accepted",   "empty_frame", "no_candidate",
                                           "too_recent", "ambiguous",   "below_threshold"};
    Loop loop;
    loop.frame = frame;
    loop.reason = kReasons[found.reason];
    if (found.candidate < 0) return loop;
    const auto name = [&](std::int64_t row) { return frames_[static_cast<std::size_t>(row)]; };
    loop.candidate = name(found.candidate);
    loop.score = found.score;
    loop.confidence = found.probability;
    for (int at = 0; at < found.places; ++at)
      loop.candidates.push_back({name(found.best[at].row), found.best[at].probability});
    return loop;
  }

  Fingerprints model_;
  LoopSettings settings_;
  std::unique_ptr<ssrvlad_loops, Free> stream_;
  std::vector<Channel> channels_;
  std::vector<std::string> frames_;
  std::vector<double> times_;
  std::unordered_map<std::string, std::size_t> rows_;
  std::unordered_map<std::string, double> stamps_;  // the last one of each sequence
  std::string sequence_;
};

inline void Loops::save(const std::string& path) const {
  std::size_t width = 8;  // of ids; of whole words, so that numbers stand where a processor likes them
  for (const auto& frame : frames_) width = std::max(width, (frame.size() + 7) / 8 * 8);
  std::string fields = "('frame', '|S" + std::to_string(width) + "'), ('stamp', '<f8')";
  for (const auto& channel : channels_) fields += ", " + field(channel);
  std::string header = "{'descr': [" + fields + "], 'fortran_order': False, 'shape': (" +
                       std::to_string(size()) + ",), }";
  header += std::string(63 - (header.size() + 12) % 64, ' ') + "\n";
  npy::replace(path, [&](std::ostream& file) {
    file.write("\x93NUMPY\x02\x00", 8);
    for (int shift = 0; shift < 32; shift += 8) file.put(static_cast<char>(header.size() >> shift & 255));
    file << header;
    for (std::size_t row = 0; row < size(); ++row) {
      std::string record = frames_[row];
      record.resize(width);
      record.append(reinterpret_cast<const char*>(&times_[row]), sizeof(double));
      for (std::size_t number = 0; number < channels_.size(); ++number) {
        std::vector<char> bytes(channels_[number].bytes());
        const auto at = static_cast<std::int64_t>(row);
        detail::require(
            ssrvlad_loops_descriptors(stream_.get(), static_cast<int>(number), at, at + 1, bytes.data()), frames_[row]);
        record.append(bytes.data(), bytes.size());
      }
      file.write(record.data(), static_cast<std::streamsize>(record.size()));
    }
  });
}

namespace detail {

// The records of a saved stream.
class Records {
 public:
  explicit Records(const std::string& content) : content_(content) {
    const auto [text, end] = npy::header_of(content);
    header_ = text;
    first_ = end;
    const auto shape = npy::lengths(npy::field(header_, "shape", '(', ')'));
    width_ = behind("'frame', '|S");
    if (!width_ || shape.size() != 1) throw std::runtime_error("not a saved stream");
    count_ = static_cast<std::size_t>(shape[0]);
  }

  std::size_t count() const { return count_; }
  // The length of the first axis of a channel; 0 without it.
  std::size_t numbers(const std::string& channel, const std::string& dtype = "<f4") const {
    const auto length = behind("'" + channel + "'), '" + dtype + "', (");
    if (length > content_.size()) throw std::runtime_error("the length does not fit the shape");
    return length;
  }
  bool holds(const std::string& field) const { return header_.find(field) != header_.npos; }

  void require_size(std::size_t bytes) {
    size_ = width_ + sizeof(double) + bytes;
    if (content_.size() - first_ != count_ * size_) throw std::runtime_error("the length does not fit the shape");
  }
  std::string frame(std::size_t row) const {
    return content_.substr(first_ + row * size_, width_).c_str();
  }
  std::string sequence(std::size_t row) const { return frame(row).substr(0, frame(row).rfind('/')); }
  const char* numbers(std::size_t row) const { return content_.data() + first_ + row * size_ + width_; }

 private:
  // The number in the header behind a text; 0 without the text.
  std::size_t behind(const std::string& text) const {
    const auto at = header_.find(text);
    if (at == header_.npos) return 0;
    const auto lengths = npy::lengths(header_.substr(at + text.size(), 9));
    return lengths.empty() ? 0 : static_cast<std::size_t>(lengths[0]);
  }

  const std::string& content_;
  std::string header_;
  std::size_t first_ = 0, width_ = 0, count_ = 0, size_ = 0;
};

}  // namespace detail

inline Loops Loops::load(const std::string& path, const Fingerprints& model, LoopSettings settings) {
  return npy::of_content(path, [&](const std::string& content) { return restored(content, model, settings); });
}

inline Loops Loops::restored(const std::string& content, const Fingerprints& model, LoopSettings settings) {
  detail::Records records(content);
  Loops loops(model, settings);
  Described seen;
  seen.length = records.numbers("ssr-vlad");
  seen.descriptor.resize(seen.length);
  seen.features.resize(records.numbers("features", "|u1") ? 16 * 16 * 16 : 0);
  seen.hog.resize(records.numbers("hog"));
  const std::pair<const char*, bool> lacking[] = {
      {"features", seen.features.empty() && !model.features.empty()},
      {"hog", seen.hog.empty() && !model.hog.empty()}};
  for (const auto& [name, lacks] : lacking)
    if (records.count() && lacks)
      throw std::runtime_error(std::string("other channels than the model has: no ") + name);
  std::size_t bytes = 0;
  if (!records.count()) seen.length = 0;
  for (const auto& channel :
       seen.length ? detail::channels_of("a saved frame", seen, model) : std::vector<Channel>{}) {
    if (!records.holds(field(channel)))
      throw std::runtime_error("other " + channel.name + " than the model has, " + channel.fingerprint +
                               ": they do not compare");
    bytes += channel.bytes();
  }
  records.require_size(bytes);
  std::size_t now = records.count();  // the first frame that is gone through again
  while (now > 0 && records.count() - now < kReplayed &&
         records.sequence(now - 1) == records.sequence(records.count() - 1))
    --now;
  ssrvlad_loop found;
  for (std::size_t row = 0; row < records.count(); ++row) {
    const char* from = records.numbers(row);
    const auto read = [&](void* target, std::size_t size) {
      std::memcpy(target, from, size);
      from += size;
    };
    double stamp;
    read(&stamp, sizeof stamp);
    read(seen.descriptor.data(), seen.length * sizeof(float));
    read(seen.features.data(), seen.features.size());
    read(seen.hog.data(), seen.hog.size() * sizeof(float));
    loops.take(records.frame(row), seen, stamp, row < now ? nullptr : &found);
  }
  return loops;
}

}  // namespace ssrvlad
