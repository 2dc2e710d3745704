// Functions of the core's confidence.hpp for the tests, which call them one by one.

#include <algorithm>

#include "confidence.hpp"

using namespace places;

extern "C" {
double chance(const float *values, const Size *rows, Size count, Size matching, Size *rival) {
  const Drives drives{{0}, rows && count ? rows[count - 1] + 1 : count};
  const Chance chance = chance_of(values, rows ? drives.some(rows, count) : drives.all(), matching);
  *rival = chance.rival;
  return chance.chance;
}

void mapped(const double *chances, Size queries, double together, double *has) {
  const auto probabilities = mapped({chances, chances + queries}, together);
  std::copy(probabilities.begin(), probabilities.end(), has);
}

void mapped_along(const double *nearer, const double *together, Size queries, double *has) {
  const auto probabilities = mapped_along({nearer, nearer + queries}, {together, together + queries});
  std::copy(probabilities.begin(), probabilities.end(), has);
}

void confidence(const double *chances, const double *has, Size queries, double together, int followed,
                float *right, float *spread) {
  const auto sure = Confidence::of({chances, chances + queries}, {has, has + queries}, together, followed);
  std::copy(sure.right.begin(), sure.right.end(), right);
  std::copy(sure.spread.begin(), sure.spread.end(), spread);
}

void together(const double *chances, const Size *rivals, Size queries, double *together) {
  const auto lengths = rivals_together({chances, chances + queries}, {rivals, rivals + queries});
  std::copy(lengths.begin(), lengths.end(), together);
}
}
