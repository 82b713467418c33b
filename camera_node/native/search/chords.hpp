// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <cmath>
#include <memory>
#include <vector>

#include "search/binarize.hpp"
#include "settings.hpp"
#include "blur/streaks.hpp"

namespace roundel {

/// A place where a roundel's middle may be.
struct Seed {
    float x, y;
    float reach;       // how far from here the hole's edge may be, pixels
    int dark, bright;  // m_d and m_b of the paper, from a few pixels
};

/// What a chord of a roundel may be: the least and the most of its length, pixels, and of one dark run over
/// the bright one, (1 - r) / 2r, in sixteenths, as is by what a run may be off.
struct Proportions {
    int least, most, thick, thin, slack;
};

/// Looks for roundels along all rows and columns of a picture, and for smeared and covered ones also along
/// diagonals.
///
/// A line through a roundel's centre is dark, bright and dark in the proportions (1 - r) : 2r : (1 - r) at
/// any slant, r being the ratio of the diameters: an affine picture keeps ratios along a line (1 : 3 : 1 for
/// the paper's 0.6), and lines that pass the centre within half the inner radius differ little. Chords of
/// neighbouring lines that agree make a stack; its middle is where the line across is tried. There one of
/// the dark runs is enough, so a roundel that something covers in part is found by the other direction.
///
/// One that moves is seen across its motion only, wherever that is within half a right angle of the lines.
class ChordSearch {
  public:
    explicit ChordSearch(const Settings& settings);
    void run(const ImageView& image, const ThresholdMap& threshold);
    /// The seeds of the last image; a roundel may have several.
    const std::vector<Seed>& seeds() const { return seeds_; }
    /// The streaks of that image; sharp roundels are among them.
    const std::vector<Streak>& streaks() const { return streaks_; }

  private:
    /// A bright run between two dark ones, and those on neighbouring lines before it that it continues.
    struct Stack {
        int middle, inner;  // of the last line: middle of the bright run, and its length, pixels
        int first, last;    // lines, of two pixels each
        int begin;          // middle on the first line
        int outer;          // longest chord, with its dark runs
        bool goes_on;       // in another one
    };
    /// Where pixel k of line d is in the image: at origin + k step + d line, as x and y.
    struct Raster {
        float x, y, step_x, step_y, line_x, line_y;
        float step_length() const { return std::sqrt(step_x * step_x + step_y * step_y); }
    };
    void scan(const BitImage& along, const BitImage* across, const Raster& raster, const Proportions& limits);
    void scan_diagonals();
    void scan_lines(const BitImage& along, int first, int last);
    void add_chord(int middle, int inner, int outer, int line);
    void try_across(const Stack& stack);
    void try_across_diagonal(const Stack& stack);
    bool is_free_along(int x, int y, int dx, int dy) const;
    bool is_inside(int x, int y) const;
    int run_length(int x, int y, int dx, int dy) const;
    void add_streak(const Stack& stack);
    bool is_diametral(int dark, int inner) const;

    Proportions fine_{}, coarse_{}, limits_{};  // of rows and columns; of diagonals; of what is scanned
    Raster raster_{};
    int min_contrast_;  // grey levels
    BitImage rows_, columns_, thin_, diagonals_;
    std::unique_ptr<int[]> edges_;    // begin, end, begin, end, ... of the dark runs of some lines
    std::unique_ptr<int[]> numbers_;  // of the bright runs between two dark ones that are diametral
    size_t room_ = 0;                 // for either
    std::vector<Stack> stacks_;       // the first of them is none
    std::vector<int> nearest_;        // the last stack whose middle may drift to a place
    std::vector<Seed> seeds_;
    std::vector<Streak> streaks_;
    const ImageView* image_ = nullptr;
    const BitImage* across_ = nullptr;
    bool along_rows_ = true;
};

}  // namespace roundel
