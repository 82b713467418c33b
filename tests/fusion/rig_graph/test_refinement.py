# SPDX-License-Identifier: BSD-3-Clause
"""What windows of keyframes show of the rig: estimates within their claims, and corrections of real errors."""

from collections.abc import Mapping

import msgspec
import numpy as np
import pytest
from scipy.stats import chi2

from calib.rig.camera import FOCAL_STABILITY, Camera
from calib.rig.camera_errors import ERRORS, OF_IMAGE, USUAL_PX, error_covariance, image_metrics
from camera_node.geometry.pose import Pose
from fusion.rig_graph.clock_walk import OFFSET_SIGMA_S
from fusion.rig_graph.hypotheses import LARGE, retract
from fusion.rig_graph.refinement import Refinement
from tests.fusion.synthetic import ring

WINDOW_NS, START_NS = 600_000_000, 10**18
NOISE_PX = 0.02  # of what a window shows of one error
SINCE = np.array([1e-8] * 3 + [1e-8] * 3 + [OFFSET_SIGMA_S, FOCAL_STABILITY]) ** 2


class Windows:
    """Windows in which each camera shows all of its errors, relative to those of the others.

    Args:
        cameras: by name.
        rng: for the noise.
    """

    def __init__(self, cameras: Mapping[str, Camera], rng: np.random.Generator) -> None:
        self._rng, n = rng, len(cameras)
        metrics = image_metrics(list(cameras.values()))
        metrics[:, 6, 6] = 1e4**2  # a clock of 0.1 ms displaces an image by a pixel
        information = np.zeros((n, ERRORS, n, ERRORS))
        for k, metric in enumerate(metrics):
            information[k, :, k] = metric / NOISE_PX**2
        self._H = information.reshape(n * ERRORS, -1)
        self._root = np.linalg.cholesky(self._H + 1e-9 * np.diag(np.diag(self._H)))

    def show(self, refinement: Refinement, errors: np.ndarray, k: int) -> None:
        """Window k, of errors (8 C,)."""
        noise = self._root @ self._rng.normal(size=len(errors))
        n = len(errors) // ERRORS
        refinement.update(
            START_NS + k * WINDOW_NS, self._H, self._H @ errors + noise, np.zeros(n), np.zeros((n, n))
        )


def since(n: int) -> np.ndarray:
    return np.tile(SINCE, n)


def applied(before: Mapping[str, Camera], after: Mapping[str, Camera]) -> np.ndarray:
    """(8 C,) the errors by which cameras were corrected."""
    found = []
    for name, camera in before.items():
        motion = np.linalg.inv(camera.matrix()) @ after[name].matrix()
        turn = (
            np.array([motion[2, 1] - motion[1, 2], motion[0, 2] - motion[2, 0], motion[1, 0] - motion[0, 1]])
            / 2
        )
        found.append([*turn, *motion[:3, 3], 0.0, np.log(after[name].fx / camera.fx)])
    return np.ravel(found)


def image_px(errors: np.ndarray, metrics: np.ndarray) -> np.ndarray:
    """(C,) RMS of a coordinate of the images, by errors (8 C,) of the cameras."""
    of_cameras = errors.reshape(-1, ERRORS)
    return np.sqrt(np.einsum("ki,kij,kj->k", of_cameras, metrics, of_cameras))


def test_estimates_are_within_their_claims():
    """Of errors that have the covariance of the calibration. Windows have less noise than they may."""
    cameras, squares, n = ring(3), [], 3 * ERRORS
    rng = np.random.default_rng(1)
    prior = error_covariance(list(cameras.values())) + np.diag(since(3))
    for _ in range(30):
        truth = np.linalg.cholesky(prior) @ rng.normal(size=n)
        refinement, windows = Refinement(cameras, since(3)), Windows(cameras, rng)
        for k in range(8):
            windows.show(refinement, truth, k)
        off = refinement.x - truth
        squares.append(off @ np.linalg.solve(refinement.P, off))
    assert np.sum(squares) < chi2.ppf(0.999, 30 * n)


@pytest.mark.parametrize("n", [2, 3, 8])
def test_a_rig_without_errors_is_left_alone(n: int):
    cameras = ring(n)
    for seed in range(5):
        refinement, windows = Refinement(cameras, since(n)), Windows(cameras, np.random.default_rng(seed))
        for k in range(40):
            windows.show(refinement, np.zeros(n * ERRORS), k)
            assert not refinement.is_significant


@pytest.mark.parametrize("percent", [0.2, -0.7])
def test_a_lens_that_changes_is_corrected(percent: float):
    """Within twelve windows, and no other camera by more than its noise: pose and lens look alike in these."""
    cameras, lens = ring(4), 1 + percent / 100
    changed = msgspec.structs.replace(
        cameras["cam2"], fx=cameras["cam2"].fx * lens, fy=cameras["cam2"].fy * lens
    )
    refinement, windows = Refinement(cameras, since(4)), Windows(cameras, np.random.default_rng(2))
    refined, metrics = [], image_metrics(list(cameras.values()))
    for k in range(22):
        truth = cameras if k < 10 else {**cameras, "cam2": changed}
        windows.show(refinement, applied(refinement.cameras, truth), k)
        if refinement.is_significant:
            refined.append(refinement.correct(()))
            assert not refinement.is_significant
    off_px = image_px(applied(refinement.cameras, {**cameras, "cam2": changed}), metrics)
    assert off_px[2] < LARGE * USUAL_PX + NOISE_PX  # of 0.6 px: less is not corrected
    assert np.delete(off_px, 2).max() < USUAL_PX
    assert refined
    assert all("camera cam2 by" in str(found) for found in refined)


@pytest.mark.ci
@pytest.mark.parametrize(("rate", "n_windows"), [(1.0, 1500), (10.0, 600)])
def test_poses_that_drift_are_followed_and_claimed(rate: float, n_windows: int):
    """All cameras turn by half a degree in an hour, and sink by 5 mm, or ten times as fast. Each correction states what
    is left, with what all have in common, and the next go on from it."""
    cameras, rng = ring(4), np.random.default_rng(3)
    axes = rng.normal(size=(4, 3))
    axes *= np.radians(0.5) / 3600 / np.linalg.norm(axes, axis=1, keepdims=True)
    T = np.array([c.matrix() for c in cameras.values()])
    down = -T[:, 2, :3] * 5e-3 / 3600
    metrics = image_metrics(list(cameras.values()))
    refinement, windows, n_corrections = Refinement(cameras, since(4)), Windows(cameras, rng), 0
    off_px, squared = [], []
    for k in range(n_windows):
        drifted = np.zeros((4, ERRORS))
        drifted[:, :6] = rate * np.column_stack([axes, down]) * k * WINDOW_NS * 1e-9
        used = {
            name: msgspec.structs.replace(camera, T_world_cam=Pose.from_matrix(there))
            for (name, camera), there in zip(cameras.items(), retract(T, drifted), strict=True)
        }
        errors = applied(refinement.cameras, used)
        windows.show(refinement, errors, k)
        if refinement.is_significant:
            refinement.correct(())
            n_corrections += 1
            of_image = np.flatnonzero(np.tile(OF_IMAGE, 4))
            left = applied(refinement.cameras, used)[of_image]
            stated = error_covariance(list(refinement.cameras.values()))[np.ix_(of_image, of_image)]
            squared.append(left @ np.linalg.solve(stated, left) / len(left))
        off_px.append(image_px(errors, metrics).max())
    assert n_corrections > 3
    assert max(off_px) < 0.25  # of 1.4 and 5.2 px
    assert max(squared) < 2  # 2.7 without what all have in common


def test_a_clock_or_one_of_three_cameras_changes_no_pose():
    for n, error in ((4, (6, 4e-3)), (3, (0, 1e-3))):
        cameras, truth = ring(n), np.zeros(n * ERRORS)
        refinement, windows = Refinement(cameras, since(n)), Windows(cameras, np.random.default_rng(4))
        for k in range(6):
            windows.show(refinement, truth, k)
        truth[error[0]] = error[1]
        before = np.diag(refinement.P).copy()
        windows.show(refinement, truth, 6)
        windows.show(refinement, truth, 7)
        assert not refinement.is_significant
        assert (np.diag(refinement.P) < 1.5 * before).all()  # 1.42 as they wander; none is free


@pytest.mark.parametrize(("sigma_s", "least", "most"), [(0.0, 2e-4, 4e-4), (2e-2, 0.0, 5e-5)])
def test_what_a_clock_may_explain_is_no_pose(sigma_s: float, least: float, most: float):
    """Windows show a turn and an offset of one camera only together, by the way robots move: 0.3 mrad or 3 ms."""
    cameras, seen = ring(4), np.zeros(4 * ERRORS)
    seen[0], seen[6] = 1.0, 0.1
    H = np.outer(seen, seen) / 2e-5**2
    refinement = Refinement(cameras, since(4))
    refinement.widen(4.0)
    for k in range(6):
        of_clocks = sigma_s**2 * np.eye(4)
        refinement.update(START_NS + k * WINDOW_NS, H, 3e-4 * H[:, 0], np.zeros(4), of_clocks)
    assert least <= refinement.x[0] <= most


def test_errors_that_are_not_known_are_claimed():
    """Windows show by how much two cameras turn together, 1 mrad, and not which of them does."""
    cameras, seen = ring(4), np.zeros(4 * ERRORS)
    seen[0] = seen[ERRORS] = 1.0
    H, refinement = np.outer(seen, seen) / 2e-5**2, Refinement(cameras, since(4))
    assert refinement.excess == 1.0
    refinement.widen(8.0)
    for k in range(3):
        refinement.update(START_NS + k * WINDOW_NS, H, 1e-3 * H[:, 0], np.zeros(4), np.zeros((4, 4)))
    assert not refinement.is_significant
    turned = 1e-3 * refinement.relative[:, 0]
    off_px = image_px(turned, image_metrics(list(cameras.values())))
    assert refinement.excess * USUAL_PX > off_px[0] / 2  # as large as if either of them turned by half


def test_an_offset_that_is_known_is_no_pose():
    cameras, seen = ring(4), np.zeros(4 * ERRORS)
    seen[0], seen[6] = 1.0, 0.1
    H, refinement = np.outer(seen, seen) / 2e-5**2, Refinement(cameras, since(4))
    offsets = np.array([3e-3, 0.0, 0.0, 0.0])
    refinement.update(START_NS, H, 3e-4 * H[:, 0], offsets, np.zeros((4, 4)))
    assert np.abs(refinement.x).max() < 1e-9


def test_a_pinned_camera_is_not_corrected_and_its_errors_stay_known():
    cameras, truth = ring(4), np.zeros(4 * ERRORS)
    truth[0], truth[ERRORS + 1] = 3e-4, -3e-4
    refinement, windows = Refinement(cameras, since(4)), Windows(cameras, np.random.default_rng(5))
    refinement.widen(8.0)
    for k in range(6):
        windows.show(refinement, truth, k)
    assert refinement.is_significant
    refined = refinement.correct({"cam0"})
    assert refined.rig["cam0"].T_world_cam == cameras["cam0"].T_world_cam
    assert refinement.x[0] == pytest.approx(3e-4, rel=0.3)  # a turn looks like a shift
    assert refinement.x[ERRORS + 1] == pytest.approx(0.0, abs=1e-12)
    stated = error_covariance(list(refined.rig.values()))
    assert stated[0, 0] > (2e-4) ** 2  # what is known of it and not corrected is claimed
