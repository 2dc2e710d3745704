// Values written one after another, and read back in the same order by the same functions.

#ifndef SSRVLAD_ARCHIVE_HPP
#define SSRVLAD_ARCHIVE_HPP

#include <cstdint>
#include <cstring>
#include <deque>
#include <type_traits>
#include <vector>

#include "interface.hpp"

namespace places {

// FNV-1a of words of eight bytes.
inline std::uint64_t digest_of(const void *bytes, std::size_t size, std::uint64_t digest) {
  for (std::size_t i = 0; i < size; i += sizeof(std::uint64_t)) {
    std::uint64_t word = 0;
    std::memcpy(&word, static_cast<const std::uint8_t *>(bytes) + i, std::min(sizeof word, size - i));
    digest = (digest ^ word) * 0x100000001b3;
  }
  return digest ^ (digest >> 32);
}

class Archive {
 public:
  using Bytes = std::vector<std::uint8_t>;

  // Writes.
  explicit Archive(Bytes &target) : target_(&target) {}
  // Reads; bytes that end too early are refused.
  Archive(const std::uint8_t *source, Size size) : source_(source), left_(size) {}

  bool reads() const { return !target_; }
  Size left() const { return left_; }

  template <typename Value>
  std::enable_if_t<std::is_trivially_copyable_v<Value>> operator()(Value &value) {
    copy(&value, sizeof value);
  }

  template <typename Value, typename Memory>
  void operator()(std::vector<Value, Memory> &values) { all(values); }
  template <typename Value>
  void operator()(std::deque<Value> &values) { all(values); }

 private:
  template <typename Values>
  void all(Values &values) {
    auto count = static_cast<std::uint64_t>(values.size());
    (*this)(count);
    if (reads()) {
      require(count <= static_cast<std::uint64_t>(left_), "a whole state");
      values.resize(static_cast<std::size_t>(count));
    }
    for (auto &value : values) (*this)(value);
  }

  void copy(void *value, std::size_t size) {
    if (target_) {
      const auto *bytes = static_cast<const std::uint8_t *>(value);
      target_->insert(target_->end(), bytes, bytes + size);
      return;
    }
    require(static_cast<Size>(size) <= left_, "a whole state");
    std::memcpy(value, source_, size);
    source_ += size;
    left_ -= static_cast<Size>(size);
  }

  Bytes *target_ = nullptr;
  const std::uint8_t *source_ = nullptr;
  Size left_ = 0;
};

}  // namespace places

#endif
