// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <array>
#include <numbers>

#include "numeric/cholesky.hpp"
#include "numeric/ellipse.hpp"
#include "numeric/gram.hpp"
#include "numeric/lanes.hpp"

namespace roundel {

/// The parameters of a roundel's picture (see detector_model.md). A point X of its plane, in outer
/// radii, projects to x = c + A X / (1 + g . X): c is the image of the disc's centre, g the perspective, and
/// the image of every circle |X| = r is an ellipse.
///
/// The pose is last, so that its covariance follows from the last block of a Cholesky factor.
enum Parameter { kBright, kDark, kGround, kBlur, kRatio, kCard, kX, kY, kAxx, kAxy, kAyy, kGx, kGy };
constexpr double kCardRatio = 9.0 / 7;  // card over outer diameter, if it is not fitted
constexpr double kMinCardStep = 0.2;    // of the contrast: a smaller step from card to ground does not show
constexpr int kCount = kGy + 1, kPoseCount = kCount - kX;
using Parameters = Vector<kCount>;

/// The circles at which the grey level changes; kAnyEdge stands for any of them, or several that are close.
enum Edge { kOuterEdge, kInnerEdge, kCardEdge, kAnyEdge };
constexpr int kEdges = kAnyEdge;

constexpr double radius_of(Edge edge, const Parameters& p) {
    return edge == kInnerEdge ? p[kRatio] : edge == kCardEdge ? p[kCard] : 1;
}

/// The parameters that hold the grey levels on either side of an edge.
struct Sides {
    Parameter inside, outside;
};
constexpr Sides kSidesOf[kEdges] = {{kDark, kBright}, {kBright, kDark}, {kBright, kGround}};

inline double square(double x) { return x * x; }

/// The image of the circle |X| = r, from its dual conic M diag(r^2, r^2, -1) M^T, M = [A + c g^T, c; g^T, 1]
/// (Hartley and Zisserman, result 2.14). Its points are centre + S^(1/2) u, |u| = 1, with S = `shape`.
struct CircleImage {
    double x, y;
    Symmetric shape;
};

inline CircleImage circle_image(const Parameters& p, double r) {
    const double hx = p[kAxx] * p[kGx] + p[kAxy] * p[kGy], hy = p[kAxy] * p[kGx] + p[kAyy] * p[kGy];
    const double k = r * r / (1 - r * r * (p[kGx] * p[kGx] + p[kGy] * p[kGy]));
    const Symmetric AA{p[kAxx] * p[kAxx] + p[kAxy] * p[kAxy], p[kAxy] * (p[kAxx] + p[kAyy]),
                       p[kAxy] * p[kAxy] + p[kAyy] * p[kAyy]};
    return {p[kX] - k * hx,
            p[kY] - k * hy,
            {k * AA.xx + k * k * hx * hx, k * AA.xy + k * k * hx * hy, k * AA.yy + k * k * hy * hy}};
}

constexpr float kAbsent = 1e9f;  // a residual that does not count

constexpr float kSaturated = 254.5f;
/// Added to a level that is a lower bound: noise and compression scatter the levels of clipped paper to below
/// the scale's end.
constexpr float kBound = 256;
constexpr float kClipped = 225;  // the least of the levels that they make of it

/// The grey level of a pixel that may be a lower bound.
ROUNDEL_INLINE Lanes shown(const Lanes& seen) { return seen - (seen < kBound ? all(0) : all(kBound)); }

/// Pixels that do not count: padding (level -1), and clipped pixels whose modelled `level` is out of range.
ROUNDEL_INLINE Bits is_uninformative(const Lanes& seen, const Lanes& level) {
    const Bits clipped = ((seen > kSaturated) & (level > shown(seen))) | ((seen < 0.5f) & (level < 0.0f));
    return (seen < 0.0f) | clipped;
}

/// For a chunk of pixels: the gradient of the grey levels by the parameters, the part of their derivative by
/// the distance that the ring's two edges contribute, and the residuals.
struct Gradient {
    Lanes by[kCount][kChunk], ring[kChunk], residual[kChunk];
};

/// The grey levels of pixels as a function of the parameters.
///
/// The profile of each edge is a normal distribution of the distance to its ellipse, to first order
/// (f - r) / |grad f| with f = |X|. Blur moves the half level of an edge towards its centre of curvature by
/// curvature blur^2 / 2. The loops are short, so that a processor can overlap their iterations.
///
/// For pixels that show a single edge, the model contains only that edge. Its ellipse replaces the pose,
/// without perspective (see edge_ellipse.hpp), and only the gradient by the levels on its sides, the blur and
/// kX to kAyy is set.
template <Edge edge>
class ModelOf {
  public:
    explicit ModelOf(const Parameters& p) {
        const double det = p[kAxx] * p[kAyy] - p[kAxy] * p[kAxy], blur = p[kBlur];
        const double xx = p[kAyy] / det, xy = -p[kAxy] / det, yy = p[kAxx] / det;
        x_ = float(p[kX]);
        y_ = float(p[kY]);
        gx_ = float(p[kGx]);
        gy_ = float(p[kGy]);
        inverse_xx_ = float(xx);
        inverse_xy_ = float(xy);
        inverse_yy_ = float(yy);
        ratio_ = float(p[kRatio]);
        card_ = float(p[kCard]);
        bright_ = float(p[kBright]);
        fall_ = float(p[kDark] - p[kBright]);
        drop_ = float(p[kGround] - p[kBright]);
        zgx_ = float(xx * p[kGx] + xy * p[kGy]);
        zgy_ = float(xy * p[kGx] + yy * p[kGy]);
        turn_ = float((yy * yy - xx * xx) / std::numbers::sqrt2);
        shear_ = float(xy * (xx + yy) / std::numbers::sqrt2);
        per_blur_ = float(1 / blur);
        peak_ = float(-std::numbers::inv_sqrtpi / (std::numbers::sqrt2 * blur));
        half_bend_ = float(blur / (2 * det * det));
        half_flat_ = float(1.5 * blur);
        if constexpr (kAlone) {
            outside_ = float(p[kSidesOf[edge].outside]);
            jump_ = float(p[kSidesOf[edge].inside] - p[kSidesOf[edge].outside]);
        }
    }

    /// `x` and `y` are `count` lanes of pixels in the frame of the parameters, `seen` their grey levels.
    ROUNDEL_INLINE void evaluate(const float* x, const float* y, const float* seen, int count,
                                 Gradient& to) const {
        Geometry at;
        for (int k = 0; k < count; ++k) locate(load(x + k * kLanes), load(y + k * kLanes), k, at);
        for (int k = 0; k < count; ++k) complete(k, at);
        if constexpr (kAlone) {
            Profile profile;
            blur_edge(at, 1, count, profile);
            for (int k = 0; k < count; ++k)
                to.residual[k] = compare(load(seen + k * kLanes), differentiate(at, profile, k, to));
        } else {
            Profile outer, inner, card;
            blur_edge(at, 1, count, outer);
            blur_edge(at, ratio_, count, inner);
            blur_edge(at, card_, count, card);
            for (int k = 0; k < count; ++k)
                to.residual[k] =
                    compare(load(seen + k * kLanes), differentiate(at, outer, inner, card, k, to));
        }
    }

  private:
    static constexpr bool kAlone = edge != kAnyEdge;

    /// The geometry of pixels: q = A^-1 (x - c), f = |X|, n the direction of grad f, distance over f, the
    /// shift of an edge of radius 1 by blur, and the derivative of the distance by g . q.
    struct Geometry {
        Lanes qx[kChunk], qy[kChunk], f[kChunk], nx[kChunk], ny[kChunk], stretch[kChunk], bow[kChunk],
            bend[kChunk], flat[kChunk], tip[kChunk];
    };

    /// Stores grad f times the depth in n, the depth in `stretch`, 1 / |q| in `bow`, and in `tip` the
    /// curvature of the contours of f up to powers of the gradient.
    ROUNDEL_INLINE void locate(const Lanes& x, const Lanes& y, int k, Geometry& at) const {
        const Lanes dx = x - x_, dy = y - y_;
        const Lanes qx = inverse_xx_ * dx + inverse_xy_ * dy, qy = inverse_xy_ * dx + inverse_yy_ * dy;
        const Lanes xx = qx * qx, yy = qy * qy, qq = xx + yy + 1e-12f, per_q = inverse_sqrt(qq);
        const Lanes depth = kAlone ? all(1) : 1.0f - gx_ * qx - gy_ * qy;
        const Lanes f = kAlone ? qq * per_q : qq * per_q / depth;
        Lanes mx = qx * per_q, my = qy * per_q;  // grad f = A^-1 m / depth
        if constexpr (!kAlone) {
            mx += f * gx_;
            my += f * gy_;
        }
        // The derivative by a shape is taken at the nearest point of the edge, |q| = 1.
        at.qx[k] = kAlone ? mx : qx, at.qy[k] = kAlone ? my : qy;
        at.f[k] = f, at.stretch[k] = depth, at.bow[k] = per_q;
        at.nx[k] = inverse_xx_ * mx + inverse_xy_ * my, at.ny[k] = inverse_xy_ * mx + inverse_yy_ * my;
        at.tip[k] = (turn_ * qx * qy + shear_ * (xx - yy)) * (per_q * per_q);
    }

    /// Completes the geometry that `locate` began.
    ROUNDEL_INLINE void complete(int k, Geometry& at) const {
        const Lanes vx = at.nx[k], vy = at.ny[k], vv = vx * vx + vy * vy + 1e-12f, per_v = inverse_sqrt(vv);
        const Lanes f = at.f[k], depth = at.stretch[k], per_q = at.bow[k], per_vv = per_v * per_v;
        const Lanes near = kAlone ? per_v : per_v * f * per_q, across = at.tip[k] * per_v;
        Lanes bow = across * across * per_q;
        if constexpr (!kAlone) bow += vx * zgx_ + vy * zgy_;
        at.nx[k] = vx * per_v, at.ny[k] = vy * per_v;
        at.stretch[k] = kAlone ? per_v : per_v * depth, at.tip[k] = f * per_v;
        at.bend[k] = half_bend_ * near * near * near, at.flat[k] = half_flat_ * vv * per_v;
        at.bow[k] = per_vv * bow;
    }

    /// The share of the inside in a pixel's level, and its derivatives by the distance and by the blur.
    struct Profile {
        Lanes inside[kChunk], slope[kChunk], by_blur[kChunk];
    };

    /// Distances and shifts are in units of the blur.
    ROUNDEL_INLINE void blur_edge(const Geometry& at, float r, int count, Profile& to) const {
        const float per_r = 1 / r;
        for (int k = 0; k < count; ++k) {
            const Lanes over = at.f[k] - r, bow = over * at.bow[k];
            const Lanes distance =
                over * (at.stretch[k] * per_blur_) * (1.0f + (bow > -0.5f ? bow : all(-0.5f)));
            const Lanes bend = at.bend[k] * per_r, bb = bend * bend < 0.5f ? bend * bend : all(0.5f);
            const Lanes narrow = 1.0f - bb * (1.0f - bb);
            const Lanes shift = bend * (1.0f + bend * at.flat[k] * per_r);
            const Normal normal = normal_tail((distance + shift) * narrow);
            to.inside[k] = normal.tail, to.slope[k] = (peak_ * narrow) * normal.density;
            to.by_blur[k] = to.slope[k] * (shift - distance);
        }
    }

    /// Sets the gradient and returns the grey level.
    ROUNDEL_INLINE Lanes differentiate(const Geometry& at, const Profile& outer, const Profile& inner,
                                       const Profile& card, int k, Gradient& to) const {
        const Lanes by_inner = -fall_ * inner.slope[k], by_card = -drop_ * card.slope[k];
        const Lanes ring = fall_ * outer.slope[k] + by_inner;
        const Lanes by = ring + by_card;  // the level by the distance outwards
        const Lanes dark = outer.inside[k] - inner.inside[k], ground = 1.0f - card.inside[k];
        const Lanes tip = by * at.tip[k];
        to.by[kDark][k] = dark;
        to.by[kGround][k] = ground;
        to.by[kBright][k] = 1.0f - dark - ground;
        to.by[kBlur][k] = fall_ * (outer.by_blur[k] - inner.by_blur[k]) - drop_ * card.by_blur[k];
        to.by[kRatio][k] = -by_inner * at.stretch[k], to.by[kCard][k] = -by_card * at.stretch[k];
        differentiate_shape(at, by, k, to);
        to.by[kGx][k] = tip * at.qx[k], to.by[kGy][k] = tip * at.qy[k];
        to.ring[k] = ring;
        return bright_ + fall_ * dark + drop_ * ground;
    }

    /// The same for a single edge.
    ROUNDEL_INLINE Lanes differentiate(const Geometry& at, const Profile& profile, int k,
                                       Gradient& to) const {
        const Lanes by = jump_ * profile.slope[k], inside = profile.inside[k];
        to.by[kSidesOf[edge].inside][k] = inside;
        to.by[kSidesOf[edge].outside][k] = 1.0f - inside;
        to.by[kBlur][k] = jump_ * profile.by_blur[k];
        differentiate_shape(at, by, k, to);
        to.ring[k] = edge == kCardEdge ? all(0) : by;
        return outside_ + jump_ * inside;
    }

    ROUNDEL_INLINE static void differentiate_shape(const Geometry& at, const Lanes& by, int k, Gradient& to) {
        const Lanes by_x = -by * at.nx[k], by_y = -by * at.ny[k], qx = at.qx[k], qy = at.qy[k];
        to.by[kX][k] = by_x;
        to.by[kY][k] = by_y;
        to.by[kAxx][k] = by_x * qx;
        to.by[kAxy][k] = by_x * qy + by_y * qx;
        to.by[kAyy][k] = by_y * qy;
    }

    ROUNDEL_INLINE static Lanes compare(const Lanes& seen, const Lanes& level) {
        return is_uninformative(seen, level) ? all(kAbsent) : shown(seen) - level;
    }

    float x_, y_, gx_, gy_, inverse_xx_, inverse_xy_, inverse_yy_, ratio_, card_;
    float bright_, fall_, drop_, per_blur_, peak_, half_bend_, half_flat_, zgx_, zgy_, turn_, shear_;
    float outside_ = 0;  // for a single edge
    float jump_ = 0;     // for a single edge
};

using Model = ModelOf<kAnyEdge>;

}  // namespace roundel
