import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]

CAUCHY: float
NOMINAL_WEIGHT: float
MIN_PARALLAX: float
SLACK_PX: float

class BodyStates:
    """The states of B bodies."""

    def __init__(self, R: Array, p: Array, omega: Array, v: Array, /) -> None:
        """R (B, 3, 3); p, omega and v (B, 3), world frame."""

class CameraExposures:
    """The camera poses of F frames."""

    def __init__(self, R_cam_world: Array, centres: Array, tau: Array, tau_sigma: Array, /) -> None:
        """R_cam_world (F, 3, 3), centres (F, 3); tau (F,) seconds after the time of the body states, its sigma (F,)."""

class DiscColumns:
    """N discs, each in one frame and on one body."""

    def __init__(
        self, frame: Index, body: Index, position: Array, normal: Array, radius: Array, delay: Array, /
    ) -> None:
        """Frame, body, radius and delay (N,), s after the frame; position and unit normal (3, N), body frame."""

class FramePoses:
    """The poses of all bodies at the capture times of all frames."""

    def __init__(self, bodies: BodyStates, exposures: CameraExposures, /) -> None: ...
    def views(self, discs: DiscColumns, /) -> Array:
        """(11, N): centre, normal and q, camera frame, and the outline's centre xy, NaN behind the camera."""

    def linearize_centres(
        self, discs: DiscColumns, xy: Array, whiten: Array, single: NDArray[np.bool_], /
    ) -> Array:
        """(N, 2, 13) whitened equations A delta = b of body errors, as A and then b; zeros where not visible.

        xy (2, N), whiten (2, 2, N), single (B,).
        """

    def differentiate_by_camera(self, discs: DiscColumns, whiten: Array, by_focal: Array, /) -> Array:
        """(N, 2, 8) whitened derivatives of the centres by errors of the cameras; zeros where not visible.

        Rotation and translation in the camera's frame (rad, m), clock offset (s), and logarithm of the focal length,
        by which the derivatives of the undistorted detections are `by_focal` (2, N). whiten (2, 2, N).
        """

    def linearize_outlines(
        self, discs: DiscColumns, axes: Array, angle: Array, scale: Array, sigma: Array, /
    ) -> Array:
        """(N, 2, 13) whitened equations of shears: axes (2, N), angle (N,), scale (2, 2, N), sigma (N,)."""

class BodyFit:
    """Fits B bodies to N centres by repeated linearization; see `native/body_fit.hpp`."""

    def __init__(
        self,
        bodies: BodyStates,
        exposures: CameraExposures,
        discs: DiscColumns,
        xy: Array,
        whiten: Array,
        single: NDArray[np.bool_],
        axes: Array,
        angle: Array,
        scale: Array,
        sigma: Array,
        shaped: NDArray[np.bool_],
        turned: NDArray[np.bool_],
        predicted: Array,
        information: Array,
        /,
    ) -> None:
        """As of `FramePoses`; (N,) whose outlines and whose headings count; equations of the centres about the bodies
        (N, 2, 13), and information (B, 12, 12) about these."""

    def linearize(self, headings: Array, /) -> tuple[Array, Array]:
        """The robustly weighted systems of the K moving bodies, all of them at first: (K, 12, 12) and (K, 12).

        headings (T, 2, 13): the equations of the `turned` rows.
        """

    def step(self, steps: Array, small: float, /) -> bool:
        """Displace the moving bodies by (K, 12). Whether some moved by `small` or more: only these still move."""

    def estimates(self) -> tuple[Array, Array]:
        """R (B, 3, 3), and p, omega and v (3, B, 3)."""

    def result(self, P: Array, cov: Array, /) -> tuple[Array, Array, Array, Array, Array, Array, Array]:
        """The `estimates`; P (B, 12, 12) with the covariances of the bodies that have observations, if these are not
        singular; of the centres, with covariances cov (2, 2, N), px^2, the last equations (N, 2, 13), their weights
        (N,) and squared residuals (N,), px^2, NaN where not visible; and the robust costs (B,) of the centres and of
        the displacements from the predictions."""

def whiten(cov: Array, scale: Array, /) -> Array:
    """(2, 2, N) L^-1 scale of N detections, where L L^T is the covariance; cov and scale (2, 2, N)."""

def squared_px(errors: Array, cov: Array, whiten: Array, /) -> Array:
    """(N,) squared lengths in pixels of whitened errors (N, 2): cov, whiten (2, 2, N); NaN where `whiten` is."""

class DetectionColumns:
    """N detections sorted by frame."""

    def __init__(
        self, frame: Index, xy: Array, scale: Array, cov: Array, major: Array, code: Array, delay: Array, /
    ) -> None:
        """Frame, major, code (-1 for none) and delay (N,), s after the frame; xy (2, N), scale and cov (2, 2, N)."""

class ExpectedMarkers:
    """M markers of tracked bodies, with the covariances of their positions."""

    def __init__(
        self, R: Array, P: Array, body: Index, code: Index, position: Array, normal: Array, radius: Array, /
    ) -> None:
        """R (B, 3, 3) and P (B, 12, 12) by body; body, code, radius (M,), position and normal (3, M) by marker."""

    def covariances(self, tau: float, /) -> Array:
        """(M, 3, 3) covariances of world positions, tau seconds after the time of the states."""

    def candidates(
        self, poses: FramePoses, detections: DetectionColumns, focal: Array, /
    ) -> tuple[Index, Array]:
        """(2, K) rows of markers and detections within each other's gates, and their costs (K,).

        focal (F,) pixels, by frame.
        """

def marker_states(
    bodies: BodyStates, P: Array, body: Index, position: Array, normal: Array, /
) -> tuple[Array, Array]:
    """(3, K, 3) positions, velocities and normals of K markers in the world, and position covariances (K, 3, 3).

    P (B, 12, 12) of the bodies; by marker its body (K,), position and normal (3, K).
    """

def assign(pairs: Index, cost: Array, frame: Index, /) -> Index:
    """As many as possible of the pairs (2, K) of markers and detections in each frame at the lowest total cost (K,),
    each marker and detection once: their columns, ascending.

    frame (N,) of the detections; pairs in the order of frames, then of markers.
    """

def labelings(
    first: Index,
    marker: Index,
    detection: Index,
    cost: Array,
    least: Index,
    most: Array,
    max_steps: int,
    max_labelings: int,
    /,
) -> tuple[Index, Array, Index, Index]:
    """Choices of pairs without a common marker or detection: view and cost of each choice (L,), and then, for each
    pair in a choice, the number of the choice and the row of the pair (R,).

    Pairs (K,) of markers and detections with costs, by view and ascending marker; those of view v start at `first[v]`
    of (V + 1,). A choice has `least` (V,) pairs or more that cost less than `most` (V,) together. The search ends after
    `max_steps`, or `max_labelings`, of a view.
    """

class Viewpoints:
    """The cameras of F frames."""

    def __init__(self, camera: Index, centres: Array, /) -> None:
        """Camera (F,), a row of the centres (C, 3)."""

class MarkerCloud:
    """N triangulated markers, among which constellations are searched for."""

    def __init__(
        self,
        positions: Array,
        covariances: Array,
        to_cameras: Array,
        slack_m: float,
        sigmas: float,
        reach_m: float,
        /,
    ) -> None:
        """Positions (N, 3), covariances (N, 3, 3), vectors to the cameras that saw each (N, C, 3), NaN for others.

        A distance is known to `slack_m` + `sigmas` standard deviations; constellations extend over `reach_m`.
        """

    def mappings(
        self,
        distances: Array,
        angles: Array,
        usable: NDArray[np.bool_],
        max_steps: int,
        max_mappings: int,
        /,
    ) -> tuple[Index, bool]:
        """Maximal mappings (K, M) of three or more markers of a constellation to points, -1 for unseen markers.

        `distances` and `angles` (M, M) are the constellation's: between markers, and between the normal of the marker
        of the row and the direction to that of the column, rad; `usable` (N,) says which points may be its markers.
        False if there are more mappings, with as many markers as one limit allows or fewer; beyond `max_steps` there
        are none.
        """

def detection_columns(
    uv: bytes,
    cov: bytes,
    axes_px: bytes,
    angle_rad: bytes,
    id: bytes,
    id_probability: bytes,
    rotation_rad: bytes,
    rotation_sigma: bytes,
    /,
) -> Array:
    """(19, N) columns of a `DetectionTable`, of those of `Detections`, before `undistort`."""

def undistort(cells: Array, cell_px: float, added_px2: float, columns: Array, /) -> bool:
    """Write the undistorted coordinates, NaN outside the cells and in place of impossible outlines, and add to the
    variances; returns whether all coordinates are known."""

def shears(axes: Array, angle: Array, centre: Array, normal: Array, radius: Array, scale: Array, /) -> Array:
    """(2, N) shears of measured ellipses relative to discs with centre and normal (3, N), camera frame."""

def predict(
    bodies: BodyStates, P: Array, dt: Array, densities: Array, single: NDArray[np.bool_], /
) -> tuple[Array, Array, Array, Array]:
    """R (N, 3, 3), p (N, 3) and P (N, 12, 12) after dt (N,) seconds, and the blocks T (N, 3, 3) of F.

    densities (N, 2) and single (N,): see `fusion.model.states.predict`.
    """

def weigh_motions(
    bodies: BodyStates,
    P: Array,
    information: Array,
    dt: Array,
    densities: Array,
    single: NDArray[np.bool_],
    equations: Array,
    body: Index,
    camera: Index,
    rig_share: Array,
    before: Array,
    shares: Array,
    /,
) -> tuple[Array, Array, Array, Index]:
    """Probabilities (B, 4) of models given the observations of a frame set, P and information (B, 12, 12) by the
    geometric mean of their densities, and the rows of the bodies that two cameras observe; the others do not change.

    B predicted bodies: their P, its inverse, dt (B,), densities (B, 2) and single (B,) as of `predict`. equations (N,
    2, 13) of centres, their body and camera (N,), and the shares of their variances (N,) that are the cameras'; before
    (B, 4) probabilities; shares (4,) of the densities: see `native/motion_models.hpp`.
    """

def eliminate_robots(
    equations: Array,
    weights: Array,
    body: Index,
    camera: Index,
    marker: Index,
    robot: Index,
    owner: Index,
    information: Array,
    right: Array,
    of_places: Array,
    right_of_places: Array,
    n_cameras: int,
    damping: float,
    /,
) -> tuple[Array, Array, Array, Array]:
    """(8 C, 8 C + 1) normal equations of C cameras with their right side, robots eliminated (Schur complement).

    Also (B, 12, 8 C + 1) and (M, 3, 8 C + 1): the errors of the B bodies and of the places of the M markers are the
    last column less the others times the errors of the cameras. And (3 M, 3 M): the information about the places with
    the cameras as they are, 0 between the markers of two robots. Equations (N, 2, 12 + 8 + 3 + 1): derivatives by body,
    camera and place, and residuals; weights, body, camera and marker (N,); robot (B,) of each body and owner (M,) of
    each marker, in ascending order; information and right sides (B, 12) and (M, 3) beside the observations; `damping`
    is the share by which their diagonals grow. Raises RuntimeError where a body or a marker is not determined.
    """

def respond(
    poses: FramePoses,
    camera: Index,
    equations: Array,
    weights: Array,
    rig_share: Array,
    frame: Index,
    body: Index,
    xy: Array,
    whiten: Array,
    information: Array,
    P: Array,
    T: Array,
    dt: Array,
    responses: Array,
    counted: Array,
    /,
) -> None:
    """Updates the responses (B, C, 12, 8) of B bodies to the errors of C cameras, and the parts (B, 12, 12) of P that
    count these errors as noise, by a filter's step.

    camera (F,) of the frames; equations (N, 2, 13) of N centres, their weights, shares of the variances that are
    counted for the cameras, frames and bodies (N,), xy (2, N) and whiten (2, 2, N); information of the predictions and
    P after the update (B, 12, 12); T (B, 3, 3) and dt (B,): see `fusion.model.states.Transition`.
    """

def consider(P: Array, counted: Array, responses: Array, factor: Array, R: Array, frame: Array, /) -> Array:
    """(B, 12, 12) covariances of B bodies with the errors of C cameras, whose covariance has the lower triangular
    factor (8 C, 8 C), in place of the part of P that counts these as noise (see `respond`), and with the errors of
    the bodies' own frames (B, 6, 6), body frame, which R (B, 3, 3) turns into the world."""

def are_own(
    equations: Array,
    cov: Array,
    log_density: Array,
    body: Index,
    camera: Index,
    certain: NDArray[np.bool_],
    information: Array,
    of_body: Index,
    of_camera: Index,
    turn: Index,
    prior: Array,
    added_px2: Array,
    /,
) -> NDArray[np.bool_]:
    """(N,) the assignments that are certain, or more probable as those of their bodies than as any roundels of their
    images.

    By assignment: equations (N, 2, 13), covariances of the centres (2, 2, N), px^2, logarithm of the density of
    roundels (N,), 1/px^2, body and camera (N,), certain (N,). Information (B, 12, 12) of
    the predictions. By doubt: a body, a camera or -1 for any, its turn, ascending, the logarithm of how probable the
    uncertain assignments are before, and a variance beside their noise (K,). Each is judged given the assignments that
    are certain, and those that were accepted in the turns before.
    """

def inverses(information: Array, /) -> Array:
    """(K, 12, 12) inverses of positive definite matrices; raises RuntimeError for others."""

def densest_ranges(
    frames: Viewpoints, frame: Index, direction: Array, reach: Array, moved: Array, ranges: Array, /
) -> Array:
    """(N,) range of each ray at which most rays of other cameras intersect it; NaN without intersections.

    By ray: frame (N,), direction (N, 3), reach (N,) in metres per metre, moved (N,) metres of the fastest marker until
    the ray's time, ranges (N, K, 2): see `native/ray_intersections.hpp`.
    """

def ray_pairs(
    frames: Viewpoints,
    frame: Index,
    direction: Array,
    reach: Array,
    moved: Array,
    ranges: Array,
    most: float,
    /,
) -> tuple[Index, Array]:
    """Rows (2, K) of rays of different cameras that miss each other by less than `most` tolerances.

    Also (2, K): the miss in tolerances, and the range on the first ray. By ray: see `densest_ranges`.
    """
