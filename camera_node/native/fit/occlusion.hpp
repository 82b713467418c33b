// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <array>
#include <bit>
#include <cstdint>

#include "fit/edge_pixels.hpp"
#include "numeric/image.hpp"

namespace roundel {

/// A set of the 32 sectors of a disc, one a bit, counted by the direction in the disc's own plane.
using Sectors = uint32_t;
constexpr int kSectors = 32;

inline int count_sectors(Sectors sectors) { return std::popcount(sectors); }
/// One of the runs of neighbouring sectors in a set that is not empty; the last sector is the first one's
/// neighbour.
Sectors any_run(Sectors sectors);

/// Pixel that lies in the middle of a sector at `r` outer radii, by the model `p` in the image's frame.
struct Pixel {
    float x, y;
};
Pixel point_in_sector(const Parameters& p, int sector, double r);

/// Where a roundel's edges are covered: the outer one (with all that lies outside) and the inner one.
struct Hidden {
    Sectors outer = 0, inner = 0;
    bool operator==(const Hidden&) const = default;
    bool any() const { return outer || inner; }
};

/// Takes what is hidden out of the pixels.
void leave_out(const Hidden& hidden, const Parameters& p, EdgePixels& pixels);

/// How far an edge lies off the model, RMS around it of means over a sixth of the turn, and how much of that
/// the noise alone makes; pixels.
struct Displacement {
    double rms, chance;
};

/// Residuals on an edge of the ring by sector: squared ones, each with its slope as the weight, and their
/// regression on the slope, which is how far the edge is off.
class SectorSums {
  public:
    void add(int sector, double slope, double residual);
    /// The sectors whose mean is more than `noise` and `slack` explain, but for a chance of four sigmas.
    Sectors beyond(double noise, double slack) const;
    Displacement displacement(double noise) const;

  private:
    std::array<double, kSectors> rr_{}, weight_{}, squared_{}, moved_{};
};

/// What the picture differs from the model `p` by (in the image's frame), on either edge of the ring.
class EdgeMisfit {
  public:
    EdgeMisfit(const ImageView& image, const Parameters& p);
    /// The sectors in which an edge is off by more than the noise explains and `slack`, both in grey levels
    /// RMS; and those so near to them that what covers them may reach there too.
    Hidden hidden(double noise, double slack) const;
    /// Of the outer edge and of the inner one. What is drawn, printed or sharpened is ragged about the right
    /// place, and its means hardly show it.
    std::array<Displacement, 2> displacements(double noise) const;

  private:
    CircleImage circles_[2];
    std::array<SectorSums, 2> edges_;
};

}  // namespace roundel
