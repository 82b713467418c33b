// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <cmath>
#include <memory>
#include <vector>

#include "fit/roundel_limits.hpp"
#include "search/binarize.hpp"

namespace roundel {

/// A point that may be the centre of a roundel.
struct Seed {
    float x;      // of the centre, pixels
    float y;      // of the centre, pixels
    float reach;  // largest distance of the hole's edge, pixels
    int dark;     // the paper's m_d, from a few pixels
    int bright;   // the paper's m_b, from a few pixels
};

/// Two parallel dark bars with a bright one between them: the image of a roundel that moves along them by the
/// width of its hole or more during the exposure.
struct Streak {
    float x;        // of the centre, pixels
    float y;        // of the centre, pixels
    float along_x;  // direction of the bars, a unit vector
    float along_y;  // direction of the bars, a unit vector
    float width;    // from one bar's outer side to the other's, pixels
};

/// Limits on a chord of a roundel: its least and greatest length in pixels, the greatest and least ratio of a
/// dark run to the bright one, (1 - r) / 2r, in sixteenths, and the tolerance of a run in sixteenths of a
/// pixel.
struct Proportions {
    int least, most, thick, thin, slack;
};

/// Searches all rows and columns of an image for roundels, and diagonals for motion-blurred and occluded
/// ones.
///
/// A line through a roundel's centre has a dark, a bright and a dark run with the proportions
/// (1 - r) : 2r : (1 - r) at any slant; r is the ratio of the diameters. Affine maps preserve ratios along a
/// line (1 : 3 : 1 for the paper's 0.6), and lines that pass the centre within half the inner radius differ
/// little. Agreeing chords of adjacent lines form a stack. The perpendicular line through its middle is
/// tested next. One dark run is sufficient there, so a partly occluded roundel is found from the other
/// direction.
///
/// A moving roundel has such chords only across its motion, within 45 degrees of the lines.
class ChordSearch {
  public:
    /// Searches for the prints in use, or for `any` print.
    ChordSearch(const RoundelLimits& limits, bool any) { set_limits(limits, any); }
    void set_limits(const RoundelLimits& limits, bool any);
    void run(const ImageView& image, const ThresholdMap& threshold);
    /// The seeds of the last image; a roundel may have several.
    const std::vector<Seed>& seeds() const { return seeds_; }
    /// The streaks of the last image, sharp roundels among them.
    const std::vector<Streak>& streaks() const { return streaks_; }

  private:
    /// A bright run between two dark ones, and the runs on the lines before that it continues.
    struct Stack {
        int middle;      // of the last line's bright run
        int inner;       // length of the last line's bright run, pixels
        int first;       // line, of two pixels
        int last;        // line, of two pixels
        int begin;       // middle on the first line
        int outer;       // longest chord, with its dark runs
        bool continued;  // by another stack
    };
    /// The position in the image of pixel k of line d: origin + k step + d line, as x and y.
    struct Raster {
        float x, y, step_x, step_y, line_x, line_y;
        float step_length() const { return std::sqrt(step_x * step_x + step_y * step_y); }
    };
    void scan(const BitImage& along, const BitImage* across, const Raster& raster, const Proportions& limits);
    void scan_diagonals();
    void scan_lines(const BitImage& along, int first, int last);
    void add_chord(int middle, int inner, int outer, int line);
    void test_across(const Stack& stack);
    void test_across_diagonal(const Stack& stack);
    bool is_unoccluded(int x, int y, int dx, int dy) const;
    bool is_inside(int x, int y) const;
    int run_length(int x, int y, int dx, int dy) const;
    void add_streak(const Stack& stack);
    bool is_diametral(int dark, int inner) const;

    Proportions fine_{};    // for rows and columns
    Proportions coarse_{};  // for diagonals
    Proportions limits_{};  // for the current scan
    Raster raster_{};
    int min_contrast_ = 0;  // grey levels
    BitImage rows_, columns_, sparse_, diagonals_;
    std::unique_ptr<int[]> edges_;    // begin, end, begin, end, ... of the dark runs of some lines
    std::unique_ptr<int[]> numbers_;  // of the bright runs with diametral proportions
    size_t room_ = 0;                 // of either buffer
    std::vector<Stack> stacks_;       // the first one is a placeholder for no stack
    std::vector<int> nearest_;        // for each position, the last stack within kDrift of it
    std::vector<Seed> seeds_;
    std::vector<Streak> streaks_;
    const ImageView* image_ = nullptr;
    const BitImage* across_ = nullptr;
    bool along_rows_ = true;
};

}  // namespace roundel
