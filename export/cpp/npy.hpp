// Arrays of NumPy's .npy format, versions 1 to 3, in C order and little-endian.

#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <random>
#include <stdexcept>
#include <string>
#include <system_error>
#include <vector>

#if !defined(_WIN32)
#include <fcntl.h>
#include <unistd.h>
#endif

namespace npy {

struct Array {
  std::string dtype;                // NumPy's name: "|u1", "<i8", "<f4"
  std::vector<std::int64_t> shape;
  std::vector<char> bytes;

  template <typename T>
  const T* as() const { return reinterpret_cast<const T*>(bytes.data()); }

  std::size_t size() const {
    std::size_t product = 1;
    for (auto axis : shape) product *= static_cast<std::size_t>(axis);
    return product;
  }
};

// What stands behind the name of a field of a header.
inline std::string behind(const std::string& header, const std::string& name) {
  const auto key = "'" + name + "':";
  auto at = header.find(key);
  if (at != header.npos) at = header.find_first_not_of(' ', at + key.size());
  if (at == header.npos) throw std::runtime_error("its header is damaged");
  return header.substr(at);
}

// The text of a field between two letters.
inline std::string field(const std::string& header, const std::string& name, char open, char close) {
  const auto text = behind(header, name);
  const auto end = text.find(close, 1);
  if (text[0] != open || end == text.npos) throw std::runtime_error("its header is damaged");
  return text.substr(1, end - 1);
}

// The lengths in the text of a shape, such as "3, 4" or "3,".
inline std::vector<std::int64_t> lengths(const std::string& text) {
  constexpr std::size_t kMostDigits = 18, kMostAxes = 32;
  std::vector<std::int64_t> values;
  for (std::size_t at = 0; (at = text.find_first_of("0123456789", at)) != text.npos;) {
    const auto end = std::min(text.find_first_not_of("0123456789", at), text.size());
    if (end - at > kMostDigits || values.size() == kMostAxes)
      throw std::runtime_error("its header is damaged");
    values.push_back(std::stoll(text.substr(at, end - at)));
    at = end;
  }
  return values;
}

// The header in the content of a file, and where the numbers begin.
struct Header {
  std::string text;
  std::size_t end;
};

inline Header header_of(const std::string& content) {
  if (content.size() < 12 || content.compare(0, 6, "\x93NUMPY") != 0)
    throw std::runtime_error("not a .npy file");
  const auto byte = [&](std::size_t at) { return static_cast<unsigned char>(content[at]); };
  std::size_t begin = 10, length = byte(8) + (byte(9) << 8);
  if (byte(6) > 1) {
    begin = 12;
    length += (std::size_t{byte(10)} << 16) + (std::size_t{byte(11)} << 24);
  }
  if (content.size() < begin + length) throw std::runtime_error("ends too early");
  return {content.substr(begin, length), begin + length};
}

// The array in the content of a file; see `load`.
inline Array parsed(const std::string& content) {
  const auto [header, begin] = header_of(content);
  Array array;
  array.shape = lengths(field(header, "shape", '(', ')'));
  if (behind(header, "descr")[0] == '[')
    throw std::runtime_error("expected an array of numbers, got records");
  array.dtype = field(header, "descr", '\'', '\'');
  if (array.dtype.size() != 3 || array.dtype[2] < '1' || array.dtype[2] > '8' ||
      (array.dtype[0] != '|' && array.dtype[0] != '<'))
    throw std::runtime_error("expected numbers of up to 8 bytes, little-endian, got " + array.dtype);
  if (behind(header, "fortran_order").compare(0, 5, "False") != 0)
    throw std::runtime_error("expected C order");
  array.bytes.assign(content.begin() + static_cast<std::ptrdiff_t>(begin), content.end());
  std::size_t size = static_cast<std::size_t>(array.dtype[2] - '0');
  for (const auto axis : array.shape) {
    if (axis && size > array.bytes.size() / static_cast<std::size_t>(axis))
      throw std::runtime_error("the length does not fit the shape");
    size *= static_cast<std::size_t>(axis);
  }
  if (array.bytes.size() != size) throw std::runtime_error("the length does not fit the shape");
  return array;
}

// Throws std::runtime_error if a file cannot be read.
inline void require(const std::string& path) {
  if (!std::ifstream(path)) throw std::runtime_error(path + ": cannot be read");
}

// Writes a file, or the names in a folder, to the disk, where the system can be asked to; whether it did.
inline bool flush([[maybe_unused]] const std::filesystem::path& path) {
#if defined(_WIN32)
  return true;
#else
  const int descriptor = ::open(path.c_str(), O_RDONLY | O_CLOEXEC);
  const bool flushed = descriptor >= 0 && ::fsync(descriptor) == 0;
  if (descriptor >= 0) ::close(descriptor);
  return flushed;
#endif
}

// Writes a file by a job, whole or not at all, also where the power fails.
template <typename Job>
void replace(const std::filesystem::path& path, const Job& job) {
  const std::filesystem::path temporary = path.string() + "." + std::to_string(std::random_device{}()) + ".part";
  try {
    std::ofstream file(temporary, std::ios::binary);
    job(file);
    file.close();
    if (!file || !flush(temporary)) throw std::runtime_error(path.string() + ": cannot be written");
    std::filesystem::rename(temporary, path);
  } catch (...) {
    std::error_code absent;
    std::filesystem::remove(temporary, absent);
    throw;
  }
  flush(std::filesystem::absolute(path).parent_path());
}

// What a job makes of the content of a file; its error names the file.
template <typename Job>
auto of_content(const std::string& path, const Job& job) {
  std::ifstream file(path, std::ios::binary);
  if (!file) throw std::runtime_error(path + ": cannot be read");
  const std::string content((std::istreambuf_iterator<char>(file)), {});
  try {
    return job(content);
  } catch (const std::runtime_error& error) {
    throw std::runtime_error(path + ": " + error.what());
  }
}

// Throws std::runtime_error if the file is not such an array or is too short.
inline Array load(const std::string& path) { return of_content(path, parsed); }

}  // namespace npy
