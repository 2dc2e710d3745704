// The fingerprint of settings: SHA-256 of a text that Python's json.dumps writes as well.

#include <cstdio>
#include <cstdlib>
#include <map>

#include "interface.hpp"

namespace places {

namespace {

using Word = std::uint32_t;

// Of FIPS 180-4, 4.2.2.
constexpr Word ROUNDS[64] = {
    0x428a2f98, 0x71374491, 0xb5c0fbcf, 0xe9b5dba5, 0x3956c25b, 0x59f111f1, 0x923f82a4, 0xab1c5ed5,
    0xd807aa98, 0x12835b01, 0x243185be, 0x550c7dc3, 0x72be5d74, 0x80deb1fe, 0x9bdc06a7, 0xc19bf174,
    0xe49b69c1, 0xefbe4786, 0x0fc19dc6, 0x240ca1cc, 0x2de92c6f, 0x4a7484aa, 0x5cb0a9dc, 0x76f988da,
    0x983e5152, 0xa831c66d, 0xb00327c8, 0xbf597fc7, 0xc6e00bf3, 0xd5a79147, 0x06ca6351, 0x14292967,
    0x27b70a85, 0x2e1b2138, 0x4d2c6dfc, 0x53380d13, 0x650a7354, 0x766a0abb, 0x81c2c92e, 0x92722c85,
    0xa2bfe8a1, 0xa81a664b, 0xc24b8b70, 0xc76c51a3, 0xd192e819, 0xd6990624, 0xf40e3585, 0x106aa070,
    0x19a4c116, 0x1e376c08, 0x2748774c, 0x34b0bcb5, 0x391c0cb3, 0x4ed8aa4a, 0x5b9cca4f, 0x682e6ff3,
    0x748f82ee, 0x78a5636f, 0x84c87814, 0x8cc70208, 0x90befffa, 0xa4506ceb, 0xbef9a3f7, 0xc67178f2};

Word turned(Word word, int bits) { return word >> bits | word << (32 - bits); }

// The first 8 bytes of SHA-256, in hexadecimal.
std::string digest(std::string text) {
  const std::uint64_t bits = text.size() * 8;
  text += '\x80';
  text.resize((text.size() + 8 + 63) / 64 * 64 - 8);
  for (int byte = 7; byte >= 0; --byte) text += static_cast<char>(bits >> 8 * byte);
  Word hash[8] = {0x6a09e667, 0xbb67ae85, 0x3c6ef372, 0xa54ff53a,
                  0x510e527f, 0x9b05688c, 0x1f83d9ab, 0x5be0cd19};
  for (std::size_t block = 0; block < text.size(); block += 64) {
    Word words[64];
    for (std::size_t i = 0; i < 64; ++i) {
      if (i < 16) {
        words[i] = 0;
        for (std::size_t byte = 0; byte < 4; ++byte)
          words[i] = words[i] << 8 | static_cast<unsigned char>(text[block + 4 * i + byte]);
        continue;
      }
      const Word early = words[i - 15], late = words[i - 2];
      words[i] = words[i - 16] + (turned(early, 7) ^ turned(early, 18) ^ early >> 3) + words[i - 7] +
                 (turned(late, 17) ^ turned(late, 19) ^ late >> 10);
    }
    auto [a, b, c, d, e, f, g, h] = hash;
    for (std::size_t i = 0; i < 64; ++i) {
      const Word one = h + (turned(e, 6) ^ turned(e, 11) ^ turned(e, 25)) + ((e & f) ^ (~e & g)) +
                       ROUNDS[i] + words[i];
      const Word two = (turned(a, 2) ^ turned(a, 13) ^ turned(a, 22)) + ((a & b) ^ (a & c) ^ (b & c));
      h = g, g = f, f = e, e = d + one, d = c, c = b, b = a, a = one + two;
    }
    const Word sums[8] = {a, b, c, d, e, f, g, h};
    for (int i = 0; i < 8; ++i) hash[i] += sums[i];
  }
  char hexadecimal[17];
  std::snprintf(hexadecimal, sizeof hexadecimal, "%08x%08x", hash[0], hash[1]);
  return hexadecimal;
}

// A number from 0 to 4 as Python prints it: the shortest digits that give the same number again.
std::string printed(double number) {
  if (number == 0) return "0.0";
  for (int places = 0;; ++places) {
    char text[40];
    std::snprintf(text, sizeof text, "%.*e", places, number);
    unsigned long long whole = 0;
    const char *at = text;
    for (; *at != 'e'; ++at)
      if (*at >= '0' && *at <= '9') whole = 10 * whole + static_cast<unsigned>(*at - '0');
    const int exponent = std::atoi(at + 1);
    // Above a power of 2 numbers are twice as far apart as below it: the digits may have to be rounded up.
    for (const unsigned long long rounded : {whole, whole + 1}) {
      std::snprintf(text, sizeof text, "%llue%d", rounded, exponent - places);
      if (std::strtod(text, nullptr) != number && places < 17) continue;
      std::string digits = std::to_string(rounded);
      if (exponent >= -4) {
        if (exponent < 0) digits.insert(0, static_cast<std::size_t>(-exponent), '0');
        else if (!places) digits += '0';
        return digits.insert(1, ".");
      }
      if (places) digits.insert(1, ".");
      std::snprintf(text, sizeof text, "e-%02d", -exponent);
      return digits + text;
    }
  }
}

}  // namespace

std::string fingerprint_of(const ssrvlad_settings &s) {
  std::map<std::string, std::string> values = {
      {"rings", std::to_string(s.rings)},
      {"sectors", std::to_string(s.sectors)},
      {"working_size", s.working_size ? std::to_string(s.working_size) : "null"},
      {"radius", printed(s.radius)},
      {"inner_radius", printed(s.inner_radius)}};
  if (s.aggregation == SSRVLAD_RESIDUALS)
    values.insert({{"revision", "1"},
                   {"opening", printed(s.opening)},
                   {"closing", printed(s.closing)},
                   {"hole_area", printed(s.hole_area)},
                   {"region_area", printed(s.region_area)},
                   {"thinning", s.thinning == SSRVLAD_GUO_HALL ? "\"guo-hall\"" : "\"zhang-suen\""},
                   {"context", s.context == SSRVLAD_KEYPOINTS ? "\"keypoints\"" : "\"skeleton\""}});
  else
    values.insert({{"revision", "2"},
                   {"aggregation", "\"harmonics\""},
                   {"anchor", s.anchor == SSRVLAD_MIDDLE ? "\"middle\"" : "\"vanishing-column\""},
                   {"harmonics", std::to_string(s.harmonics)},
                   {"boundary_harmonics", std::to_string(s.boundary_harmonics)},
                   {"spectral_weight", printed(s.spectral_weight)},
                   {"power", printed(s.power)}});
  std::string text;
  for (const auto &[name, value] : values)
    text += (text.empty() ? "{\"" : ", \"") + name + "\": " + value;
  return digest(text + "}");
}

}  // namespace places
