// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "reweighting.hpp"

namespace roundel::fusion {

/// The observations of a frame set: centres of discs, with their equations about the predicted bodies, and of
/// those that are `shaped` and `turned` also the outlines and the headings.
struct FitObservations {
    CentreObservations centres;
    const Equations* predicted;
    OutlineObservations outlines;
    const bool *shaped, *turned;
};

/// Fits bodies to observations, by repeated linearization about their estimates; see fusion_filter.md. The
/// systems are solved elsewhere: `linearize` states those of the bodies that still move, `step` takes their
/// solutions.
class BodyFit {
  public:
    /// `information` is that of the B predicted bodies; the arrays must outlive this.
    BodyFit(const std::vector<Body>& predicted, const std::vector<Exposure>& exposures,
            const FitObservations& observed, const ErrorMatrix* information);

    /// Linearizes and weighs the observations of the moving bodies about their estimates. `headings` are the
    /// equations of the headings.
    void linearize(const Equations* headings);
    /// Displaces the moving bodies by the solutions of their systems. Those displaced by `small` (rad, m) or
    /// more still move. Returns whether there are any.
    bool step(const ErrorVector* steps, double small);

    size_t n_turned() const { return turned_.size(); }
    const std::vector<int64_t>& moving() const { return moving_; }
    /// Information and right side of each moving body.
    const std::vector<ErrorMatrix>& information() const { return H_; }
    const std::vector<ErrorVector>& right() const { return g_; }

    const std::vector<Body>& estimates() const { return estimates_; }
    /// Equations of the centres, the outlines, then the headings, with their weights and whitened residuals.
    const std::vector<Equations>& equations() const { return equations_; }
    const std::vector<double>& weights() const { return weights_; }
    const std::vector<std::array<double, 2>>& residuals() const { return residuals_; }
    /// Writes the robust cost of each body: of its centres, whose squared residuals are given in standard
    /// deviations (NaN where not visible), and of its displacement from the prediction.
    void write_costs(const double* squared, double* costs) const;
    /// Writes the covariances of the bodies with observations, except where their systems are singular.
    void write_covariances(ErrorMatrix* P) const;

  private:
    Equations equations_at(const FramePoses& poses, size_t k, const Equations* headings) const;

    bool is_displaced_ = false;  // whether the estimates are no more the predictions
    std::vector<Body> predicted_, estimates_;
    std::vector<Exposure> exposures_;
    FitObservations observed_;
    const ErrorMatrix* prior_;
    std::vector<size_t> shaped_, turned_;  // rows of the outlines and of the headings
    std::vector<int64_t> owner_;           // of each equation
    ByBody of_;
    std::vector<ErrorVector> delta_;  // from the predictions
    std::vector<ErrorMatrix> sums_;   // the last information of each body
    std::vector<Equations> equations_;
    std::vector<double> weights_;
    std::vector<std::array<double, 2>> residuals_;
    std::vector<int64_t> moving_;
    // Of the moving bodies: their systems, and their equations by row.
    std::vector<ErrorMatrix> H_;
    std::vector<ErrorVector> g_;
    std::vector<Equations> rows_;
    std::vector<int64_t> body_;
    std::vector<size_t> row_;
};

}  // namespace roundel::fusion
