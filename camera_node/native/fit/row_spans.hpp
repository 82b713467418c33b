// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "fit/roundel_model.hpp"
#include "numeric/lanes.hpp"

namespace roundel {

constexpr int kNowhere = INT32_MIN / 2;

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

}  // namespace roundel
