// Frames on disk: finding them, describing label maps and photographs in .npy, PGM and PPM files, and their
// names in JSON.

#pragma once

#include <algorithm>
#include <cctype>
#include <cstdint>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <map>
#include <stdexcept>
#include <string>
#include <tuple>
#include <vector>

#include "npy.hpp"
#include "place.hpp"

namespace ssrvlad {

// A frame of a drive, a folder: its id is `<folder>/<name>`.
struct Frame {
  std::string id;
  std::filesystem::path path;

  std::string drive() const { return id.substr(0, id.rfind('/')); }
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
  npy::Array map{"|u1", {height, width}, std::vector<char>(width * height * (colour ? 3 : 1))};
  if (colour) map.shape.push_back(3);
  if (!file.read(map.bytes.data(), static_cast<std::streamsize>(map.bytes.size())))
    throw std::runtime_error(path + ": ends too early");
  return map;
}

inline npy::Array load_frame(const std::string& path, bool photograph) {
  const bool is_netpbm = std::filesystem::path(path).extension() == (photograph ? ".ppm" : ".pgm");
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

// The frames in folders, or single files; those of a folder in natural order.
inline std::vector<Frame> find_frames(const std::vector<std::string>& sources, bool photographs) {
  std::vector<Frame> frames;
  std::map<std::string, std::filesystem::path> folders;
  for (const std::filesystem::path source : sources) {
    std::vector<std::filesystem::path> files;
    if (!std::filesystem::exists(source))
      throw std::runtime_error(source.string() + " does not exist; expected a file or a folder of frames");
    if (std::filesystem::is_directory(source)) {
      for (const auto& entry : std::filesystem::directory_iterator(source)) {
        const auto end = entry.path().extension();
        if (entry.path().filename().string()[0] != '.' &&
            (end == ".npy" || end == (photographs ? ".ppm" : ".pgm")))
          files.push_back(entry.path());
      }
    } else {
      files.push_back(source);
    }
    if (files.empty()) throw std::runtime_error(source.string() + " holds no frames");
    std::sort(files.begin(), files.end(), [](const auto& one, const auto& other) {
      return detail::natural(one.stem().string()) < detail::natural(other.stem().string());
    });
    const auto folder = std::filesystem::absolute(files[0]).parent_path();
    const auto name = folder.filename().string();
    if (folders.emplace(name, folder).first->second != folder)
      throw std::runtime_error(folders[name].string() + " and " + folder.string() + " have one name");
    for (const auto& file : files) frames.push_back({name + "/" + file.stem().string(), file});
  }
  return frames;
}

// The descriptors of a frame in a file.
inline Described describe(const Place& place, const std::string& path) {
  const auto map = detail::load_frame(path, place.takes_photographs());
  try {
    if (map.dtype == "<i4")
      return place.describe(map.as<std::int32_t>(), map.shape[0], map.shape[1]);
    if (map.dtype == "<i8")
      return place.describe(map.as<std::int64_t>(), map.shape[0], map.shape[1]);
    return place.describe(map.as<std::uint8_t>(), map.shape[0], map.shape[1]);
  } catch (const std::exception& error) {
    throw std::runtime_error(path + ": " + error.what());
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
