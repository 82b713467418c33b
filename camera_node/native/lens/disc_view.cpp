// SPDX-License-Identifier: BSD-3-Clause
#include "lens/disc_view.hpp"

#include <algorithm>
#include <cmath>

namespace roundel {

namespace {

constexpr double kRootHalf = 0.70710678118654752;
constexpr Point kAround[] = {{1, 0},  {kRootHalf, kRootHalf},   {0, 1},  {-kRootHalf, kRootHalf},
                             {-1, 0}, {-kRootHalf, -kRootHalf}, {0, -1}, {kRootHalf, -kRootHalf}};

double dot(const Point3& a, const Point3& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

Point3 cross(const Point3& a, const Point3& b) {
    return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}

Point3 sum(const Point3& a, double s, const Point3& b, double t, const Point3& c) {
    return {a[0] + s * b[0] + t * c[0], a[1] + s * b[1] + t * c[1], a[2] + s * b[2] + t * c[2]};
}

Point3 scaled(const Point3& a, double s) { return {s * a[0], s * a[1], s * a[2]}; }

/// The elements 11, 12, 22, 13, 23, 33 of a symmetric matrix.
using Dual = std::array<double, 6>;

/// a b^T + b a^T.
Dual symmetric_product(const Point3& a, const Point3& b) {
    return {2 * a[0] * b[0],           a[0] * b[1] + a[1] * b[0], 2 * a[1] * b[1],
            a[0] * b[2] + a[2] * b[0], a[1] * b[2] + a[2] * b[1], 2 * a[2] * b[2]};
}

/// The differential of the ellipse's centre and S for a differential of its dual conic; D has D_33 = 1, and
/// `z` is what it was divided by.
void set_ellipse(const Dual& D, double z, const Dual& change, Vector<DiscView::kNumbers>& to) {
    Dual d;
    for (size_t i = 0; i < d.size(); ++i) d[i] = (change[i] - D[i] * change[5]) / z;
    const double x = D[3], y = D[4];
    to[0] = d[3];
    to[1] = d[4];
    to[2] = 2 * x * d[3] - d[0];
    to[3] = x * d[4] + y * d[3] - d[1];
    to[4] = 2 * y * d[4] - d[2];
}

}  // namespace

std::pair<DiscView, DiscView> DiscView::both_of(const Vector<kNumbers>& picture) {
    const double x = picture[0], y = picture[1], length = std::sqrt(x * x + y * y + 1);
    const Point3 ray{x / length, y / length, 1 / length};
    const double sideways = std::hypot(ray[0], ray[2]);  // e1 is parallel to the rows
    const Point3 e1{ray[2] / sideways, 0, -ray[0] / sideways}, e2 = cross(ray, e1);
    const auto seen = [&](const Point3& a, const Point3& b) {
        return (picture[2] * a[0] * b[0] + picture[3] * (a[0] * b[1] + a[1] * b[0]) +
                picture[4] * a[1] * b[1]) /
               (length * length);
    };
    const Eigen axes = eigen({seen(e1, e1), seen(e1, e2), seen(e2, e2)});
    const double cosine = std::sqrt(std::clamp(axes.second / axes.first, 0.0, 1.0));
    const double sine = std::sqrt(1 - cosine * cosine);
    const Point3 position = scaled(ray, 1 / std::sqrt(axes.first));
    const Point3 towards = scaled(ray, -cosine);
    const double a = -sine * std::sin(axes.angle), b = sine * std::cos(axes.angle);
    return {{position, sum(towards, a, e1, b, e2)}, {position, sum(towards, -a, e1, -b, e2)}};
}

std::pair<Vector<DiscView::kNumbers>, std::array<Vector<DiscView::kNumbers>, DiscView::kUnknowns>>
DiscView::predict() const {
    // The dual conic of the outline, c c^T - (I - n n^T).
    const Dual cc = symmetric_product(c_, c_), nn = symmetric_product(n_, n_);
    const double z = (cc[5] + nn[5]) / 2 - 1;
    constexpr Dual kIdentity{1, 0, 1, 0, 0, 1};
    Dual D;
    for (size_t i = 0; i < D.size(); ++i) D[i] = ((cc[i] + nn[i]) / 2 - kIdentity[i]) / z;
    const double u = c_[0] / c_[2], v = c_[1] / c_[2], distance = std::sqrt(dot(c_, c_));
    const Vector<kNumbers> picture{D[3], D[4], D[3] * D[3] - D[0], D[3] * D[4] - D[1], D[4] * D[4] - D[2],
                                   u,    v};
    std::array<Vector<kNumbers>, kUnknowns> derivatives{};
    for (size_t k = 0; k < 3; ++k) {
        Point3 moved{};
        moved[k] = distance;
        set_ellipse(D, z, symmetric_product(c_, moved), derivatives[k]);
        derivatives[k][5] = (moved[0] - u * moved[2]) / c_[2];
        derivatives[k][6] = (moved[1] - v * moved[2]) / c_[2];
    }
    const auto across = tangents();
    for (size_t k = 0; k < 2; ++k) set_ellipse(D, z, symmetric_product(n_, across[k]), derivatives[3 + k]);
    return {picture, derivatives};
}

/// Two unit vectors perpendicular to the normal and to each other (Duff et al., JCGT 6, 2017).
std::array<Point3, 2> DiscView::tangents() const {
    const double sign = std::copysign(1.0, n_[2]), a = -1 / (sign + n_[2]), b = n_[0] * n_[1] * a;
    return {{{1 + sign * n_[0] * n_[0] * a, sign * b, -sign * n_[0]}, {b, sign + n_[1] * n_[1] * a, -n_[1]}}};
}

void DiscView::move(const Vector<kUnknowns>& step) {
    const double distance = std::sqrt(dot(c_, c_));
    for (size_t k = 0; k < 3; ++k) c_[k] += distance * step[k];
    const auto across = tangents();
    n_ = sum(n_, step[3], across[0], step[4], across[1]);
    n_ = scaled(n_, 1 / std::sqrt(dot(n_, n_)));
}

bool DiscView::is_visible() const { return c_[2] > 1 && dot(c_, n_) < 0; }

std::optional<ShapedEllipse> ellipse_through(const Lens& lens, Point centre, const Symmetric& A, Point xy,
                                             const LinearMap& J) {
    // In coordinates in which the linear approximation is the unit circle.
    const LinearMap to_plane{J.xx * A.xx + J.xy * A.xy, J.xx * A.xy + J.xy * A.yy, J.yx * A.xx + J.yy * A.xy,
                             J.yx * A.xy + J.yy * A.yy};
    const LinearMap to_circle = to_plane.inverse();
    std::array<Vector<5>, 5> H{};
    Vector<5> g{};
    for (const Point& u : kAround) {
        const Point pixel{centre.x + A.xx * u.x + A.xy * u.y, centre.y + A.xy * u.x + A.yy * u.y};
        const auto at = lens.normalise_near(pixel, xy, J);
        if (!at) return std::nullopt;
        const Point p = to_circle * Point{at->x - xy.x, at->y - xy.y};
        const Vector<5> row{p.x * p.x, p.x * p.y, p.y * p.y, p.x, p.y};
        for (int i = 0; i < 5; ++i) {
            g[i] += row[i];
            for (int j = 0; j <= i; ++j) H[i][j] += row[i] * row[j];
        }
    }
    const Cholesky<5> factor(H);
    if (!factor.positive()) return std::nullopt;
    const auto [a, b, c, d, e] = factor.solve(g);  // a x^2 + b x y + c y^2 + d x + e y = 1
    const double det = a * c - b * b / 4;
    if (!(det > 0)) return std::nullopt;
    const Point z{(b * e / 2 - c * d) / (2 * det), (b * d / 2 - a * e) / (2 * det)};
    const double level = 1 + a * z.x * z.x + b * z.x * z.y + c * z.y * z.y;
    const Symmetric S{level * c / det, -level * b / (2 * det), level * a / det};
    const Point shift = to_plane * z;
    const auto mapped = [&](double ux, double uy, double vx, double vy) {
        return ux * S.xx * vx + S.xy * (ux * vy + uy * vx) + uy * S.yy * vy;
    };
    const LinearMap& L = to_plane;
    return ShapedEllipse{
        xy.x + shift.x,
        xy.y + shift.y,
        {mapped(L.xx, L.xy, L.xx, L.xy), mapped(L.xx, L.xy, L.yx, L.yy), mapped(L.yx, L.yy, L.yx, L.yy)}};
}

}  // namespace roundel
