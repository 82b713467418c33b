// SPDX-License-Identifier: BSD-3-Clause
#include "search/change_mask.hpp"

#include <algorithm>
#include <cmath>

#include "numeric/simd.hpp"

namespace roundel {

namespace {

constexpr int kCell = 4;            // tiles of a cell's side
constexpr uint16_t kNever = 65535;  // differs much from any sum
constexpr double kCard = 1.4,
                 kMargin = 12;  // outer diameters; pixels: width of a card, and of tiles around it

int in_units(int length, int unit) { return (length + unit - 1) / unit; }

inline uint8_t mean(uint8_t a, uint8_t b) { return uint8_t((a + b + 1) >> 1); }

/// The mean of eight rows, column by column, in pairs. It is rounded up three times, equally in every frame.
inline void mean_of_rows(const uint8_t* const rows[kTile], int n, uint8_t* to) {
    const uint8_t *a = rows[0], *b = rows[1], *c = rows[2], *d = rows[3], *e = rows[4], *f = rows[5],
                  *g = rows[6], *h = rows[7];
    for (int x = 0; x < n; ++x)
        to[x] = mean(mean(mean(a[x], b[x]), mean(c[x], d[x])), mean(mean(e[x], f[x]), mean(g[x], h[x])));
}

/// The sums of n pairs of adjacent values.
template <typename From>
inline void add_pairs(const From* from, int n, uint16_t* to) {
    for (int x = 0; x < n; ++x) to[x] = uint16_t(from[2 * x] + from[2 * x + 1]);
}

/// Buffers for the mean of some rows, as wide as whole tiles, and for the sums of two and of four columns.
struct ColumnSums {
    std::vector<uint8_t> means;
    std::vector<uint16_t> pairs, fours;
    explicit ColumnSums(int tiles)
        : means(size_t(tiles) * kTile, 0), pairs(means.size() / 2), fours(means.size() / 4) {}
};

/// The sums over the tiles of a mean of eight rows; the last row is repeated if there are fewer.
ROUNDEL_CLONES void add_tiles(const ImageView& rows, int tiles, ColumnSums& columns, uint16_t* to) {
    const uint8_t* eight[kTile];
    for (int k = 0; k < kTile; ++k) eight[k] = rows.row(std::min(k, rows.height - 1));
    mean_of_rows(eight, rows.width, columns.means.data());
    add_pairs(columns.means.data(), 4 * tiles, columns.pairs.data());
    add_pairs(columns.pairs.data(), 2 * tiles, columns.fours.data());
    add_pairs(columns.fours.data(), tiles, to);
}

/// Marks in `changed` which of n unmasked sums differ from the searched ones by more than `limit`.
ROUNDEL_CLONES void compare(const uint16_t* now, const uint16_t* searched, const uint8_t* masked, int n,
                            int limit, uint8_t* changed) {
    for (int x = 0; x < n; ++x) {
        const int off = now[x] - searched[x];
        changed[x] = uint8_t(changed[x] | (((off > limit) | (off < -limit)) & !masked[x]));
    }
}

/// Copies the sums of n tiles except for masked ones.
ROUNDEL_CLONES void copy_unmasked(const uint16_t* now, const uint8_t* masked, int n, uint16_t* searched) {
    for (int x = 0; x < n; ++x) {
        const int keep = -int(masked[x]);  // all ones or none
        searched[x] = uint16_t((searched[x] & keep) | (now[x] & ~keep));
    }
}

}  // namespace

bool Box::meets(const Box& other) const {
    return left <= other.right && other.left <= right && top <= other.bottom && other.top <= bottom;
}

void Box::join(const Box& other) {
    left = std::min(left, other.left);
    top = std::min(top, other.top);
    right = std::max(right, other.right);
    bottom = std::max(bottom, other.bottom);
}

void ChangeMask::update(const ImageView& image) {
    if (image.width != width_ || image.height != height_) {
        width_ = image.width;
        height_ = image.height;
        columns_ = in_units(width_, kTile);
        rows_ = in_units(height_, kTile);
        now_.resize(size_t(columns_) * size_t(rows_));
        searched_.resize(now_.size());
        invalidate();
    }
    masked_.assign(now_.size(), 0);
    ColumnSums columns(columns_);
    for (int y = 0; y < rows_; ++y)
        add_tiles(image.window(0, y * kTile, width_, std::min(kTile, height_ - y * kTile)), columns_, columns,
                  &now_[size_t(y) * size_t(columns_)]);
}

void ChangeMask::invalidate() { std::fill(searched_.begin(), searched_.end(), kNever); }

/// Calls `work` for each tile whose middle is under a roundel or its card.
template <typename Work>
void ChangeMask::visit(const Ellipse& e, const Work& work) {
    const double along = (kCard * e.major + kMargin) / 2, across = (kCard * e.minor + kMargin) / 2;
    const double c = std::cos(e.angle), s = std::sin(e.angle);
    const double ux = c / along, uy = s / along, vx = -s / across, vy = c / across;
    const auto first = [&](double at) { return std::max(int((at - along) / kTile), 0); };
    const auto last = [&](double at, int count) { return std::min(int((at + along) / kTile), count - 1); };
    const int left = first(e.x), right = last(e.x, columns_), bottom = last(e.y, rows_);
    for (int y = first(e.y); y <= bottom; ++y)
        for (int x = left; x <= right; ++x) {
            const double dx = (x + 0.5) * kTile - e.x, dy = (y + 0.5) * kTile - e.y;
            const double u = ux * dx + uy * dy, v = vx * dx + vy * dy;
            if (u * u + v * v < 1) work(size_t(y) * size_t(columns_) + size_t(x));
        }
}

void ChangeMask::mask(const Ellipse& outer) {
    visit(outer, [&](size_t at) { masked_[at] = 1; });
}

void ChangeMask::invalidate(const Ellipse& outer) {
    visit(outer, [&](size_t at) { searched_[at] = kNever; });
}

/// Whether one of the tiles of each cell of 4 x 4 changed.
std::vector<uint8_t> ChangeMask::changed_cells(int limit) const {
    const int across = in_units(columns_, kCell), down = in_units(rows_, kCell);
    std::vector<uint8_t> cells(size_t(across) * size_t(down)), tiles(size_t(across) * kCell);
    for (int v = 0; v < down; ++v) {
        std::fill(tiles.begin(), tiles.end(), 0);
        for (int y = v * kCell; y < std::min((v + 1) * kCell, rows_); ++y) {
            const size_t first = size_t(y) * size_t(columns_);
            compare(&now_[first], &searched_[first], &masked_[first], columns_, limit, tiles.data());
        }
        for (size_t u = 0; u < size_t(across); ++u)
            cells[size_t(v) * size_t(across) + u] =
                tiles[kCell * u] | tiles[kCell * u + 1] | tiles[kCell * u + 2] | tiles[kCell * u + 3];
    }
    return cells;
}

std::vector<Box> ChangeMask::changed(double limit, double share) const {
    constexpr int kSide = kCell * kTile;
    const Box frame{0, 0, width_, height_};
    const auto cells = changed_cells(int(limit * kTile));
    const int across = in_units(columns_, kCell);
    std::vector<Box> boxes;
    double area = 0;
    for (int k = 0; k < int(cells.size()); ++k) {
        if (!cells[size_t(k)]) continue;
        const int x = k % across * kSide, y = k / across * kSide;
        Box box{std::max(x - kSide, 0), std::max(y - kSide, 0), std::min(x + 2 * kSide, width_),
                std::min(y + 2 * kSide, height_)};
        for (size_t n = 0; n < boxes.size();) {
            if (!boxes[n].meets(box)) {
                ++n;
                continue;
            }
            box.join(boxes[n]);
            area -= boxes[n].area();
            boxes[n] = boxes.back();
            boxes.pop_back();
            n = 0;  // the larger box may meet boxes that it did not meet before
        }
        boxes.push_back(box);
        area += box.area();
        if (area > share * frame.area()) return {frame};
    }
    return boxes;
}

void ChangeMask::mark_searched(const Box& box) {
    const int left = in_units(box.left, kTile), n = in_units(box.right, kTile) - left;
    for (int y = in_units(box.top, kTile); y < in_units(box.bottom, kTile); ++y) {
        const size_t at = size_t(y) * size_t(columns_) + size_t(left);
        copy_unmasked(&now_[at], &masked_[at], n, &searched_[at]);
    }
}

}  // namespace roundel
