// SPDX-License-Identifier: BSD-3-Clause
#include "fit/edge_pixels.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <numbers>
#include <span>

#include "numeric/simd.hpp"

namespace roundel {

namespace {

constexpr int kNowhere = INT32_MIN / 2;
constexpr Lanes kSteps{0, 1, 2, 3, 4, 5, 6, 7};

ROUNDEL_INLINE Bits floor_of(const Lanes& x) {
    const Bits near = __builtin_convertvector(x, Bits);
    return near + (__builtin_convertvector(near, Lanes) > x);  // a comparison that is true is -1
}

/// An ellipse in a form that makes its intersection with a row cheap; its height is negative if it is empty.
struct RowEllipse {
    float x = 0, y = 0, per_height = 1e6f, width = 0, lean = 0;
    double top = 1e9, bottom = -1e9;

    RowEllipse() = default;
    /// `e` with both half axes a and b longer by `more`; empty if one vanishes.
    RowEllipse(const CircleImage& e, double more) {
        const double ab = std::sqrt(std::max(e.shape.det(), 0.0)),
                     sum = std::sqrt(e.shape.xx + e.shape.yy + 2 * ab);
        const double product = ab + more * (sum + more);  // (a + more) (b + more)
        if (!(product > 0 && sum + 2 * more > 0)) return;
        // (S^(1/2) + more)^2, where S^(1/2) = (S + a b) / (a + b)
        const double scale = 1 + 2 * more / sum, yy = scale * e.shape.yy + more * (2 * ab / sum + more);
        const double height = std::sqrt(yy);
        x = float(e.x);
        y = float(e.y);
        per_height = float(1 / height);
        width = float(product / height);
        lean = float(scale * e.shape.xy / yy);
        top = e.y - height;
        bottom = e.y + height;
    }
};

/// The columns [begin, end) inside of an ellipse.
struct Spans {
    Bits begin, end;
    bool has(int k) const { return begin[k] < end[k]; }
};

/// Eight ellipses, each cut by its own row.
struct RowEllipses {
    Lanes x, y, per_height = all(1e6f), width, lean;
    void set(int k, const RowEllipse& e) {
        x[k] = e.x;
        y[k] = e.y;
        per_height[k] = e.per_height;
        width[k] = e.width;
        lean[k] = e.lean;
    }
    static RowEllipses all_of(const RowEllipse& o) {
        return {all(o.x), all(o.y), all(o.per_height), all(o.width), all(o.lean)};
    }
    ROUNDEL_INLINE Spans cut(const Lanes& rows) const {
        const Lanes dy = rows - y, t = dy * per_height, left = 1.0f - t * t;
        const Bits inside = left > 1e-6f;
        const Lanes share = inside ? left : all(1), half = width * share * inverse_sqrt(share);
        const Lanes middle = x + lean * dy;
        return {inside ? -floor_of(half - middle) : Bits{} + kNowhere,
                inside ? floor_of(middle + half) + 1 : Bits{} + kNowhere};
    }
};

constexpr int kMinRows = 10;         // fewer do not determine an ellipse
constexpr int kWideRows = 3;         // every third row uses the wide band
constexpr double kNegligible = 0.5;  // grey levels: the largest effect of another edge

/// The images of the edges that the band uses.
struct EdgeImages {
    CircleImage of[kEdges];
    bool card;
    EdgeImages(const Parameters& p, const EdgeBand& band) : card(band.card) {
        for (const Edge edge : {kOuterEdge, kInnerEdge, kCardEdge})
            of[edge] = circle_image(p, radius_of(edge, p));
    }
    /// The smallest distance between two edges.
    double gap(Edge outside, Edge inside) const {
        const CircleImage &a = of[outside], &b = of[inside];
        return minor_half_axis(a) - minor_half_axis(b) - std::hypot(a.x - b.x, a.y - b.y);
    }

  private:
    static double minor_half_axis(const CircleImage& e) {
        const double twice = 2 * std::sqrt(std::max(e.shape.det(), 0.0)), trace = e.shape.xx + e.shape.yy;
        return (std::sqrt(trace + twice) - std::sqrt(std::max(trace - twice, 0.0))) / 2;
    }
};

/// The distance from each edge within which no other edge shows. An edge of contrast C changes the level at a
/// distance by at most C exp(-(distance / blur)^2 / 2) / 2.
struct Clearance {
    double of[kEdges];
    Clearance(const EdgeImages& images, const Parameters& p) {
        const auto visible_within = [&](double contrast) {
            return p[kBlur] * std::sqrt(2 * std::log(std::max(1.0, std::abs(contrast) / (2 * kNegligible))));
        };
        const double ring = visible_within(p[kBright] - p[kDark]);
        const double card = images.card ? ring : visible_within(p[kGround] - p[kBright]);
        const double within = images.gap(kOuterEdge, kInnerEdge), beyond = images.gap(kCardEdge, kOuterEdge);
        of[kInnerEdge] = within - ring;
        of[kCardEdge] = beyond - ring;
        of[kOuterEdge] = std::min(within - ring, beyond - card);
    }
};

/// Strips of the pixels within a distance of the edges, as pairs of ellipses: lanes 0 to 2 are the outer
/// boundaries, from the card's edge inwards, lanes 4 to 6 the inner ones. Other lanes are empty.
class Strips {
  public:
    Strips(const EdgeImages& edges, double distance) {
        for (const Edge edge : {kOuterEdge, kInnerEdge, kCardEdge}) {
            if (edge == kCardEdge && !edges.card) continue;
            const CircleImage& e = edges.of[edge];
            const int k = edge == kCardEdge ? 0 : 1 + edge;
            const RowEllipse around(e, distance);
            ellipses_.set(k, around);
            ellipses_.set(4 + k, RowEllipse(e, -distance));
            top_ = std::min(top_, around.top);
            bottom_ = std::max(bottom_, around.bottom);
            area_ += 2 * distance * std::numbers::pi * std::sqrt(2 * (e.shape.xx + e.shape.yy));
            const double whole = std::numbers::pi * square(std::sqrt(e.shape.xx + e.shape.yy) + distance);
            most_ = std::max(most_, whole);
        }
    }
    double area() const { return std::min(area_, most_); }  // an estimate
    double top() const { return top_; }
    double bottom() const { return bottom_; }
    ROUNDEL_INLINE Spans cut(float row) const { return ellipses_.cut(all(row)); }

  private:
    RowEllipses ellipses_{};
    double area_ = 0, most_ = 0, top_ = 1e9, bottom_ = -1e9;
};

/// Eight grey levels, of which `left` are in the image.
ROUNDEL_INLINE Lanes load_levels(const uint8_t* from, int left) {
    uint64_t seen = 0;
    if (left >= kLanes)
        std::memcpy(&seen, from, kLanes);
    else
        for (int i = 0; i < left; ++i) seen |= uint64_t(from[i]) << (8 * i);
    return __builtin_convertvector(widen(seen), Lanes);
}

/// Appends the columns [begin, end) of row y that are inside the image, eight at a time. The next call
/// overwrites the values written beyond the end.
ROUNDEL_INLINE void append(const ImageView& image, int y, int begin, int end, EdgePixels& to) {
    to.expected += std::max(0, end - begin);
    if (y < 0 || y >= image.height) return;
    begin = std::max(begin, 0);
    end = std::min({end, image.width, begin + EdgePixels::kMax - to.end()});
    const uint8_t* row = image.row(y);
    for (int u = begin; u < end; u += kLanes) {
        const int at = to.end() + u - begin;
        store(to.x + at, float(u - to.origin_x) + kSteps);
        store(to.y + at, all(float(y - to.origin_y)));
        store(to.level + at, load_levels(row + u, image.width - u));
    }
    to.used += std::max(0, end - begin);
}

/// Appends the pixels of row y in the strips, left to right and each pixel once.
ROUNDEL_INLINE void append_row(const ImageView& image, int y, const Strips& strips, EdgePixels& to) {
    const Spans spans = strips.cut(float(y - to.origin_y));
    int begin[2 * kEdges];  // left of the centre, then right
    int end[2 * kEdges];    // left of the centre, then right
    for (int k = 0; k < kEdges; ++k) {
        const bool hole = spans.has(4 + k);
        begin[k] = spans.begin[k];
        end[k] = hole ? spans.begin[4 + k] : spans.end[k];
        begin[2 * kEdges - 1 - k] = hole ? spans.end[4 + k] : kNowhere;
        end[2 * kEdges - 1 - k] = spans.end[k];
    }
    int done = kNowhere;
    for (int k = 0; k < 2 * kEdges; ++k) {
        const int from = std::max(begin[k], done);
        if (from < end[k]) {
            append(image, y, from + to.origin_x, end[k] + to.origin_x, to);
            done = end[k];
        }
    }
}

/// Appends every `step`-th row of the strips.
ROUNDEL_CLONES void append_rows(const ImageView& image, const Strips& narrow, const Strips& wide, int step,
                                EdgePixels& to) {
    const int top = int(std::ceil(wide.top())), bottom = int(std::floor(wide.bottom()));
    for (int y = top, k = 0; y <= bottom; y += step, ++k)
        append_row(image, y + to.origin_y, k % kWideRows ? narrow : wide, to);
}

/// Appends every `step`-th row, from `first` on, of one edge's strip.
ROUNDEL_INLINE void append_strip(const ImageView& image, const CircleImage& edge, double distance, int first,
                                 int step, EdgePixels& to) {
    const RowEllipse around(edge, distance), hole(edge, -distance);
    const RowEllipses outside = RowEllipses::all_of(around), inside = RowEllipses::all_of(hole);
    const int bottom = int(std::floor(around.bottom));
    for (int y = first; y <= bottom; y += kLanes * step) {
        const Lanes rows = float(y) + float(step) * kSteps;
        const Spans strip = outside.cut(rows), open = inside.cut(rows);
        for (int k = 0; k < kLanes; ++k) {
            const int row = y + k * step + to.origin_y;
            if (!strip.has(k)) continue;
            append(image, row, strip.begin[k] + to.origin_x,
                   (open.has(k) ? open.begin[k] : strip.end[k]) + to.origin_x, to);
            if (open.has(k)) append(image, row, open.end[k] + to.origin_x, strip.end[k] + to.origin_x, to);
        }
    }
}

/// Appends one part for each edge: every `step`-th row of the narrow strip, every third of these rows of the
/// wide one.
ROUNDEL_CLONES void append_edges(const ImageView& image, const EdgeImages& edges, const Clearance& clearance,
                                 const EdgeBand& band, int step, EdgePixels& to) {
    for (const Edge edge : {kOuterEdge, kInnerEdge, kCardEdge}) {
        if (edge == kCardEdge && !edges.card) continue;
        const CircleImage& e = edges.of[edge];
        const double wide = std::min(band.separate, clearance.of[edge]);
        const int top = int(std::ceil(RowEllipse(e, wide).top));
        for (int k = 0; k < kWideRows; ++k)
            append_strip(image, e, k ? band.narrow : wide, top + k * step, kWideRows * step, to);
        to.end_part(edge);
    }
}

struct MeanLevel {
    Lanes sum, n;
};

ROUNDEL_CLONES void add_outside(const EdgePixels& pixels, const CircleImage& card, MeanLevel& mean) {
    const double det = card.shape.det();
    const float xx = float(card.shape.yy / det), xy = float(-2 * card.shape.xy / det);
    const float yy = float(card.shape.xx / det), x0 = float(card.x), y0 = float(card.y);
    for (int k = 0; k < pixels.count; k += kLanes) {
        const Lanes dx = load(pixels.x + k) - x0, dy = load(pixels.y + k) - y0,
                    level = shown(load(pixels.level + k));
        const Bits outside = (dx * (xx * dx + xy * dy) + yy * dy * dy > 1.0f) & (level >= 0.0f);
        mean.sum += outside ? level : all(0);
        mean.n += outside ? all(1) : all(0);
    }
}

constexpr double kMostPixels = 4000;  // of the disc: levels are then known to a thirtieth of the noise

/// Sums of levels and of their squares, below 2^31 for 30,000 pixels.
struct LevelSums {
    int count = 0, sum = 0, squares = 0;
    Bits sums{};        // `sum` by lanes
    Bits squares_of{};  // `squares` by lanes

    ROUNDEL_INLINE void add(const uint8_t* levels) {
        uint64_t bytes;
        __builtin_memcpy(&bytes, levels, sizeof bytes);
        const Bits level = widen(bytes);
        sums += level;
        squares_of += level * level;
    }
    Plateau mean() const {
        if (count == 0) return {};
        int64_t total = sum, of_squares = squares;
        for (int k = 0; k < kLanes; ++k) {
            total += sums[k];
            of_squares += squares_of[k];
        }
        const double m = double(total) / count;
        return {count, m, double(of_squares) / count - m * m};
    }
};

/// The rows of an image, relative to the origin of the parameters.
struct Rows {
    const ImageView& image;
    int origin_x, origin_y;

    /// Adds the pixels [begin, end) of row y that are inside the image.
    ROUNDEL_INLINE void add(int y, int begin, int end, LevelSums& sums) const {
        if (y + origin_y < 0 || y + origin_y >= image.height) return;
        begin = std::max(begin + origin_x, 0);
        end = std::min(end + origin_x, image.width);
        const uint8_t* row = image.row(y + origin_y);
        int u = begin;
        for (; u + kLanes <= end; u += kLanes) sums.add(row + u);
        for (; u < end; ++u) {
            sums.sum += row[u];
            sums.squares += row[u] * row[u];
        }
        sums.count += std::max(0, end - begin);
    }
};

/// The ellipses between which the plateaus lie, from the outside.
struct PlateauEdges {
    RowEllipse ring, around_hole, hole;
};

ROUNDEL_CLONES void add_up(const Rows& image, const PlateauEdges& edges, int step, LevelSums& ring,
                           LevelSums& hole) {
    const RowEllipses outer = RowEllipses::all_of(edges.ring),
                      middle = RowEllipses::all_of(edges.around_hole),
                      inner = RowEllipses::all_of(edges.hole);
    const int top = int(std::ceil(edges.ring.top)), bottom = int(std::floor(edges.ring.bottom));
    for (int y = top; y <= bottom; y += kLanes * step) {
        const Lanes rows = float(y) + float(step) * kSteps;
        const Spans whole = outer.cut(rows), open = middle.cut(rows), paper = inner.cut(rows);
        for (int k = 0; k < kLanes; ++k) {
            const int row = y + k * step;
            if (!whole.has(k)) continue;
            const bool is_open = open.has(k);
            image.add(row, whole.begin[k], is_open ? open.begin[k] : whole.end[k], ring);
            if (is_open) image.add(row, open.end[k], whole.end[k], ring);
            if (paper.has(k)) image.add(row, paper.begin[k], paper.end[k], hole);
        }
    }
}

}  // namespace

void EdgePixels::sample(int n, EdgePixels& to) const {
    to.clear();
    for (const EdgePart& part : std::span(parts.data(), size_t(part_count))) {
        for (int k = part.begin; k < part.begin + part.count; k += n * kLanes, to.used += kLanes) {
            std::copy_n(x + k, kLanes, to.x + to.used);
            std::copy_n(y + k, kLanes, to.y + to.used);
            std::copy_n(level + k, kLanes, to.level + to.used);
        }
        to.end_part(part.edge);
    }
}

bool mark_clipped(double paper, bool known, EdgePixels& pixels) {
    if (paper < double(kClipped) && !known) return false;
    float* const end = pixels.level + pixels.count;
    const auto above = [&](float least) {
        return std::count_if(pixels.level, end, [&](float level) { return level > least; });
    };
    if (4 * above(kSaturated) < above(kClipped) && !known) return false;
    std::for_each(pixels.level, end, [](float& level) { level += level > kClipped ? kBound : 0; });
    return true;
}

double level_beyond_card(const EdgePixels& pixels, const Parameters& p) {
    MeanLevel mean{};
    add_outside(pixels, circle_image(p, p[kCard]), mean);
    const double n = double(sum(mean.n));
    return n > 0 ? double(sum(mean.sum)) / n : p[kBright];
}

void select_pixels(const ImageView& image, const Parameters& p, const EdgeBand& band, int limit,
                   EdgePixels& pixels) {
    const EdgeImages edges(p, band);
    const Clearance clearance(edges, p);
    const bool separate = band.separate > 0 && clearance.of[kOuterEdge] >= band.narrow;
    const Strips narrow(edges, band.narrow), wide(edges, separate ? band.separate : band.wide);
    const double area = narrow.area() + (wide.area() - narrow.area()) / kWideRows;
    const int rows = int(wide.bottom() - wide.top());
    const int step = std::max(1, std::min(int(std::ceil(area / limit)), rows / kMinRows));
    pixels.clear();
    if (separate) return append_edges(image, edges, clearance, band, step, pixels);
    append_rows(image, narrow, wide, step, pixels);
    pixels.end_part(kAnyEdge);
}

Plateaus read_plateaus(const ImageView& image, const Parameters& p, int origin_x, int origin_y,
                       double distance) {
    const CircleImage outer = circle_image(p, 1), inner = circle_image(p, p[kRatio]);
    const PlateauEdges edges{RowEllipse(outer, -distance), RowEllipse(inner, distance),
                             RowEllipse(inner, -distance)};
    const double area = std::numbers::pi * std::sqrt(std::max(0.0, outer.shape.det()));
    LevelSums ring, hole;
    add_up({image, origin_x, origin_y}, edges, 1 + int(area / kMostPixels), ring, hole);
    return {ring.mean(), hole.mean()};
}

}  // namespace roundel
