# SPDX-License-Identifier: BSD-3-Clause
"""Tests whether two calibrations of the same cameras agree within their covariances, and which camera moved if not."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from calib.errors import CalibrationError
from calib.rig.camera import LENS, POSE
from calib.rig.rig import Rig
from calib.wand.bundle_adjustment.covariance import camera_covariance
from calib.wand.wand_report import WandCalibration
from camera_node.foundation.arrays import Array
from camera_node.geometry.pose import adjoint, invert, rigid_motions, vector_from_rotation

SIGNIFICANCE = 1e-3  # probability below which a difference is not due to chance


@dataclass(frozen=True, slots=True)
class CameraPoses:
    """Poses of the C cameras of a calibration with their joint covariance.

    Two calibrations from the same lens file share the errors of its lenses, which therefore cause no difference: they
    are held apart in `lenses`.

    Attributes:
        names: of the cameras.
        cameras: (C, 4, 4) T_world_cam.
        covariance: (6C, 6C) of all poses, each in its camera's frame, rotation then translation; without `lenses`.
        lenses: by camera, the derivative (6C, 9) of all poses by its lens (`LENS`), and the standard
            deviations (9,) of these in the file.
        metric: whether the scale is known; otherwise only the shape is compared.
    """

    names: Sequence[str]
    cameras: Array
    covariance: Array
    lenses: Mapping[str, tuple[Array, Array]] = field(default_factory=dict)
    metric: bool = True

    @classmethod
    def of_rig(cls, rig: Rig) -> "CameraPoses":
        """Collect the cameras of a rig file that have covariances, as independent of each other."""
        known = {n: c for n, c in rig.placed().items() if c.covariance is not None}
        covariance = np.zeros((6 * len(known), 6 * len(known)))
        for k, camera in enumerate(known.values()):
            covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = camera.covariance
        return cls(list(known), np.array([c.matrix() for c in known.values()]).reshape(-1, 4, 4), covariance)

    @classmethod
    def of_calibration(cls, result: WandCalibration) -> "CameraPoses":
        """Collect the cameras of a calibration, the effect of the lens priors apart."""
        adjusted = result.adjusted
        free, count = list(adjusted.problem.free), len(result.names)
        pose, lens = [free.index(p) for p in POSE], [free.index(p) for p in LENS]
        by_prior = camera_covariance(adjusted).by_prior.reshape(count, len(free), count, len(free))
        by_prior = by_prior[:, pose][:, :, :, lens]
        by_lens = by_prior.reshape(6 * count, len(LENS) * count)
        rest = result.covariance - by_lens @ by_lens.T
        sigma = adjusted.problem.prior_sigma(of_covariance=True)[:, lens]
        lenses = {
            name: (by_prior[:, :, k].reshape(6 * count, len(LENS)) / sigma[k], sigma[k])
            for k, name in enumerate(result.names)
        }
        scaled_by = result.report.scaled_by
        metric = adjusted.problem.fixed_distance is None or (scaled_by is not None and scaled_by.sigma_m > 0)
        return cls(result.names, adjusted.state.cameras, rest, lenses, metric)

    def select(self, names: Sequence[str]) -> "CameraPoses":
        """Return the cameras `names`, in this order."""
        rows = [list(self.names).index(name) for name in names]
        joint = np.concatenate([np.arange(6 * k, 6 * k + 6) for k in rows])
        lenses = {name: (by_lens[joint], sigma) for name, (by_lens, sigma) in self.lenses.items()}
        return CameraPoses(
            list(names), self.cameras[rows], self.covariance[np.ix_(joint, joint)], lenses, self.metric
        )

    def scaled_to(self, other: "CameraPoses") -> "CameraPoses":
        """Return the poses with the mean extent of the same cameras in another calibration."""
        mine, wanted = (np.linalg.norm(np.std(p.cameras[:, :3, 3], axis=0)) for p in (self, other))
        factor = float(wanted / mine)
        cameras, unit = self.cameras.copy(), np.tile([1.0] * 3 + [factor] * 3, len(self.names))
        cameras[:, :3, 3] *= factor
        lenses = {name: (unit[:, None] * by_lens, sigma) for name, (by_lens, sigma) in self.lenses.items()}
        return CameraPoses(self.names, cameras, unit[:, None] * self.covariance * unit, lenses, self.metric)

    def difference_covariance(self, other: "CameraPoses") -> Array:
        """Return (6C, 6C) covariance of the difference from the same cameras in another calibration."""
        total = self.covariance + other.covariance
        unknown = np.zeros((6 * len(self.names), len(LENS))), np.full(len(LENS), np.inf)
        for name in {*self.lenses, *other.lenses}:
            (mine, sigma), (theirs, other_sigma) = (p.lenses.get(name, unknown) for p in (self, other))
            difference = (mine - theirs) * np.minimum(sigma, other_sigma)
            total = total + difference @ difference.T
        return total


@dataclass(frozen=True, slots=True)
class Agreement:
    """The difference of two calibrations.

    Attributes:
        chi2, degrees: squared Mahalanobis length of the difference, and its degrees of freedom.
        probability: of a difference this large by chance.
        shift_mm, turn_deg: by camera, after the best rigid motion of the world.
        moved: the camera without which the others agree best; None if all agree.
        probability_without: that of the others' difference; NaN without `moved`.
    """

    chi2: float
    degrees: int
    probability: float
    shift_mm: dict[str, float]
    turn_deg: dict[str, float]
    moved: str | None
    probability_without: float

    @property
    def holds(self) -> bool:
        """Whether the calibrations agree within their covariances."""
        return self.probability >= SIGNIFICANCE

    @property
    def ratio(self) -> float:
        """The RMS ratio of the differences to their standard deviations."""
        return float(np.sqrt(self.chi2 / self.degrees))

    def sentence(self, subject: str = "the two halves of the recording") -> str:
        """State whether they agree, with figures, and which camera moved if not."""
        figures = f"chi-square {self.chi2:.0f}, {self.degrees} degrees of freedom"
        if self.holds:
            large = ", which is too large" if self.probability > 1 - SIGNIFICANCE else ""
            shift_mm = max(self.shift_mm.values())
            figures += f"; positions differ by up to {shift_mm:.2f} mm"
            return f"{subject} agree within their covariance{large} ({figures})"
        text = (
            f"{subject} differ by {self.ratio:.1f} standard deviations RMS "
            f"({figures}, p = {self.probability:.1g})"
        )
        if self.moved is None:
            return text
        shift_mm, turn_deg = self.shift_mm[self.moved], self.turn_deg[self.moved]
        text += f", most in camera '{self.moved}', by {shift_mm:.1f} mm and {turn_deg:.2f} degrees"
        return text + ("; the others agree" if self.probability_without >= SIGNIFICANCE else "")


def compare_calibrations(first: CameraPoses, second: CameraPoses) -> Agreement:
    """Test whether two independent calibrations of the same cameras agree within their covariances.

    The differences of the poses, in the cameras' own frames, are projected onto the complement of the gauge: rigid
    motions of the world, and its scale if one of the two is not metric. Both covariances add there, whatever the world
    frame of each is.

    Raises:
        CalibrationError: fewer than two cameras are in both.
    """
    names = [name for name in first.names if name in second.names]
    if len(names) < 2:
        raise CalibrationError(
            f"both calibrations have {len(names)} camera in common ({', '.join(names) or 'none'}); the comparison "
            "needs two or more"
        )
    a, b = first.select(names), second.select(names)
    b = b if a.metric and b.metric else b.scaled_to(a)
    chi2, degrees, probability = _test(a, b)
    moved, without = _find_moved(a, b) if probability < SIGNIFICANCE else (None, float("nan"))
    rest = [name for name in names if name != moved]
    difference = _differences(a, b, _align(a.select(rest), b.select(rest)))
    return Agreement(
        chi2,
        degrees,
        probability,
        dict(zip(names, (1e3 * np.linalg.norm(difference[:, 3:], axis=1)).tolist(), strict=True)),
        dict(zip(names, np.degrees(np.linalg.norm(difference[:, :3], axis=1)).tolist(), strict=True)),
        moved,
        without,
    )


def _find_moved(a: CameraPoses, b: CameraPoses) -> tuple[str | None, float]:
    """Return the camera without which the others agree best, and their probability; None of two cameras."""
    if len(a.names) < 3:
        return None, float("nan")
    others = {name: [n for n in a.names if n != name] for name in a.names}
    probabilities = {name: _test(a.select(rest), b.select(rest))[2] for name, rest in others.items()}
    moved = max(probabilities, key=probabilities.__getitem__)
    return moved, probabilities[moved]


def _test(a: CameraPoses, b: CameraPoses) -> tuple[float, int, float]:
    """Return chi-square of the difference of the same cameras, its degrees of freedom and its probability."""
    from scipy.special import chdtrc

    difference = _differences(a, b, _align(a, b)).ravel()
    gauge = np.vstack([adjoint(invert(T)) for T in a.cameras])  # rigid motions of the world
    if not (a.metric and b.metric):  # and its scale
        local = np.einsum("cji,cj->ci", a.cameras[:, :3, :3], a.cameras[:, :3, 3])
        gauge = np.column_stack([gauge, np.hstack([np.zeros_like(local), local]).ravel()])
    rest = np.linalg.svd(gauge)[0][:, gauge.shape[1] :]
    difference, covariance = rest.T @ difference, rest.T @ a.difference_covariance(b) @ rest
    squared, degrees = float(difference @ np.linalg.solve(covariance, difference)), len(difference)
    return squared, degrees, float(chdtrc(degrees, squared))


def _align(a: CameraPoses, b: CameraPoses) -> Array:
    """Return T_a_b (4, 4), the rigid motion that best aligns the centres and axes of the cameras of b with a."""
    if len(a.cameras) == 1:
        return a.cameras[0] @ invert(b.cameras[0])
    extent = float(np.linalg.norm(np.ptp(a.cameras[:, :3, 3], axis=0))) / 2
    return rigid_motions(*(_corners(p.cameras, extent) for p in (b, a)))


def _corners(cameras: Array, reach: float) -> Array:
    """Return (4C, 3) the centres of the cameras, and the points on their axes at a distance."""
    centres = cameras[:, :3, 3]
    ends = [centres + reach * cameras[:, :3, k] for k in range(3)]
    return np.concatenate([centres, *ends])


def _differences(a: CameraPoses, b: CameraPoses, T_a_b: Array) -> Array:
    """Return (C, 6) rotations and translations from the cameras of a to those of b, in the cameras' frames."""
    differences = []
    for here, there in zip(a.cameras, b.cameras, strict=True):
        D = invert(here) @ T_a_b @ there
        differences.append(np.concatenate([vector_from_rotation(D[:3, :3]), D[:3, 3]]))
    return np.array(differences)
