// Rows of float vectors, compared by their cosines.

#include <array>

#include "compare.hpp"
#include "fusion.hpp"
#include "interface.hpp"
#include "parallel.hpp"
#include "products.hpp"

namespace places {

namespace {

using Floats = std::vector<float>;

constexpr Size ROWS_AT_ONCE = 192;  // rows that stay in the cache while queries pass by
constexpr Size AT_ONCE = 96;        // vectors that are multiplied at once to narrow a sweep
constexpr double EQUAL = 1e-6;      // a vector this near to the mean equals it

float length_of(const float *vector, Size length) {
  return static_cast<float>(std::sqrt(dot(vector, vector, length)));
}

// A vector of length 1, or zeros; false for zeros.
bool normalise(const float *vector, Size length, float *unit) {
  const float norm = length_of(vector, length);
  for (Size n = 0; n < length; ++n) unit[n] = norm > 0 ? vector[n] / norm : 0;
  return norm > 0;
}

// A vector of length 1 less a mean, not normalised. False if it equals the mean: then it stays.
bool centre(const float *unit, const float *mean, Size length, float *centred) {
  float most = 0;
  for (Size n = 0; n < length; ++n) {
    centred[n] = unit[n] - mean[n];
    most = std::max(most, std::abs(centred[n]));
  }
  if (most > static_cast<float>(EQUAL)) return true;
  std::copy_n(unit, length, centred);
  return false;
}

// The mean of items of vectors at length 1, of those up to a width from the middle one; those of zeros do not count.
// Zeros without vectors.
Floats mean_of(const float *vectors, Size count, Size length, Size anchors = 1, Size width = 0) {
  Floats unit(length), mean(length);
  std::vector<double> sums(length);
  double counted = 0;
  for (Size item = 0; item < count; ++item)
    for (Size anchor = anchors / 2 - width; anchor <= anchors / 2 + width; ++anchor) {
      if (!normalise(vectors + (item * anchors + anchor) * length, length, unit.data())) continue;
      for (Size n = 0; n < length; ++n) sums[n] += static_cast<double>(unit[n]);
      ++counted;
    }
  for (Size n = 0; n < length; ++n) mean[n] = static_cast<float>(sums[n] / std::max(1.0, counted));
  return mean;
}

// A vector at length 1 without a mean, at length 1 again; zeros stay zeros.
void standardise(const float *vector, const float *mean, Size length, float *after) {
  Floats unit(length);
  if (normalise(vector, length, unit.data()) && centre(unit.data(), mean, length, after))
    normalise(after, length, after);
  else
    std::copy(unit.begin(), unit.end(), after);
}

// What is subtracted from a product of a vector, in products with a mean, and what it is then multiplied with;
// nothing of zeros.
using Factors = std::array<float, 2>;

Factors factors_of(const float *vector, const float *mean, Size length) {
  Floats centred(length);
  if (!length_of(vector, length)) return {0, 0};
  const bool differs = centre(vector, mean, length, centred.data());
  return {differs ? 1.0F : 0.0F, 1 / length_of(centred.data(), length)};
}

// Divides scores by the lengths of rows; NONE for rows of length 0.
void divide(float *scores, const float *lengths, Size count) {
  on_cpu([=](auto) {
    for (Size row = 0; row < count; ++row) {
      const float score = scores[row] / lengths[row];
      scores[row] = lengths[row] > 0 ? score : NONE;
    }
  });
}

// Raises scores to products, less a part of those with a mean, times a factor.
void raise(float *scores, const float *products, const float *mean, float part, float factor, Size count) {
  on_cpu([=](auto) {
    for (Size row = 0; row < count; ++row) {
      const float score = (products[row] - part * mean[row]) * factor;
      scores[row] = score > scores[row] ? score : scores[row];
    }
  });
}

// Rows as they are compared, and their lengths.
struct VectorRows {
  const float *vectors;
  Size length;
  Floats lengths, centred;

  Size count() const { return static_cast<Size>(lengths.size()); }
  const float *operator[](Size row) const { return vectors + row * length; }

  // The products (count, rows) with vectors.
  Floats products(const float *others, Size others_count, int threads) const {
    Floats products(others_count * count());
    const Panels panels(others, others_count, 1, length);
    over_blocks(count(), ROWS_AT_ONCE, threads, [&](Size first, Size last) {
      panels.best((*this)[first], last - first, products.data() + first, count());
    });
    return products;
  }

  // The scores of the rows from `first` to `last` by the best of the anchors up to a width from the middle one, by the
  // products and factors of all anchors and the products of all rows with their mean.
  void best_of(Size first, Size last, const float *products, Size pitch, const Factors *factors, Size anchors, Size width,
               const float *of_mean, float *best) const {
    std::fill_n(best, last - first, NONE);
    for (Size anchor = anchors / 2 - width; anchor <= anchors / 2 + width; ++anchor) {
      const auto [part, factor] = factors[anchor];
      if (factor > 0) raise(best, products + anchor * pitch, of_mean + first, part, factor, last - first);
    }
    divide(best, lengths.data() + first, last - first);
  }
};

// By how much queries lead at each width of a sweep: the best row, before the best elsewhere.
class Leads {
 public:
  Leads(Size widths, const Listing &listing) : listing_(listing), sums_(widths), counts_(widths) {}

  void add(Size width, const float *scores) {
    if (listing_.count() <= 2 * MODEL.elsewhere + 1) return;
    const auto [best, other] =
        leading(scores, listing_.count(), [&](Size row) { return listing_.around(row, MODEL.elsewhere); });
    const double lead = nearness(static_cast<double>(best)) - nearness(static_cast<double>(other));
    if (std::isfinite(lead)) sums_[width] += lead, ++counts_[width];
  }

  // The width of the greatest mean lead.
  Size best() const {
    Size best = 0;
    double most = -std::numeric_limits<double>::infinity();
    for (std::size_t width = 0; width < sums_.size(); ++width) {
      const double mean = sums_[width] / std::max(1.0, counts_[width]);
      if (mean > most + MODEL.rounding) most = mean, best = width;
    }
    return best;
  }

  void keep(Archive &archive) {
    const std::size_t widths = sums_.size();
    archive(sums_), archive(counts_);
    require(sums_.size() == widths && counts_.size() == widths);
  }

 private:
  const Listing &listing_;
  std::vector<double> sums_, counts_;
};

// The width of the sweep of a sequence, in anchors to each side, whose first candidates lead most over a sample of
// the queries, vectors of length 1; see recognition/sweep.py. Products with the queries are computed once for all
// widths, and those with the mean at each width are subtracted.
Size narrowed(const Floats &queries, Size count, Size anchors, const VectorRows &rows, const Listing &listing,
              bool standardised, int threads) {
  const Size length = rows.length, widths = anchors / 2 + 1;
  const auto unit = [&](Size query) { return queries.data() + query * anchors * length; };
  Floats means(widths * length), of_means(widths * rows.count());
  if (standardised && count >= MODEL.min_frames) {
    for (Size width = 0; width < widths; ++width) {
      const Floats mean = mean_of(queries.data(), count, length, anchors, width);
      std::copy(mean.begin(), mean.end(), means.begin() + width * length);
    }
    of_means = rows.products(means.data(), widths, threads);
  }
  Leads leads(widths, listing);
  const Size step = std::max<Size>(1, count / MODEL.compared), at_once = step * std::max<Size>(1, AT_ONCE / anchors);
  for (Size first_query = 0; first_query < count; first_query += at_once) {
    Floats vectors;
    std::vector<Factors> factors;  // by query, width and anchor
    for (Size query = first_query; query < std::min(count, first_query + at_once); query += step) {
      vectors.insert(vectors.end(), unit(query), unit(query + 1));
      for (Size width = 0; width < widths; ++width)
        for (Size anchor = 0; anchor < anchors; ++anchor)
          factors.push_back(factors_of(unit(query) + anchor * length, means.data() + width * length, length));
    }
    const Size items = static_cast<Size>(factors.size()) / anchors;  // queries at each width
    const Panels panels(vectors.data(), items / widths * anchors, 1, length);
    Floats scores(items * rows.count());
    over_blocks(rows.count(), ROWS_AT_ONCE, threads, [&](Size first, Size last) {
      Floats products(items / widths * anchors * ROWS_AT_ONCE);
      panels.best(rows[first], last - first, products.data(), ROWS_AT_ONCE);
      for (Size item = 0; item < items; ++item)
        rows.best_of(first, last, products.data() + item / widths * anchors * ROWS_AT_ONCE, ROWS_AT_ONCE,
                     factors.data() + item * anchors, anchors, item % widths,
                     of_means.data() + item % widths * rows.count(), scores.data() + item * rows.count() + first);
    });
    for (Size item = 0; item < items; ++item) leads.add(item % widths, scores.data() + item * rows.count());
  }
  return leads.best();
}

class VectorComparison : public Comparison {
 public:
  VectorComparison(Floats queries, Size count, Size anchors, const VectorRows &rows, int threads)
      : Comparison(count, rows.count()), queries_(std::move(queries)), anchors_(anchors), references_(rows),
        threads_(threads) {}

 protected:
  void compute(Size first, Size last, float *scores) const override {
    const Size size = anchors_ * references_.length;
    const float *query = queries_.data() + first * size;
    const Panels panels(query, last - first, anchors_, references_.length);
    over_blocks(rows(), ROWS_AT_ONCE, threads_, [&](Size start, Size end) {
      panels.best(references_[start], end - start, scores + start, rows());
      for (Size row = 0; row < last - first; ++row)
        divide(scores + row * rows() + start, references_.lengths.data() + start, end - start);
    });
    for (; first < last; ++first, query += size, scores += rows())
      if (std::all_of(query, query + size, [](float number) { return number == 0; })) std::fill_n(scores, rows(), NONE);
  }

 private:
  Floats queries_;
  Size anchors_;
  const VectorRows &references_;
  int threads_;
};

// Vectors that come one by one. What is kept of them are sums of numbers and of products with each row after them, by
// the distance of their anchors from the usual one: those up to a width make the mean at this width.
class LiveVectorComparison : public LiveComparison {
 public:
  LiveVectorComparison(Size anchors, bool swept, const VectorRows &rows, const Listing &listing, Floats prior)
      : reach_(swept ? anchors / 2 : 0), skipped_(anchors / 2 - reach_), rows_(rows), prior_(std::move(prior)),
        sums_(reach_ + 1), leads_(reach_ + 1, listing) {
    if (prior_.empty()) return;
    const Floats of_prior = rows_.products(prior_.data(), 1, 1);
    prior_.insert(prior_.end(), of_prior.begin(), of_prior.end());
    for (Sum &sum : sums_) sum.numbers.resize(prior_.size());
  }

  void next(const void *query, int threads, float *scores) override {
    const Size rows = rows_.count(), length = rows_.length, anchors = 2 * reach_ + 1;
    Floats units(anchors * length);
    for (Size anchor = 0; anchor < anchors; ++anchor)
      normalise(static_cast<const float *>(query) + (skipped_ + anchor) * length, length, units.data() + anchor * length);
    const Floats of_rows = rows_.products(units.data(), anchors, threads);
    if (!prior_.empty()) add(units, of_rows);
    Sum sum{std::vector<double>(prior_.size())};
    Floats mean(length + rows), at_widths((reach_ + 1) * rows);  // the mean, and the products of the rows with it
    std::vector<Factors> factors(anchors);
    for (Size at = 0; at <= reach_; ++at) {
      if (!prior_.empty()) take_mean(at, sum, mean);
      for (Size anchor = reach_ - at; anchor <= reach_ + at; ++anchor)
        factors[anchor] = factors_of(units.data() + anchor * length, mean.data(), length);
      float *best = at_widths.data() + at * rows;
      rows_.best_of(0, rows, of_rows.data(), rows, factors.data(), anchors, at, mean.data() + length, best);
      leads_.add(at, best);
    }
    width = leads_.best();
    std::copy_n(at_widths.data() + width * rows, rows, scores);
  }

  void keep(Archive &archive) override {
    for (Sum &sum : sums_) archive(sum.numbers), archive(sum.count);
    leads_.keep(archive), archive(width);
    for (const Sum &sum : sums_) require(sum.numbers.size() == prior_.size());
  }

 private:
  struct Sum {
    std::vector<double> numbers;
    double count = 0;
  };

  void add(const Floats &units, const Floats &of_rows) {
    const Size rows = rows_.count(), length = rows_.length;
    for (Size anchor = 0; anchor <= 2 * reach_; ++anchor) {
      auto &[numbers, count] = sums_[std::abs(anchor - reach_)];
      const float *unit = units.data() + anchor * length, *products = of_rows.data() + anchor * rows;
      if (!length_of(unit, length)) continue;
      for (Size n = 0; n < length; ++n) numbers[n] += static_cast<double>(unit[n]);
      for (Size row = 0; row < rows; ++row) numbers[length + row] += static_cast<double>(products[row]);
      ++count;
    }
  }

  // The mean at a width; `sum` is of all narrower ones.
  void take_mean(Size at, Sum &sum, Floats &mean) const {
    const double before = static_cast<double>(MODEL.before * (2 * at + 1)), count = (sum.count += sums_[at].count) + before;
    for (std::size_t n = 0; n < mean.size(); ++n) {
      sum.numbers[n] += sums_[at].numbers[n];
      mean[n] = static_cast<float>((sum.numbers[n] + before * static_cast<double>(prior_[n])) / count);
    }
  }

  Size reach_, skipped_;  // anchors to each side that count; others before the first of these
  const VectorRows &rows_;
  Floats prior_;           // the mean of the map, and the products of its rows with it
  std::vector<Sum> sums_;  // by distance from the usual anchor
  Leads leads_;
};

class VectorChannel : public Channel {
 public:
  VectorChannel(const float *rows, Size length, const Listing &listing, const float *means)
      : vectors_(rows), length_(length), listing_(listing), drives_(listing.drives), means_(means) {}

  std::unique_ptr<Comparison> compare(const ssrvlad_queries &queries, Size count, bool standardised, bool swept,
                                      int threads) override {
    const VectorRows &rows = this->rows(standardised, threads);
    Size width = swept ? queries.anchors / 2 : 0;
    Floats units = anchors_of(queries, count, width);
    if (width) {
      width = narrowed(units, count, queries.anchors, rows, listing_, standardised, threads);
      units = anchors_of(queries, count, width);
    }
    if (standardised && count >= MODEL.min_frames) {
      const Floats mean = mean_of(units.data(), count * (2 * width + 1), length_);
      for (float *vector = units.data(); vector < units.data() + units.size(); vector += length_)
        standardise(vector, mean.data(), length_, vector);
    }
    auto comparison =
        std::make_unique<VectorComparison>(std::move(units), count, 2 * width + 1, rows, threads);
    comparison->width = width;
    return comparison;
  }

  std::unique_ptr<LiveComparison> live(Size anchors, bool standardised, bool swept, int threads) override {
    Floats prior;
    if (standardised) prior = mean_of(vectors_, drives_.rows, length_);
    return std::make_unique<LiveVectorComparison>(anchors, swept, rows(standardised, threads), listing_, std::move(prior));
  }

 private:
  // The vectors of the anchors up to a width, at length 1.
  Floats anchors_of(const ssrvlad_queries &queries, Size count, Size width) const {
    const auto *vectors = static_cast<const float *>(queries.descriptors);
    Floats units(count * (2 * width + 1) * length_);
    float *unit = units.data();
    for (Size query = 0; query < count; ++query)
      for (Size side = -width; side <= width; ++side, unit += length_)
        normalise(vectors + (query * queries.anchors + queries.anchors / 2 + side) * length_, length_, unit);
    return units;
  }

  const VectorRows &rows(bool standardised, int threads) {
    const std::lock_guard<Mutex> hold(mutex_);
    auto &slot = rows_[standardised];
    if (slot) return *slot;
    auto rows = std::make_unique<VectorRows>(VectorRows{vectors_, length_, {}, {}});
    std::vector<Shared> shared;
    if (standardised) shared = sharing(drives_, means_, length_);
    if (!shared.empty()) {
      rows->centred.resize(drives_.rows * length_);
      rows->vectors = rows->centred.data();
    }
    Floats of_all;
    for (const auto &[start, end, from, to, fixed] : shared) {
      const bool all = to - from == drives_.rows;
      Floats mean;
      if (fixed) mean.assign(fixed, fixed + length_);
      else mean = all && !of_all.empty() ? of_all : mean_of(vectors_ + from * length_, to - from, length_);
      if (all) of_all = mean;
      over_blocks(end - start, ROWS_AT_ONCE, threads, [&, start = start](Size first, Size last) {
        for (Size at = (start + first) * length_; at < (start + last) * length_; at += length_)
          standardise(vectors_ + at, mean.data(), length_, rows->centred.data() + at);
      });
    }
    for (Size row = 0; row < drives_.rows; ++row) rows->lengths.push_back(length_of((*rows)[row], length_));
    slot = std::move(rows);
    return *slot;
  }

  const float *vectors_;
  Size length_;
  const Listing &listing_;
  const Drives &drives_;  // of the list
  const float *means_;
  Mutex mutex_;
  std::array<std::unique_ptr<VectorRows>, 2> rows_;
};

}  // namespace

std::unique_ptr<Channel> channel_of_vectors(const float *rows, Size length, const Listing &listing,
                                            const float *means) {
  return std::make_unique<VectorChannel>(rows, length, listing, means);
}

}  // namespace places
