// SPDX-License-Identifier: BSD-3-Clause
#include "lens/disc_view.hpp"

#include <algorithm>
#include <cmath>

#include "numeric/disc_outline.hpp"

namespace roundel {

namespace {

constexpr double kRootHalf = 0.70710678118654752;
constexpr Point kAround[] = {{1, 0},  {kRootHalf, kRootHalf},   {0, 1},  {-kRootHalf, kRootHalf},
                             {-1, 0}, {-kRootHalf, -kRootHalf}, {0, -1}, {kRootHalf, -kRootHalf}};

Vector<DiscView::kNumbers> numbers_of(const EllipseShape& e, Point disc) {
    return {e.x, e.y, e.shape.xx, e.shape.xy, e.shape.yy, disc.x, disc.y};
}

}  // namespace

std::pair<DiscView, DiscView> DiscView::both_of(const Vector<kNumbers>& picture) {
    const double x = picture[0], y = picture[1], length = std::sqrt(x * x + y * y + 1);
    const Vector3 ray{x / length, y / length, 1 / length};
    const double sideways = std::hypot(ray.x, ray.z);  // e1 is parallel to the rows
    const Vector3 e1{ray.z / sideways, 0, -ray.x / sideways}, e2 = cross(ray, e1);
    const LinearMap to_plane{e1.x / length, e1.y / length, e2.x / length, e2.y / length};
    const Eigen axes = eigen(mapped(to_plane, {picture[2], picture[3], picture[4]}));
    const double cosine = std::sqrt(std::clamp(axes.second / axes.first, 0.0, 1.0));
    const double sine = std::sqrt(1 - cosine * cosine);
    const Vector3 position = (1 / std::sqrt(axes.first)) * ray, towards = -cosine * ray;
    const Vector3 across = (-sine * std::sin(axes.angle)) * e1 + (sine * std::cos(axes.angle)) * e2;
    return {{position, towards + across}, {position, towards - across}};
}

std::pair<Vector<DiscView::kNumbers>, std::array<Vector<DiscView::kNumbers>, DiscView::kUnknowns>>
DiscView::predict() const {
    const DualConic C = dual_conic_of(c_, n_, 1);
    const Point image{c_.x / c_.z, c_.y / c_.z};
    const double distance = std::sqrt(dot(c_, c_));
    std::array<Vector<kNumbers>, kUnknowns> derivatives;
    const Vector3 steps[] = {{distance, 0, 0}, {0, distance, 0}, {0, 0, distance}};
    for (size_t k = 0; k < 3; ++k) {
        const Vector3& d = steps[k];
        const Point moved{(d.x - image.x * d.z) / c_.z, (d.y - image.y * d.z) / c_.z};
        derivatives[k] = numbers_of(change_of_ellipse(C, change_of_square(c_, d)), moved);
    }
    const auto across = tangents();
    for (size_t k = 0; k < 2; ++k)
        derivatives[3 + k] = numbers_of(change_of_ellipse(C, change_of_square(n_, across[k])), {0, 0});
    return {numbers_of(ellipse_of(C), image), derivatives};
}

/// See Duff et al., JCGT 6, 2017.
std::array<Vector3, 2> DiscView::tangents() const {
    const double sign = std::copysign(1.0, n_.z), a = -1 / (sign + n_.z), b = n_.x * n_.y * a;
    return {{{1 + sign * n_.x * n_.x * a, sign * b, -sign * n_.x}, {b, sign + n_.y * n_.y * a, -n_.y}}};
}

void DiscView::move(const Vector<kUnknowns>& step) {
    const double distance = std::sqrt(dot(c_, c_));
    c_ = c_ + distance * Vector3{step[0], step[1], step[2]};
    const auto across = tangents();
    n_ = n_ + step[3] * across[0] + step[4] * across[1];
    n_ = (1 / std::sqrt(dot(n_, n_))) * n_;
}

bool DiscView::is_visible() const { return c_.z > 1 && dot(c_, n_) < 0; }

std::optional<EllipseShape> ellipse_through(const Lens& lens, Point centre, const Symmetric& A, Point xy,
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
    return EllipseShape{xy.x + shift.x, xy.y + shift.y, mapped(to_plane, S)};
}

}  // namespace roundel
