// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <array>
#include <optional>
#include <utility>

#include "lens/lens.hpp"
#include "numeric/cholesky.hpp"
#include "numeric/ellipse.hpp"
#include "numeric/vector3.hpp"

namespace roundel {

/// A disc of radius 1 in front of a camera of focal length 1.
class DiscView {
  public:
    // Position relative to the distance, and the normal along two directions across it.
    static constexpr int kUnknowns = 5;
    // Of its picture: centre and S of the ellipse, image of the disc's centre.
    static constexpr int kNumbers = 7;

    DiscView(const Vector3& position, const Vector3& normal) : c_(position), n_(normal) {}

    /// The two poses that explain an ellipse (the first five numbers), under weak perspective.
    static std::pair<DiscView, DiscView> both_of(const Vector<kNumbers>& picture);

    /// The picture, and its derivatives by each of the unknowns.
    std::pair<Vector<kNumbers>, std::array<Vector<kNumbers>, kUnknowns>> predict() const;
    void move(const Vector<kUnknowns>& step);
    /// Whether it is in front of the camera and faces it.
    bool is_visible() const;

    /// Two unit vectors perpendicular to the normal and to each other.
    std::array<Vector3, 2> tangents() const;

  private:
    Vector3 c_, n_;
};

/// The ellipse in the normalised image plane through the points of one in pixels, centre + A u; `xy` is the
/// image of its centre and J the derivative there. The image of an ellipse through a lens with distortion is
/// none: the algebraic fit to eight points is used.
std::optional<EllipseShape> ellipse_through(const Lens& lens, Point centre, const Symmetric& A, Point xy,
                                            const LinearMap& J);

}  // namespace roundel
