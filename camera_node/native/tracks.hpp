// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <vector>

#include "search/chords.hpp"
#include "fit/photometric_fit.hpp"

namespace roundel {

/// A roundel of a frame; its number stays with it from frame to frame.
struct Roundel {
    Fit fit;
    int track;
};

/// Roundels of the frames before, each expected where its last motion takes it.
class Tracks {
  public:
    /// Where to look for those that the last frame showed, and their numbers. A lost one is not looked for.
    struct Expected {
        Seed seed;
        int track;
        Fit fit;        // of the last frame
        double vx, vy;  // pixels a frame
        bool steady;    // was where it was expected, and all of it was seen
        /// The last frame's model, moved to where it is expected.
        Start start() const;
    };
    std::vector<Expected> expect() const;
    /// Where those were seen last that keep their numbers and were not found.
    std::vector<Ellipse> lost() const;
    /// Takes the roundels of a frame. Those without a number (below 0) get that of a track that is expected
    /// within a diameter, the nearest first, or a new one. A lost track keeps its number for a while.
    void update(std::vector<Roundel>& found);

  private:
    struct Track {
        int number;
        Fit fit;
        double vx, vy;  // pixels a frame
        int missed;     // frames
        bool steady;
    };
    static double off(const Track& track, const Fit& fit);
    const Track* nearest(const Fit& fit, const std::vector<bool>& taken) const;

    std::vector<Track> tracks_;
    int next_ = 0;
};

}  // namespace roundel
