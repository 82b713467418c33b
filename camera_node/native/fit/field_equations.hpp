// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <array>

#include "fit/fields.hpp"
#include "fit/normal_equations.hpp"

namespace roundel {

/// Products of N further columns of a linear model with those of the parameters, with each other (lower
/// triangle) and with the residuals.
template <int N>
struct FurtherProducts {
    std::array<Parameters, N> parameters{};
    std::array<Vector<N>, N> own{};
    Vector<N> residuals{};
};

/// Those of linear shading: level x and level y, with x and y in the pixels' frame. `pixels` are those that
/// the equations were linearized at, `weighting` is that of their solution; so in all functions here.
FurtherProducts<2> shading_products(const NormalEquations& equations, const EdgePixels& pixels,
                                    const Weighting& weighting);

/// Those of all fields; `frame` is in the pixels' frame.
FurtherProducts<kFields> field_products(const NormalEquations& equations, const EdgePixels& pixels,
                                        const FieldFrame& frame, const Weighting& weighting);

/// Score tests of fields that a fit did not contain: squared sums of products of residuals and columns over
/// their variance, for residuals of variance 1. Each is chi-square with two degrees of freedom.
///
/// `bend` is that of displacements of the ring's edges with three periods around it, which no ellipse has;
/// `light` that of gloss X^2 - Y^2 and 2 X Y.
/// `bend_information` is that on either component of the displacements, per square minor half axis.
struct FieldScores {
    double bend, light, bend_information;
};

/// The scores of the residuals after a further `step` of the parameters. Pixels of the ground count fully:
/// uneven light shows in them too.
FieldScores score_fields(const NormalEquations& equations, const EdgePixels& pixels, const FieldFrame& frame,
                         const Parameters& step, const Weighting& weighting);

}  // namespace roundel
