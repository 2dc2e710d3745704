// Frames on disk: finding them, describing label maps and photographs in .npy, PGM and PPM files, and their
// names in JSON.

#pragma once

#include <algorithm>
#include <cctype>
#include <cstdint>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <iostream>
#include <map>
#include <stdexcept>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

#include <ssrvlad/npy.hpp>
#include <ssrvlad/place.hpp>

namespace ssrvlad {

// A frame of a sequence, a folder: its id is `<folder>/<name>`.
struct Frame {
  std::string id;
  std::filesystem::path path;

  std::string sequence() const { return id.substr(0, id.rfind('/')); }
};

namespace detail {

inline npy::Array load_netpbm(const std::string& path, bool colour) {
  std::ifstream file(path, std::ios::binary);
  std::string magic;
  std::int64_t width = 0, height = 0, highest = 0;
  if (!(file >> magic >> width >> height >> highest) || magic != (colour ? "P6" : "P5") ||
      highest > 255 || (colour && highest < 255) || width < 1 || height < 1 || width > 1 << 20 ||
      height > 1 << 20)
    throw std::runtime_error(
        path + ": expected a binary " +
        (colour ? "PPM whose largest value is 255" : "PGM of 8 bits") + ", without comments");
  file.get();
  const auto size = static_cast<std::size_t>(width * height * (colour ? 3 : 1));
  if (std::filesystem::file_size(path) < size) throw std::runtime_error(path + ": ends too early");
  npy::Array map{"|u1", {height, width}, std::vector<char>(size)};
  if (colour) map.shape.push_back(3);
  if (!file.read(map.bytes.data(), static_cast<std::streamsize>(map.bytes.size())))
    throw std::runtime_error(path + ": ends too early");
  return map;
}

// The end of the name of a file, in small letters.
inline std::string suffix(const std::filesystem::path& path) {
  auto end = path.extension().string();
  for (char& letter : end) letter = static_cast<char>(std::tolower(static_cast<unsigned char>(letter)));
  return end;
}

// What is expected of another file than label maps or photographs, and how to make it.
inline std::string formats(bool photographs) {
  const std::string end = photographs ? "ppm" : "pgm";
  return "expected ." + end + " or .npy files; ImageMagick makes them of others: mogrify -format " + end + " *." +
         (photographs ? "jpg" : "png");
}

inline npy::Array load_frame(const std::string& path, bool photograph) {
  const bool is_netpbm = suffix(path) == (photograph ? ".ppm" : ".pgm");
  if (!is_netpbm && suffix(path) != ".npy") throw std::runtime_error(path + ": " + formats(photograph));
  auto map = is_netpbm ? load_netpbm(path, photograph) : npy::load(path);
  const bool fits = photograph ? map.shape.size() == 3 && map.shape[2] == 3 && map.dtype == "|u1"
                               : map.shape.size() == 2 && (map.dtype == "|u1" || map.dtype == "<i4" ||
                                                           map.dtype == "<i8");
  if (!fits || map.size() == 0)
    throw std::runtime_error(path + ": expected an " +
                             (photograph ? "(H, W, 3) photograph of uint8"
                                         : "(H, W) map of uint8, int32 or int64") +
                             ", got " + std::to_string(map.shape.size()) + " axes of " + map.dtype);
  return map;
}

// The order of `ssrvlad encode`: numbers by value, also decimal numbers that are a whole name, and
// before text.
inline std::vector<std::tuple<bool, std::string>> natural(std::string name) {
  const auto is_digit = [](char c) { return std::isdigit(static_cast<unsigned char>(c)) != 0; };
  const auto point = name.find('.');
  const auto digits = std::count_if(name.begin(), name.end(), is_digit);
  const auto size = static_cast<std::ptrdiff_t>(name.size());
  if (digits + 1 == size && point != name.npos && point > 0 && point + 1 < name.size())
    name.append(21 + point - std::min(21 + point, name.size()), '0');
  std::vector<std::tuple<bool, std::string>> parts;
  for (std::size_t at = 0; at < name.size();) {
    auto end = at + 1;
    const bool number = is_digit(name[at]);
    while (number && end < name.size() && is_digit(name[end])) ++end;
    auto part = name.substr(at, end - at);
    if (number) part.insert(0, 24 - std::min<std::size_t>(24, part.size()), '0');
    parts.emplace_back(!number, part);
    at = end;
  }
  return parts;
}

}  // namespace detail

// Whether the names of frames come on standard input, one a line.
inline bool come_live(const std::vector<std::string>& sources) { return sources == std::vector<std::string>{"-"}; }

// Refuses what is no file or folder of frames, before a model is known.
inline void require_frames(const std::vector<std::string>& sources) {
  if (come_live(sources)) return;
  for (const std::filesystem::path source : sources) {
    if (!std::filesystem::exists(source))
      throw std::runtime_error(source.string() + " does not exist; expected a file or a folder of frames");
    const auto end = detail::suffix(source);
    if (!std::filesystem::is_directory(source) && end != ".npy" && end != ".ppm" && end != ".pgm")
      throw std::runtime_error(source.string() + ": " + detail::formats(end != ".png"));
  }
}

// The frames in folders, or single files; those of a folder in natural order. Two may have one id.
inline std::vector<Frame> find_frames(const std::vector<std::string>& sources, bool photographs) {
  namespace fs = std::filesystem;
  require_frames(sources);
  std::map<std::string, fs::path> folders;
  std::vector<std::pair<std::string, std::vector<fs::path>>> drives;
  for (const fs::path source : sources) {
    std::vector<fs::path> files;
    if (fs::is_directory(source)) {
      for (const auto& entry : fs::directory_iterator(source)) {
        const auto end = detail::suffix(entry.path());
        if (entry.path().filename().string()[0] != '.' &&
            (end == ".npy" || end == (photographs ? ".ppm" : ".pgm")))
          files.push_back(entry.path());
      }
    } else {
      files.push_back(source);
    }
    if (files.empty())
      throw std::runtime_error(source.string() + " holds no frames: " + detail::formats(photographs));
    const auto folder = fs::absolute(files[0]).lexically_normal().parent_path();
    const auto name = folder.filename().string();
    const auto known = folders.emplace(name, fs::weakly_canonical(folder));
    if (known.first->second != fs::weakly_canonical(folder))
      throw std::runtime_error(folders[name].string() + " and " + folder.string() + " have one name");
    if (known.second) drives.emplace_back(name, std::vector<fs::path>{});
    for (auto& [drive, own] : drives)
      if (drive == name) own.insert(own.end(), files.begin(), files.end());
  }
  std::vector<Frame> frames;
  for (auto& [name, files] : drives) {
    std::sort(files.begin(), files.end(), [](const auto& one, const auto& other) {
      const auto key = [](const auto& file) {
        const auto stem = file.stem().string();
        return std::pair(detail::natural(stem), stem);
      };
      return key(one) < key(other);
    });
    for (const auto& file : files) frames.push_back({name + "/" + file.stem().string(), file});
  }
  return frames;
}

// Passes each frame to a job in order, one whose name comes on standard input when it has come; returns how many.
template <typename Job>
std::size_t for_each_frame(const std::vector<std::string>& sources, bool photographs, const Job& job) {
  std::size_t count = 0;
  if (!come_live(sources)) {
    for (const auto& frame : find_frames(sources, photographs)) job(frame), ++count;
    return count;
  }
  for (std::string line; std::getline(std::cin, line);) {
    if (!line.empty() && line.back() == '\r') line.pop_back();
    const std::filesystem::path path = line;
    if (line.empty()) continue;
    job(Frame{std::filesystem::absolute(path).parent_path().filename().string() + "/" + path.stem().string(), path});
    ++count;
  }
  return count;
}

// The descriptors of a frame in a file.
inline Described describe(const Place& place, const std::string& path) {
  try {
    const auto map = detail::load_frame(path, place.takes_photographs());
    if (map.dtype == "<i4")
      return place.describe(map.as<std::int32_t>(), map.shape[0], map.shape[1]);
    if (map.dtype == "<i8")
      return place.describe(map.as<std::int64_t>(), map.shape[0], map.shape[1]);
    return place.describe(map.as<std::uint8_t>(), map.shape[0], map.shape[1]);
  } catch (const std::exception& error) {
    const std::string reason = error.what();
    throw std::runtime_error(reason.compare(0, path.size(), path) ? path + ": " + reason : reason);
  }
}

// A text in JSON.
inline std::string quoted(const std::string& text) {
  std::string found = "\"";
  for (const char each : text) {
    char code[8];
    std::snprintf(code, sizeof code, "\\u%04x", static_cast<unsigned char>(each));
    if (each == '"' || each == '\\')
      (found += '\\') += each;
    else
      found += static_cast<unsigned char>(each) < 0x20 ? code : std::string(1, each);
  }
  return found + '"';
}

}  // namespace ssrvlad
