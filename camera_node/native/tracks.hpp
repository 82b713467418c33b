// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <vector>

#include "code/code_reader.hpp"
#include "fit/photometric_fit.hpp"
#include "numeric/image.hpp"
#include "search/chords.hpp"

namespace roundel {

/// A roundel of a frame, the number of its track, and what the frames of the track show of its code.
struct TrackedFit {
    RoundelFit fit;
    int track;
    CodeReading code{};
};

/// A roundel of the last frame, predicted by its last velocity.
struct ExpectedRoundel {
    Seed seed;  // at the predicted position
    int track;
    RoundelFit fit;  // of the last frame
    double vx;       // pixels per frame
    double vy;       // pixels per frame
    bool steady;     // was at its predicted position and unoccluded
    /// The last frame's model, moved to the predicted position.
    InitialGuess guess() const;
};

/// Tracks of roundels in the image, with constant velocity.
class Tracks {
  public:
    /// The roundels of the last frame. Lost ones are not predicted.
    std::vector<ExpectedRoundel> expect() const;
    /// The last ellipses of lost tracks that are not deleted yet.
    std::vector<Ellipse> lost() const;
    /// Takes the roundels of a frame. A roundel without a number (below 0) continues the nearest track that
    /// is predicted within a diameter, or starts a new one. A lost track is deleted after 30 frames.
    void update(std::vector<TrackedFit>& found);
    /// Reads the codes of the roundels of the last update in its image, with their final covariances.
    void read_codes(std::vector<TrackedFit>& found, const ImageView& image);
    /// Lets the next fits start from rays, since the models of the last frame hold no longer.
    void forget_models();

  private:
    struct Track {
        int number;
        size_t row;  // among the roundels of the last frame, unless it was missed
        RoundelFit fit;
        double vx;   // pixels per frame
        double vy;   // pixels per frame
        int missed;  // frames
        bool steady;
        CodeTrack code{};
    };
    static double distance(const Track& track, const RoundelFit& fit);
    const Track* nearest(const RoundelFit& fit, const std::vector<bool>& taken) const;

    std::vector<Track> tracks_;
    int next_ = 0;
};

}  // namespace roundel
