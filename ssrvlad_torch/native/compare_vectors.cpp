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
constexpr Size AT_ONCE = 96;          // vectors that are multiplied at once to narrow a sweep
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

// The mean of vectors at length 1, those of zeros not counted; zeros without vectors.
class Mean {
 public:
  explicit Mean(Size length) : unit_(static_cast<std::size_t>(length)), sums_(unit_.size()) {}

  void add(const float *vector) {
    if (!normalise(vector, static_cast<Size>(unit_.size()), unit_.data())) return;
    for (std::size_t n = 0; n < sums_.size(); ++n) sums_[n] += static_cast<double>(unit_[n]);
    ++count_;
  }

  Floats value() const {
    Floats mean(sums_.size());
    for (std::size_t n = 0; n < mean.size(); ++n)
      mean[n] = static_cast<float>(sums_[n] / std::max(1.0, count_));
    return mean;
  }

 private:
  Floats unit_;
  std::vector<double> sums_;
  double count_ = 0;
};

Floats mean_of(const float *vectors, Size count, Size length) {
  Mean mean(length);
  for (Size each = 0; each < count; ++each) mean.add(vectors + each * length);
  return mean.value();
}

// A vector at length 1 without a mean, at length 1 again; zeros stay zeros.
void standardise(const float *vector, const float *mean, Size length, float *after) {
  Floats unit(static_cast<std::size_t>(length));
  if (normalise(vector, length, unit.data()) && centre(unit.data(), mean, length, after))
    normalise(after, length, after);
  else
    std::copy(unit.begin(), unit.end(), after);
}

// What is subtracted from a product of a vector, in products with a mean, and what it is then multiplied with;
// nothing of zeros.
std::array<float, 2> factors_of(const float *vector, const float *mean, Size length) {
  Floats centred(static_cast<std::size_t>(length));
  if (!length_of(vector, length)) return {0, 0};
  const bool differs = centre(vector, mean, length, centred.data());
  return {differs ? 1.0F : 0.0F, 1 / length_of(centred.data(), length)};
}

// How much nearer the best row is than the best elsewhere; not finite without one.
double lead_of(const float *scores, const Listing &listing) {
  const auto [best, other] =
      leading(scores, listing.count(), [&](Size row) { return listing.around(row, MODEL.elsewhere); });
  return nearness(static_cast<double>(best)) - nearness(static_cast<double>(other));
}

// Rows as they are compared, and their lengths.
struct Held {
  const float *vectors;
  Floats lengths, own;
};

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

class VectorComparison : public Comparison {
 public:
  VectorComparison(Floats queries, Size count, Size anchors, Size length, const Held &rows, int threads)
      : Comparison(count, static_cast<Size>(rows.lengths.size())), queries_(std::move(queries)),
        anchors_(anchors), length_(length), references_(rows), threads_(threads) {}

 protected:
  void compute(Size first, Size last, float *scores) const override {
    const float *some = queries_.data() + first * anchors_ * length_;
    const Panels panels(some, last - first, anchors_, length_);
    over_blocks(rows(), ROWS_AT_ONCE, threads_, [&](Size start, Size end) {
      panels.best(references_.vectors + start * length_, end - start, scores + start, rows());
      for (Size query = 0; query < last - first; ++query)
        divide(scores + query * rows() + start, references_.lengths.data() + start, end - start);
    });
    for (Size query = 0; query < last - first; ++query, some += anchors_ * length_)
      if (std::all_of(some, some + anchors_ * length_, [](float number) { return number == 0; }))
        std::fill_n(scores + query * rows(), rows(), NONE);
  }

 private:
  Floats queries_;
  Size anchors_, length_;
  const Held &references_;
  int threads_;
};

// The width of the sweep of a drive, in anchors to each side, whose first candidates lead most over a
// sample of the queries; see recognition/sweep.py. Products with the queries are computed once for all
// widths, and those with the mean at each width are subtracted.
class Narrowing {
 public:
  Narrowing(const Floats &units, Size count, Size anchors, Size length, const Held &rows,
            const Listing &listing, bool standardised, int threads)
      : units_(units), count_(count), anchors_(anchors), length_(length), rows_(rows), listing_(listing),
        threads_(threads),
        widths_(anchors / 2 + 1), means_(static_cast<std::size_t>(widths_ * length)),
        of_means_(static_cast<std::size_t>(widths_ * references())),
        leads_(static_cast<std::size_t>(widths_)), known_(leads_.size()) {
    if (standardised && count >= MODEL.min_frames) subtract_means();
  }

  Size width() {
    if (references() <= 2 * MODEL.elsewhere + 1) return 0;
    std::vector<Size> sample;
    for (Size query = 0; query < count_; query += std::max<Size>(1, count_ / MODEL.sample)) sample.push_back(query);
    const std::size_t at_once = static_cast<std::size_t>(std::max<Size>(1, AT_ONCE / anchors_));
    for (std::size_t first = 0; first < sample.size(); first += at_once)
      add_leads(sample.data() + first, static_cast<Size>(std::min(at_once, sample.size() - first)));
    Size best = 0;
    double most = -std::numeric_limits<double>::infinity();
    for (Size width = 0; width < widths_; ++width) {
      const auto at = static_cast<std::size_t>(width);
      const double mean = known_[at] > 0 ? leads_[at] / known_[at] : 0;
      if (mean > most + MODEL.wider) most = mean, best = width;
    }
    return best;
  }

 private:
  Size references() const { return static_cast<Size>(rows_.lengths.size()); }
  const float *unit(Size query, Size anchor) const {
    return units_.data() + (query * anchors_ + anchor) * length_;
  }

  void subtract_means() {
    for (Size width = 0; width < widths_; ++width) {
      Mean mean(length_);
      for (Size query = 0; query < count_; ++query)
        for (Size anchor = anchors_ / 2 - width; anchor <= anchors_ / 2 + width; ++anchor)
          mean.add(unit(query, anchor));
      const Floats value = mean.value();
      std::copy(value.begin(), value.end(), means_.begin() + width * length_);
    }
    const Panels panels(means_.data(), widths_, 1, length_);
    over_blocks(references(), ROWS_AT_ONCE, threads_, [&](Size first, Size last) {
      panels.best(rows_.vectors + first * length_, last - first, of_means_.data() + first, references());
    });
  }

  void add_leads(const Size *queries, Size count) {
    Floats vectors, scores(static_cast<std::size_t>(count * widths_ * references()));
    std::vector<std::array<float, 2>> factors;
    for (Size each = 0; each < count; ++each) {
      vectors.insert(vectors.end(), unit(queries[each], 0), unit(queries[each] + 1, 0));
      for (Size width = 0; width < widths_; ++width)
        for (Size anchor = 0; anchor < anchors_; ++anchor)
          factors.push_back(factors_of(unit(queries[each], anchor), means_.data() + width * length_, length_));
    }
    const Panels panels(vectors.data(), count * anchors_, 1, length_);
    over_blocks(references(), ROWS_AT_ONCE, threads_, [&](Size first, Size last) {
      Floats products(static_cast<std::size_t>(count * anchors_ * ROWS_AT_ONCE));
      panels.best(rows_.vectors + first * length_, last - first, products.data(), ROWS_AT_ONCE);
      for (Size each = 0; each < count * widths_; ++each)
        best_of(products.data() + each / widths_ * anchors_ * ROWS_AT_ONCE,
                factors.data() + each * anchors_, each % widths_, first, last,
                scores.data() + each * references() + first);
    });
    for (Size each = 0; each < count * widths_; ++each) {
      const double lead = lead_of(scores.data() + each * references(), listing_);
      if (!std::isfinite(lead)) continue;
      leads_[static_cast<std::size_t>(each % widths_)] += lead;
      ++known_[static_cast<std::size_t>(each % widths_)];
    }
  }

  // The scores of some rows by the best anchor at a width.
  void best_of(const float *products, const std::array<float, 2> *factors, Size width, Size first,
               Size last, float *best) const {
    std::fill_n(best, last - first, NONE);
    const float *mean = of_means_.data() + width * references() + first;
    for (Size anchor = anchors_ / 2 - width; anchor <= anchors_ / 2 + width; ++anchor) {
      const auto [part, factor] = factors[anchor];
      if (factor > 0)
        raise(best, products + anchor * ROWS_AT_ONCE, mean, part, factor, last - first);
    }
    divide(best, rows_.lengths.data() + first, last - first);
  }

  const Floats &units_;
  Size count_, anchors_, length_;
  const Held &rows_;
  const Listing &listing_;
  int threads_;
  Size widths_;
  Floats means_, of_means_;
  std::vector<double> leads_, known_;
};

// Vectors that come one by one. The sums of the vectors so far, and of their products with each row, are kept
// by the distance of their anchors from the usual one: those up to a width make the mean at this width.
class LiveVectorComparison : public LiveComparison {
 public:
  LiveVectorComparison(Size anchors, bool swept, Size length, const Held &rows, const Listing &listing, Floats prior)
      : anchors_(anchors), widths_(swept ? anchors / 2 + 1 : 1), length_(length), rows_(rows), listing_(listing),
        prior_(std::move(prior)), sums_(static_cast<std::size_t>(widths_)), leads_(sums_.size()),
        known_(sums_.size()) {
    if (prior_.empty()) return;
    of_prior_ = products(prior_.data(), 1, 1);
    for (Sum &sum : sums_) {
      sum.vectors.resize(prior_.size());
      sum.products.resize(of_prior_.size());
    }
  }

  void next(const void *query, int threads, float *scores) override {
    const Size reach = widths_ - 1, rows = listing_.count(), count = 2 * reach + 1;
    const float *first = static_cast<const float *>(query) + (anchors_ / 2 - reach) * length_;
    Floats units(static_cast<std::size_t>(count * length_));
    for (Size anchor = 0; anchor < count; ++anchor)
      normalise(first + anchor * length_, length_, units.data() + anchor * length_);
    const Floats of_rows = products(units.data(), count, threads);
    if (!prior_.empty()) add(units, of_rows);
    Sum sum{std::vector<double>(static_cast<std::size_t>(length_)), std::vector<double>(static_cast<std::size_t>(rows))};
    Floats best(static_cast<std::size_t>(rows));
    double most = -std::numeric_limits<double>::infinity();
    for (Size at = 0; at < widths_; ++at) {
      const auto [mean, of_mean] = means(at, sum);
      std::fill(best.begin(), best.end(), NONE);
      for (Size anchor = reach - at; anchor <= reach + at; ++anchor) {
        const auto [part, factor] = factors_of(units.data() + anchor * length_, mean.data(), length_);
        if (factor > 0) raise(best.data(), of_rows.data() + anchor * rows, of_mean.data(), part, factor, rows);
      }
      divide(best.data(), rows_.lengths.data(), rows);
      const double lead = lead_so_far(best, at);
      if (at && !(lead > most + MODEL.wider)) continue;
      most = lead;
      width = at;
      std::copy(best.begin(), best.end(), scores);
    }
  }

  void keep(Archive &archive) override {
    for (Sum &sum : sums_) archive(sum.vectors), archive(sum.products), archive(sum.count);
    archive(leads_), archive(known_), archive(width);
    for (const Sum &sum : sums_) require(sum.vectors.size() == prior_.size() && sum.products.size() == of_prior_.size());
    require(leads_.size() == sums_.size() && known_.size() == sums_.size());
  }

 private:
  struct Sum {
    std::vector<double> vectors, products;
    double count = 0;
  };

  Floats products(const float *vectors, Size count, int threads) const {
    const Size rows = listing_.count();
    Floats products(static_cast<std::size_t>(count * rows));
    const Panels panels(vectors, count, 1, length_);
    over_blocks(rows, ROWS_AT_ONCE, threads, [&](Size first, Size last) {
      panels.best(rows_.vectors + first * length_, last - first, products.data() + first, rows);
    });
    return products;
  }

  void add(const Floats &units, const Floats &of_rows) {
    const Size reach = widths_ - 1, rows = listing_.count();
    for (Size anchor = 0; anchor <= 2 * reach; ++anchor) {
      Sum &sum = sums_[static_cast<std::size_t>(std::abs(anchor - reach))];
      if (!length_of(units.data() + anchor * length_, length_)) continue;
      for (Size n = 0; n < length_; ++n) sum.vectors[n] += static_cast<double>(units[anchor * length_ + n]);
      for (Size row = 0; row < rows; ++row) sum.products[row] += static_cast<double>(of_rows[anchor * rows + row]);
      ++sum.count;
    }
  }

  // The mean at a width, and the products of the rows with it; `sum` is of all narrower ones.
  std::pair<Floats, Floats> means(Size at, Sum &sum) const {
    Floats mean(sum.vectors.size()), of_mean(sum.products.size());
    if (prior_.empty()) return {mean, of_mean};
    const Sum &next = sums_[static_cast<std::size_t>(at)];
    const double before = static_cast<double>(MODEL.before * (2 * at + 1)), count = (sum.count += next.count) + before;
    for (std::size_t n = 0; n < mean.size(); ++n)
      mean[n] = static_cast<float>(((sum.vectors[n] += next.vectors[n]) + before * static_cast<double>(prior_[n])) / count);
    for (std::size_t row = 0; row < of_mean.size(); ++row)
      of_mean[row] = static_cast<float>(((sum.products[row] += next.products[row]) + before * static_cast<double>(of_prior_[row])) / count);
    return {std::move(mean), std::move(of_mean)};
  }

  // The mean lead of the queries so far at a width, with a query of these scores.
  double lead_so_far(const Floats &scores, Size at) {
    if (listing_.count() <= 2 * MODEL.elsewhere + 1) return 0;
    const double lead = lead_of(scores.data(), listing_);
    if (std::isfinite(lead)) leads_[static_cast<std::size_t>(at)] += lead, ++known_[static_cast<std::size_t>(at)];
    return leads_[static_cast<std::size_t>(at)] / std::max(1.0, known_[static_cast<std::size_t>(at)]);
  }

  Size anchors_, widths_, length_;
  const Held &rows_;
  const Listing &listing_;
  Floats prior_, of_prior_;  // the mean of the map, and the products of its rows with it
  std::vector<Sum> sums_;    // by distance from the usual anchor
  std::vector<double> leads_, known_;
};

class VectorChannel : public Channel {
 public:
  VectorChannel(const float *rows, Size length, const Listing &listing, const float *means)
      : vectors_(rows), length_(length), listing_(listing), drives_(listing.drives), means_(means) {}

  std::unique_ptr<Comparison> compare(const Queries &queries, bool standardised, bool swept,
                                      int threads) override {
    const Held &rows = held(standardised, threads);
    const bool sweeps = swept && queries.anchors > 1;
    const auto *given = static_cast<const float *>(queries.descriptors);
    Size width = sweeps ? queries.anchors / 2 : 0;
    Floats kept = anchors_of(given, queries, width);
    if (sweeps) {
      width = Narrowing(kept, queries.count, queries.anchors, length_, rows, listing_, standardised, threads).width();
      kept = anchors_of(given, queries, width);
    }
    const Size vectors = queries.count * (2 * width + 1);
    if (standardised && queries.count >= MODEL.min_frames) {
      const Floats mean = mean_of(kept.data(), vectors, length_);
      for (Size each = 0; each < vectors; ++each)
        standardise(kept.data() + each * length_, mean.data(), length_, kept.data() + each * length_);
    }
    auto found = std::make_unique<VectorComparison>(std::move(kept), queries.count, 2 * width + 1, length_,
                                                    rows, threads);
    found->width = width;
    return found;
  }

  std::unique_ptr<LiveComparison> live(Size anchors, bool standardised, bool swept, int threads) override {
    Floats prior;
    if (standardised) prior = mean_of(vectors_, drives_.rows, length_);
    return std::make_unique<LiveVectorComparison>(anchors, swept, length_, held(standardised, threads), listing_, std::move(prior));
  }

 private:
  // The vectors of the anchors up to a width, at length 1.
  Floats anchors_of(const float *given, const Queries &queries, Size width) const {
    Floats kept(static_cast<std::size_t>(queries.count * (2 * width + 1) * length_));
    float *target = kept.data();
    for (Size query = 0; query < queries.count; ++query)
      for (Size side = -width; side <= width; ++side, target += length_)
        normalise(given + (query * queries.anchors + queries.anchors / 2 + side) * length_, length_, target);
    return kept;
  }

  const Held &held(bool standardised, int threads) {
    const std::lock_guard<Mutex> hold(mutex_);
    auto &found = held_[standardised];
    if (found) return *found;
    auto fresh = std::make_unique<Held>();
    fresh->vectors = vectors_;
    if (standardised && (means_ || drives_.rows >= MODEL.min_frames)) {
      fresh->own.resize(static_cast<std::size_t>(drives_.rows * length_));
      fresh->vectors = fresh->own.data();
      standardise_rows(fresh->own.data(), threads);
    }
    for (Size row = 0; row < drives_.rows; ++row)
      fresh->lengths.push_back(length_of(fresh->vectors + row * length_, length_));
    found = std::move(fresh);
    return *found;
  }

  void standardise_rows(float *target, int threads) const {
    Floats of_all, mean;
    const float *given = means_;
    for (const Shared &shared : means_ ? each_alone(drives_) : sharing(drives_)) {
      const bool all = !means_ && shared.to - shared.from == drives_.rows;
      if (!means_ && (!all || of_all.empty()))
        mean = mean_of(vectors_ + shared.from * length_, shared.to - shared.from, length_);
      if (all && of_all.empty()) of_all = mean;
      const float *less = means_ ? given : all ? of_all.data() : mean.data();
      if (means_) given += length_;
      over_blocks(shared.last - shared.first, ROWS_AT_ONCE, threads, [&](Size first, Size last) {
        for (Size row = shared.first + first; row < shared.first + last; ++row)
          standardise(vectors_ + row * length_, less, length_, target + row * length_);
      });
    }
  }

  const float *vectors_;
  Size length_;
  const Listing &listing_;
  const Drives &drives_;  // of the list
  const float *means_;
  Mutex mutex_;
  std::array<std::unique_ptr<Held>, 2> held_;
};

}  // namespace

std::unique_ptr<Channel> channel_of_vectors(const float *rows, Size length, const Listing &listing,
                                            const float *means) {
  return std::make_unique<VectorChannel>(rows, length, listing, means);
}

}  // namespace places
