// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <array>
#include <bit>
#include <cstdint>
#include <vector>

#include "fit/edge_pixels.hpp"
#include "fit/fields.hpp"
#include "numeric/image.hpp"

namespace roundel {

/// A set of the 32 sectors of a disc, one bit each, numbered by the direction in the disc's own plane.
using Sectors = uint32_t;
constexpr int kSectors = 32;

/// Standard deviations of what noise does not do: by chance once in 16,000. Squared vectors of two components
/// in the plane are as unlikely beyond -2 log of that.
constexpr double kUnlikely = 4, kUnlikelySquare = 19.3;
/// Standard deviations of a difference that is no chance where it decides between two sources: once in 370.
constexpr double kContradiction = 3;

inline int count_sectors(Sectors sectors) { return std::popcount(sectors); }
/// One of the runs of adjacent sectors in a set that is not empty; the last sector and the first are
/// adjacent.
Sectors any_run(Sectors sectors);

/// The pixel in the middle of a sector at `r` outer radii of the model `p` in the image's frame.
struct Pixel {
    float x, y;
};
Pixel point_in_sector(const Parameters& p, int sector, double r);

/// The sectors in which a roundel's outer edge (with all outside of it) and its inner edge are occluded.
struct OcclusionMask {
    Sectors outer = 0, inner = 0;
    bool operator==(const OcclusionMask&) const = default;
    bool any() const { return outer || inner; }
};

/// Removes the pixels of occluded sectors.
void remove_occluded(const OcclusionMask& occlusion, const Parameters& p, EdgePixels& pixels);

/// The displacement of an edge from the model: the RMS around the edge of means over a sixth of the turn, and
/// its expected value if there is noise only; pixels.
struct Displacement {
    double rms, chance;
};

/// Residuals on an edge of the ring by sector: the sums of their squares weighted by the slope, and of their
/// regression on the slope, which gives the displacement of the edge.
class SectorSums {
  public:
    void add(int sector, double slope, double residual);
    /// The sectors whose mean square exceeds that of `noise` and `slack` by more than four standard
    /// deviations.
    Sectors exceeding(double noise, double slack) const;
    Displacement displacement(double noise) const;
    /// The sum of products of slope and residual in a sector, and its variance if residuals are independent
    /// with a variance of 1: the score of a displacement of that part of the edge.
    struct Score {
        double sum, variance;
    };
    Score score(size_t sector) const { return {regression_[sector], squared_[sector]}; }
    /// Appends the weighted mean square of each sector that has pixels.
    void append_mean_squares(std::vector<double>& to) const;

  private:
    std::array<double, kSectors> rr_{}, weight_{}, squared_{}, regression_{};
};

/// The displacement of a place of an edge by each parameter of the pose, and by the ratio.
constexpr int kEdgeParameters = kPoseCount + 1;
using EdgeSlopes = Vector<kEdgeParameters>;

/// The residuals of the model `p` and its fields (both in the image's frame) on both edges of the ring.
class EdgeMisfit {
  public:
    EdgeMisfit(const ImageView& image, const Parameters& p, const Fields& fields);
    /// The sectors in which the residuals of an edge exceed `noise` and `slack`, both in grey levels RMS, and
    /// adjacent ones that the blurred edge of the occluding object can reach.
    OcclusionMask occlusion(double noise, double slack) const;
    /// The median residual of the sectors of both edges, grey levels RMS: an occlusion of less than half of
    /// them hardly changes it.
    double median() const;
    /// Displacements of the outer and of the inner edge. Ragged edges (drawn, printed, sharpened) scatter
    /// about the right position, so their means hardly differ from it.
    std::array<Displacement, 2> displacements(double noise) const;
    /// The factor by which residuals that are correlated along the edges enlarge the covariance of the pose:
    /// about 1 (with 14 degrees of freedom) if they are independent with the standard deviation `noise`, grey
    /// levels. Sectors in the mask do not count. It is the ratio of the traces of the cluster-robust
    /// covariance, with eighths of the turn as clusters, and of its expectation for independent residuals,
    /// which includes what the parameters absorb (Liang and Zeger, 1986; Bell and McCaffrey, 2002).
    double correlation(double noise, const OcclusionMask& mask) const;

  private:
    /// The displacement of each edge, at the middle of each sector, by each parameter of the pose and by the
    /// ratio, pixels.
    std::array<std::array<EdgeSlopes, kSectors>, 2> edge_slopes() const;

    Parameters p_;
    CircleImage circles_[2];
    std::array<SectorSums, 2> edges_;
};

}  // namespace roundel
