// Arrays of NumPy's .npy format, versions 1 to 3, in C order and little-endian.

#pragma once

#include <cstddef>
#include <cstdint>
#include <fstream>
#include <iterator>
#include <regex>
#include <stdexcept>
#include <string>
#include <vector>

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

inline std::string field(const std::string& header, const std::string& pattern) {
  std::smatch match;
  if (!std::regex_search(header, match, std::regex(pattern)))
    throw std::runtime_error("the header of the .npy file is damaged");
  return match[1];
}

inline std::vector<std::int64_t> numbers(const std::string& text) {
  const std::regex digits("\\d+");
  std::vector<std::int64_t> values;
  for (std::sregex_iterator it(text.begin(), text.end(), digits), end; it != end; ++it)
    values.push_back(std::stoll(it->str()));
  return values;
}

// Throws std::runtime_error if the file is not such an array or is too short.
inline Array load(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  if (!file) throw std::runtime_error(path + ": cannot be read");
  const std::string content((std::istreambuf_iterator<char>(file)), {});
  if (content.size() < 12 || content.compare(0, 6, "\x93NUMPY") != 0)
    throw std::runtime_error(path + ": not a .npy file");
  const auto byte = [&](std::size_t at) { return static_cast<unsigned char>(content[at]); };
  std::size_t begin = 10, length = byte(8) + (byte(9) << 8);
  if (byte(6) > 1) {
    begin = 12;
    length += (std::size_t{byte(10)} << 16) + (std::size_t{byte(11)} << 24);
  }
  if (content.size() < begin + length) throw std::runtime_error(path + ": ends too early");
  const std::string header = content.substr(begin, length);
  Array array;
  array.dtype = field(header, "'descr': *'([^']*)'");
  array.shape = numbers(field(header, "'shape': *\\(([^)]*)\\)"));
  if (field(header, "'fortran_order': *(True|False)") == "True")
    throw std::runtime_error(path + ": expected C order");
  array.bytes.assign(content.begin() + static_cast<std::ptrdiff_t>(begin + length), content.end());
  const std::size_t width = std::stoul(field(array.dtype, "[|<][a-z](\\d+)$"));
  if (array.bytes.size() != array.size() * width)
    throw std::runtime_error(path + ": the length does not fit the shape");
  return array;
}

}  // namespace npy
