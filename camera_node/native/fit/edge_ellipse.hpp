// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <array>
#include <cmath>

#include "fit/roundel_model.hpp"

namespace roundel {

/// The image of one circle as an ellipse x = e + B u, |u| = 1, with B symmetric: a pose without perspective.
class EdgeEllipse {
  public:
    static constexpr int kShape = kAyy - kX + 1;
    /// The derivatives of one coordinate of e or B by each of the pose's parameters and, last, by the radius.
    using Row = Vector<kPoseCount + 1>;
    using Jacobian = std::array<Row, kShape>;

    EdgeEllipse(const Parameters& p, Edge edge)
        : p_(p), r_(radius_of(edge, p)), image_(circle_image(p, r_)), is_outer_(edge == kOuterEdge) {
        const Symmetric& S = image_.shape;
        root_ = std::sqrt(S.det());
        trace_ = std::sqrt(S.xx + S.yy + 2 * root_);
        B_ = {(S.xx + root_) / trace_, S.xy / trace_, (S.yy + root_) / trace_};  // B B = S
    }

    /// The parameters of a picture with this ellipse as the image of the unit circle.
    Parameters as_pose() const {
        Parameters p = p_;
        p[kX] = image_.x;
        p[kY] = image_.y;
        p[kAxx] = B_.xx;
        p[kAxy] = B_.xy;
        p[kAyy] = B_.yy;
        p[kGx] = p[kGy] = 0;
        return p;
    }

    /// The derivatives by the radius are 0 for the outer circle: its radius is 1 by definition.
    Jacobian jacobian() const {
        Jacobian J{};
        J[0][0] = J[kY - kX][kY - kX] = 1;
        const auto set = [&](int by, const Vector<kShape>& column) {
            for (int i = 0; i < kShape; ++i) J[i][by] = column[i];
        };
        set(kAxx - kX, differential({1, 0, 0}, 0, 0, 0));
        set(kAxy - kX, differential({0, 1, 0}, 0, 0, 0));
        set(kAyy - kX, differential({0, 0, 1}, 0, 0, 0));
        set(kGx - kX, differential({0, 0, 0}, 1, 0, 0));
        set(kGy - kX, differential({0, 0, 0}, 0, 1, 0));
        if (!is_outer_) set(kPoseCount, differential({0, 0, 0}, 0, 0, 1));
        return J;
    }

  private:
    /// The differential of `circle_image` (e = c - k h, S = k A A + k^2 h h^T, h = A g) and of B, which is
    /// (S + sqrt(det S) I) over its own trace.
    Vector<kShape> differential(const Symmetric& dA, double dgx, double dgy, double dr) const {
        const double axx = p_[kAxx], axy = p_[kAxy], ayy = p_[kAyy], gx = p_[kGx], gy = p_[kGy];
        const double k = 1 / (1 / (r_ * r_) - gx * gx - gy * gy);
        const double dk = 2 * k * k * (gx * dgx + gy * dgy + dr / (r_ * r_ * r_));
        const double hx = axx * gx + axy * gy, hy = axy * gx + ayy * gy;
        const double ux = dk * hx + k * (dA.xx * gx + dA.xy * gy + axx * dgx + axy * dgy);  // of k h
        const double uy = dk * hy + k * (dA.xy * gx + dA.yy * gy + axy * dgx + ayy * dgy);
        const double xx = dk * (axx * axx + axy * axy) + 2 * k * (axx * dA.xx + axy * dA.xy + hx * ux);
        const double yy = dk * (axy * axy + ayy * ayy) + 2 * k * (axy * dA.xy + ayy * dA.yy + hy * uy);
        const double xy =
            dk * axy * (axx + ayy) + k * (dA.xy * (axx + ayy) + axy * (dA.xx + dA.yy) + hx * uy + hy * ux);
        const Symmetric& S = image_.shape;
        const double root = (S.xx * yy + S.yy * xx - 2 * S.xy * xy) / (2 * root_);
        const double trace = (xx + yy + 2 * root) / (2 * trace_);
        return {-ux, -uy, (xx + root - B_.xx * trace) / trace_, (xy - B_.xy * trace) / trace_,
                (yy + root - B_.yy * trace) / trace_};
    }

    const Parameters p_;
    double r_, root_, trace_;
    CircleImage image_;
    Symmetric B_;
    bool is_outer_;
};

}  // namespace roundel
