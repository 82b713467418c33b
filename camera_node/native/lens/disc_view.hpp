// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <array>
#include <optional>
#include <utility>

#include "lens/lens.hpp"
#include "numeric/cholesky.hpp"
#include "numeric/ellipse.hpp"

namespace roundel {

using Point3 = std::array<double, 3>;

/// A disc of radius 1 in front of a camera of focal length 1.
class DiscView {
  public:
    static constexpr int kUnknowns =
        5;  // position relative to the distance, and two directions of the normal
    static constexpr int kNumbers =
        7;  // of its picture: centre and S of the ellipse, image of the disc's centre

    DiscView(const Point3& position, const Point3& normal) : c_(position), n_(normal) {}

    /// The two poses that explain an ellipse (the first five numbers), under weak perspective.
    static std::pair<DiscView, DiscView> both_of(const Vector<kNumbers>& picture);

    /// The picture, and its derivatives by each of the unknowns.
    std::pair<Vector<kNumbers>, std::array<Vector<kNumbers>, kUnknowns>> predict() const;
    void move(const Vector<kUnknowns>& step);
    /// Whether it is in front of the camera and faces it.
    bool is_visible() const;

  private:
    std::array<Point3, 2> tangents() const;

    Point3 c_, n_;
};

/// An ellipse: its centre, and its points centre + S^(1/2) u, |u| = 1.
struct ShapedEllipse {
    double x, y;
    Symmetric shape;
};

/// The ellipse in the normalised image plane through the points of one in pixels, centre + A u; `xy` is the
/// image of its centre and J the derivative there. The image of an ellipse through a lens with distortion is
/// none: the algebraic fit to eight points is used.
std::optional<ShapedEllipse> ellipse_through(const Lens& lens, Point centre, const Symmetric& A, Point xy,
                                             const LinearMap& J);

}  // namespace roundel
