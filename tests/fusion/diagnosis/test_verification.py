# SPDX-License-Identifier: BSD-3-Clause
"""`roundel verify`: an object of known size shows the scale and precision of a calibration, and whether claims hold."""

import itertools
import json
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from scipy import stats

from calib.rig.camera import Camera
from calib.rig.recording import save_wand_recording
from calib.rig.rig import Rig, save_rig
from calib.rig.triangulation import triangulate_point
from calib.rig.wand_file import WandBody
from camera_node.foundation.config import dump_yaml
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.pose import Pose, rotation_from_vector
from camera_node.protocol.messages import Detections
from fusion.commands.verify import Verify
from fusion.diagnosis.verification import Verification, Verifier
from fusion.errors import FusionError
from fusion.protocol.pose_messages import Markers
from tests.fusion.carried_rod import LOOP, LOOP_S, ROD, arena, carry
from tests.fusion.synthetic import PERIOD_NS, START_NS, ring

CAMERAS = ring(4)
ARENA = arena()
WAND = WandBody(diameter_m=0.1, markers=((0.0, 0.0, 0.0), (0.2, 0.0, 0.0), (0.5, 0.0, 0.0)))
BOARD = WandBody(
    diameter_m=0.05, markers=((0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.0, 0.2, 0.0), (0.3, 0.2, 0.0))
)


def message(
    t_ns: int, position: np.ndarray, velocity: np.ndarray, covariance: np.ndarray, diameter_m: float
) -> Markers:
    """Unlabeled markers (N, 3) that all cameras see, with the claims (N, 3, 3)."""
    n = len(position)
    return Markers(
        t_ns=t_ns,
        robots=(),
        camera_names=tuple(CAMERAS),
        position=position.astype("<f8").tobytes(),
        covariance=covariance.astype("<f4").tobytes(),
        normal=np.full((n, 3), np.nan, "<f4").tobytes(),
        velocity=velocity.astype("<f4").tobytes(),
        diameter=np.full(n, diameter_m, "<f4").tobytes(),
        robot=np.full(n, -1, "<i4").tobytes(),
        marker=np.full(n, -1, "<i4").tobytes(),
        cameras=np.full(n, 15, "<u8").tobytes(),
    )


def carried(body: WandBody, n: int, loops: int) -> Iterator[tuple[int, np.ndarray]]:
    """Time and true positions of the markers in loops of the motion of n frame sets each."""
    for k in range(n * loops):
        R, p = carry(k * LOOP_S / n)
        yield START_NS + k * PERIOD_NS, p + body.points @ R.T


def verify(
    body: WandBody,
    error: Callable[[np.ndarray], np.ndarray],
    claim_m: float = 1e-3,
    cameras: dict[str, Camera] = CAMERAS,
    n: int = LOOP,
    loops: int = 1,
) -> Verification:
    """The report on loops of n frame sets whose positions `error` makes of the true ones."""
    verifier = Verifier(body, cameras, 0.0)
    before = np.empty((0, 3))
    for t_ns, true in carried(body, n, loops):
        position = error(true)
        velocity = (position - before) / (1e-9 * PERIOD_NS) if len(before) == len(position) else 0 * position
        claims = np.tile(claim_m**2 * np.eye(3), (len(position), 1, 1))
        verifier.add(message(t_ns, position, velocity, claims, body.diameter_m))
        before = position
    return verifier.report()


def noisy(seed: int, sigma_m: float = 1e-3) -> Callable[[np.ndarray], np.ndarray]:
    rng = np.random.default_rng(seed)
    return lambda true: true + rng.normal(0, sigma_m, true.shape)


@pytest.fixture(scope="module")
def recorded() -> list[Detections]:
    return ARENA.messages(90)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "rod.yaml").write_text(dump_yaml(ROD))
    return tmp_path


def scaled(cameras: dict[str, Camera], scale: float) -> dict[str, Camera]:
    """The cameras of a calibration whose wand was declared too long by this factor."""

    def place(camera: Camera) -> Pose:
        assert camera.T_world_cam is not None
        x, y, z = (scale * np.array(camera.T_world_cam.position_m)).tolist()
        return Pose((x, y, z), camera.T_world_cam.wxyz)

    return {name: msgspec.structs.replace(c, T_world_cam=place(c)) for name, c in cameras.items()}


@pytest.mark.parametrize("percent", [*(pytest.param(percent, marks=pytest.mark.ci) for percent in (0, 1)), 2])
def test_the_scale_of_a_recording(
    percent: int, recorded: list[Detections], folder: Path, capsys: pytest.CaptureFixture[str]
):
    """Within three standard deviations, which are far below a percent, although a wall has roundels as far apart."""
    save_wand_recording(folder / "rod.mcap", "test", recorded)
    save_rig(Rig(cameras=scaled(ARENA.cameras, 1 + percent / 100)), folder / "rig.yaml")
    rod, recording, rig, picture = (folder / name for name in ("rod.yaml", "rod.mcap", "rig.yaml", "map.png"))
    code = Verify(known_object=rod, recording=recording, rig=rig, json=True, map=picture).run()
    report = json.loads(capsys.readouterr().out)
    assert report["used"] >= 0.9 * report["frame_sets"]
    assert abs(report["scale"] - 1 - percent / 100) < 3 * report["scale_sigma"]
    assert report["scale_sigma"] < 1e-3
    assert report["claims_hold"]
    assert code == (1 if percent else 0)
    image = cv2.imread(str(picture))
    assert image is not None
    assert image.std() > 0


def test_claims_that_hold_and_claims_that_are_too_small():
    """At the confidence of 99 %, none of five honest claims is refused; all that are half as large are."""
    for seed in range(5):
        honest = verify(BOARD, noisy(seed), n=60)
        assert honest.holds, honest.lines("board.yaml")
        too_small = verify(BOARD, noisy(seed), claim_m=0.5e-3, n=60)
        assert not too_small.claims_hold
        assert too_small.error_over_claim == pytest.approx(4 * honest.error_over_claim, rel=1e-3)


def test_the_error_over_claim_of_many_frame_sets_is_one():
    """The sum of squared errors is chi-square: of the coordinates, less those of a pose (5 where all are on a line)."""
    for body, degrees in ((ROD, 1), (WAND, 4), (BOARD, 6)):
        report = verify(body, noisy(1), n=300)
        n = degrees * report.used
        assert report.used >= 290
        assert stats.chi2.cdf(n * report.error_over_claim, n) == pytest.approx(0.5, abs=0.499)


def test_the_scale_does_not_become_certain_by_waiting():
    """Errors of the rig are common to a place: ten times as many frame sets there add almost no knowledge."""

    def stretched(true: np.ndarray) -> np.ndarray:
        """By up to a percent, more on one side of the arena than on the other."""
        return true * (1 + 0.01 * np.tanh(true.mean(axis=0)[0]))

    few, many = (verify(ROD, stretched, n=60, loops=loops) for loops in (1, 10))
    assert many.scale_sigma == pytest.approx(few.scale_sigma, rel=0.1)
    assert abs(many.scale - 1) < 3 * many.scale_sigma


@pytest.mark.ci
def test_the_covariance_of_the_rig_explains_the_scale():
    """Rigs that are drawn from their covariance have scales as uncertain as stated: chi-square over six of them."""
    rng, sigma = np.random.default_rng(3), np.array([5e-4] * 3 + [2e-3] * 3)
    covariance = tuple(map(tuple, np.diag(sigma**2).tolist()))
    truth = list(CAMERAS.values())
    z = []
    for _ in range(6):
        moved = {}
        for name, camera in CAMERAS.items():
            turn, shift = np.split(rng.normal(0, sigma), 2)
            T = camera.matrix().copy()
            T[:3, 3] += T[:3, :3] @ shift
            T[:3, :3] = T[:3, :3] @ rotation_from_vector(turn)
            moved[name] = msgspec.structs.replace(
                camera, T_world_cam=Pose.from_matrix(T), covariance=covariance
            )
        rig = list(moved.values())

        def seen(true: np.ndarray, rig: list[Camera] = rig) -> np.ndarray:
            pixels = np.array([camera.project_world(true) for camera in truth])
            return np.array([triangulate_point(rig, pixels[:, k]) for k in range(len(true))])

        report = verify(ROD, seen, cameras=moved, n=60)
        assert report.rig_sigma is not None
        assert report.rig_sigma > 1e-4
        z.append((report.scale - 1) / report.scale_sigma)
    assert stats.chi2.cdf(np.square(z).sum(), len(z)) == pytest.approx(0.5, abs=0.495)


def test_an_object_that_is_never_seen_as_a_whole():
    """Two of a wand's three roundels show a length; one alone shows none."""
    numbers, measure = itertools.count(), noisy(2)
    report = verify(WAND, lambda true: measure(np.delete(true, next(numbers) // 20 % 3, axis=0)))
    assert report.used > 0
    assert report.scale_holds
    with pytest.raises(FusionError, match="no frame set of 120 shows two markers"):
        verify(ROD, lambda true: true[:1])


def test_an_object_that_stays_in_one_place_is_not_enough():
    with pytest.raises(FusionError, match="carry it through the whole arena"):
        verify(ROD, lambda true: 0.1 * true.mean(axis=0) + true - true.mean(axis=0))


def test_a_marker_that_moves_beside_the_object_is_not_taken_for_it():
    """Another one that follows the rod's end at the same distance makes it ambiguous; one that passes by does not."""

    def with_passing(true: np.ndarray) -> np.ndarray:
        return np.vstack([true, [true[0, 1], -true[0, 0], 0.4]])

    assert verify(ROD, lambda true: with_passing(noisy(1)(true))).scale_holds

    def with_third(true: np.ndarray) -> np.ndarray:
        return np.vstack([true, true[0] + (true[1] - true[0]) @ [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]])

    with pytest.raises(FusionError, match="several labelings"):
        verify(ROD, with_third)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({}, "give one of --live, --recording MCAP and --frames FOLDER"),
        ({"live": True, "seconds": 0.0}, "--seconds is 0"),
        ({"frames": Path("frames")}, "--rig rig.yaml"),
        ({"live": True, "length_sigma_mm": -1.0}, "--length-sigma-mm is -1"),
    ],
)
def test_mistakes_are_reported(options: dict, said: str, folder: Path):
    with pytest.raises(ConfigError, match=said):
        Verify(known_object=folder / "rod.yaml", **options).run()


def test_an_object_of_one_marker_is_refused():
    with pytest.raises(ConfigError, match="it needs 2"):
        Verifier(WandBody(diameter_m=0.1), CAMERAS)
