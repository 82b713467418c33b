// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "fit/edge_pixels.hpp"
#include "fit/roundel_model.hpp"

namespace roundel {

/// What changes the picture of a roundel beside its model, as coefficients of functions of the place in the
/// disc's plane (detector_model.md, section 3b). In coordinates X, Y in outer radii, with X along the
/// minor axis of the image, the functions of light are X, Y, X^2 - Y^2, 2 X Y, X^2 + Y^2 and the four of
/// third order, X^3 - 3 X Y^2, 3 X^2 Y - Y^3, X (X^2 + Y^2) and Y (X^2 + Y^2).
///
/// Light on the print multiplies the levels, gloss is added to them. Paper that is bent out of its plane
/// moves along the minor axis; X^2 - Y^2 and 2 X Y are the parts of a curvature that its picture shows.
enum Field { kLight = 0, kGloss = 9, kBend = 18 };
constexpr int kLightFields = kGloss - kLight, kFields = kBend + 2;
constexpr int kCubic = 5;  // the first function of light of third order

/// The functions of light at (X, Y): numbers or lanes of them.
template <typename T>
ROUNDEL_INLINE void functions_of_light(const T& X, const T& Y, T (&f)[kLightFields]) {
    const T xx = X * X, yy = Y * Y, rr = xx + yy;
    f[0] = X, f[1] = Y, f[2] = xx - yy, f[3] = X * Y + X * Y, f[4] = rr;
    f[5] = X * (rr - 4 * yy), f[6] = Y * (4 * xx - rr), f[7] = X * rr, f[8] = Y * rr;
}

/// The coordinates X and Y of pixels, for the pose in `p`.
struct FieldFrame {
    double x = 0;      // of the disc's centre
    double y = 0;      // of the disc's centre
    double minor = 1;  // half axis
    double major = 1;  // half axis
    double cos = 1;    // of the direction of the minor axis
    double sin = 0;    // of the direction of the minor axis
    double reach = 1;  // of the card, up to which only its own light shows, outer radii

    FieldFrame() = default;
    explicit FieldFrame(const Parameters& p);
    /// Tangent of the tilt under weak perspective: by how much height moves a point in units of the minor
    /// axis.
    double tilt() const;
};

/// The same, for lanes of pixels.
class FieldPlane {
  public:
    explicit FieldPlane(const FieldFrame& frame)
        : x_(float(frame.x)),
          y_(float(frame.y)),
          xx_(float(frame.cos / frame.minor)),
          xy_(float(frame.sin / frame.minor)),
          yx_(float(-frame.sin / frame.major)),
          yy_(float(frame.cos / frame.major)),
          per_minor_(float(1 / square(frame.minor))),
          per_major_(float(1 / square(frame.major))),
          reach_(float(square(frame.reach))) {}
    /// Replaces pixels by coordinates in the plane.
    ROUNDEL_INLINE void map(Lanes& x, Lanes& y) const {
        const Lanes dx = x - x_, dy = y - y_;
        x = xx_ * dx + xy_ * dy;
        y = yx_ * dx + yy_ * dy;
    }
    /// Pixels by which an ellipse moves outwards at (X, Y), over |(X, Y)|, if it grows by one minor axis.
    ROUNDEL_INLINE Lanes stretch(const Lanes& X, const Lanes& Y) const {
        return inverse_sqrt(per_minor_ * X * X + per_major_ * Y * Y + 1e-12f);
    }
    /// Whether the light of the ground beyond the card does not show; -1 where it is true.
    ROUNDEL_INLINE Bits is_card(const Lanes& squared) const { return squared < reach_; }

  private:
    float x_, y_, xx_, xy_, yx_, yy_, per_minor_, per_major_, reach_;
};

/// The fields of a roundel. `frame` is in the image's frame.
struct Fields {
    FieldFrame frame{};
    Vector<kFields> of{};

    bool any() const;
    bool has_light() const;
    /// The bend, as the displacement that it makes at the outer edge: its share with three periods, minor
    /// half axes. The mean curvature, which the picture does not show, makes twice as much.
    double bend() const;
    /// The level that a pixel would have in even light.
    double even_level(double x, double y, double level) const;
    /// Removes the fields from pixels: what remains is the picture of flat paper in even light.
    void remove_from(EdgePixels& pixels) const;
};

}  // namespace roundel
