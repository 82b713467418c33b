# SPDX-License-Identifier: BSD-3-Clause
"""Gates, noise levels and initial covariances shared by the trackers."""

MAX_CHI2 = (
    8.0  # mean squared Mahalanobis residual of a robot or marker, including SLACK_PX of calibration error
)
POSITION_GATE = 16.3  # chi-square with 3 degrees of freedom; rejects one true position in 1000
MOTION_GATE = 22.5  # chi-square with 6 degrees of freedom; rejects one true motion in 1000 (7 m/s, 19 rad/s)
DECISIVE_CHI2 = 9.0  # by which an alternative must be worse
POSE_DEGREES = 6  # of freedom
AXIS_SIGMA_PX = 0.25  # of a measured axis: blur and threshold change it by more than noise
DIAMETER_TOLERANCE = 0.2  # relative, between the diameter that a view implies and that of a marker
# Of prints of any size, m, where no robot tells the sizes in use: 4 to 60 cm, in steps that the tolerance covers.
ANY_DIAMETERS = tuple(0.05 * 1.5**k for k in range(7))
MAX_SPEED_M_S = 2.0  # of the fastest marker that is searched for
FORGET_NS = 300_000_000  # unlabeled markers are forgotten after this time without a detection

# Standard deviations of a robot that was just acquired: rad, m, rad/s, m/s.
START_SIGMAS = (0.2, 0.05, 4.0, 1.5)
START_SIGMAS_SINGLE = (0.3, 0.05, 10.0, 1.5)  # of a single marker
START_S = 1e-3  # shortest prediction interval; the motion model needs a positive one
