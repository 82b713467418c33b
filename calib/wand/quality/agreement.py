# SPDX-License-Identifier: BSD-3-Clause
"""Whether two calibrations of the same cameras agree within their covariances, and whose fault it is if not."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from calib.errors import CalibrationError
from calib.rig.rig import Rig
from camera_node.arrays import Array
from camera_node.geometry.pose import adjoint, invert, rigid_motions, vector_from_rotation

DOUBT = 1e-3  # probability below which chance is no explanation


@dataclass(frozen=True, slots=True)
class Placed:
    """Cameras of a calibration: names, T_world_cam (C, 4, 4), and the covariance (6C, 6C) of all poses together, each
    in its own frame, rotation then translation.

    What two calibrations with the same lens files share is no difference between them: `lenses` holds, by camera, how
    all poses change with its lens (6C, 4), log f, cx, cy and k1, and the standard deviations (4,) of these in the file;
    `covariance` is then what comes on top. Where nothing that was seen or measured tells the scale, they are not
    `metric`, and only their shape is compared.
    """

    names: Sequence[str]
    cameras: Array
    covariance: Array
    lenses: Mapping[str, tuple[Array, Array]] = field(default_factory=dict)
    metric: bool = True

    @classmethod
    def of_rig(cls, rig: Rig) -> "Placed":
        """What a rig file says: cameras whose covariance it has, poses independent of each other."""
        known = {n: c for n, c in rig.placed().items() if c.covariance is not None}
        covariance = np.zeros((6 * len(known), 6 * len(known)))
        for k, camera in enumerate(known.values()):
            covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = camera.covariance
        return cls(list(known), np.array([c.matrix() for c in known.values()]).reshape(-1, 4, 4), covariance)

    def select(self, names: Sequence[str]) -> "Placed":
        """These cameras, in this order."""
        rows = [list(self.names).index(name) for name in names]
        joint = np.concatenate([np.arange(6 * k, 6 * k + 6) for k in rows])
        lenses = {name: (by_lens[joint], sigma) for name, (by_lens, sigma) in self.lenses.items()}
        return Placed(
            list(names), self.cameras[rows], self.covariance[np.ix_(joint, joint)], lenses, self.metric
        )

    def sized_as(self, other: "Placed") -> "Placed":
        """These cameras, as far apart as the same ones of another calibration on average."""
        mine, wanted = (np.linalg.norm(np.std(p.cameras[:, :3, 3], axis=0)) for p in (self, other))
        factor = float(wanted / mine)
        cameras, unit = self.cameras.copy(), np.tile([1.0] * 3 + [factor] * 3, len(self.names))
        cameras[:, :3, 3] *= factor
        lenses = {name: (unit[:, None] * by_lens, sigma) for name, (by_lens, sigma) in self.lenses.items()}
        return Placed(self.names, cameras, unit[:, None] * self.covariance * unit, lenses, self.metric)

    def apart(self, other: "Placed") -> Array:
        """(6C, 6C) covariance of the difference from the same cameras in another calibration."""
        total, unknown = (
            self.covariance + other.covariance,
            (np.zeros((6 * len(self.names), 4)), np.full(4, np.inf)),
        )
        for name in {*self.lenses, *other.lenses}:
            (mine, sigma), (theirs, told) = (placed.lenses.get(name, unknown) for placed in (self, other))
            differ = (mine - theirs) * np.minimum(sigma, told)
            total = total + differ @ differ.T
        return total


@dataclass(frozen=True, slots=True)
class Agreement:
    """How two calibrations differ.

    Attributes:
        chi2, degrees: squared Mahalanobis length of the difference, and what it is on average.
        probability: of so large a difference by chance.
        shift_mm, turn_deg: by camera, after the best common motion of the world.
        guilty: the camera without which the others agree best; None where all agree.
        without: the probability without it; NaN where nothing is left to compare.
    """

    chi2: float
    degrees: int
    probability: float
    shift_mm: dict[str, float]
    turn_deg: dict[str, float]
    guilty: str | None
    without: float

    @property
    def holds(self) -> bool:
        """Whether chance explains the difference."""
        return self.probability >= DOUBT

    @property
    def ratio(self) -> float:
        """By how much differences exceed what the covariances expect, root mean square."""
        return float(np.sqrt(self.chi2 / self.degrees))

    def sentence(self, what: str = "the two halves of the recording") -> str:
        """In words."""
        figures = f"chi-square {self.chi2:.0f}, {self.degrees} on average"
        worst = max(self.shift_mm.values())
        if self.holds:
            timid = ", which claims more error than there is" if self.probability > 1 - DOUBT else ""
            return f"{what} agree within their covariance{timid} ({figures}; places differ by up to {worst:.2f} mm)"
        figures += f", p = {self.probability:.1g}"
        told = f"{what} differ by {self.ratio:.1f} times what their covariance says ({figures})"
        if self.guilty is None:
            return told
        name = self.guilty
        moved = (
            f"most in camera '{name}', by {self.shift_mm[name]:.1f} mm and {self.turn_deg[name]:.2f} degrees"
        )
        return f"{told}, {moved}" + ("; the others agree" if self.without >= DOUBT else "")


def compare(first: Placed, second: Placed) -> Agreement:
    """Test whether two independent calibrations of the same cameras differ by no more than their covariances say.

    The difference of the poses in each camera's own frame is projected on what no motion of the world changes, and no
    change of its scale where one of the two has none; of that, both covariances add, whatever world each was expressed
    in.

    Raises:
        CalibrationError: fewer than two cameras are in both.
    """
    names = [name for name in first.names if name in second.names]
    if len(names) < 2:
        raise CalibrationError(
            f"{len(names)} camera was placed both times ({', '.join(names) or 'none'}); two or more are needed "
            "to compare"
        )
    a, b = first.select(names), second.select(names)
    b = b if a.metric and b.metric else b.sized_as(a)
    chi2, degrees, probability = _test(a, b)
    others = {name: [n for n in names if n != name] for name in names} if len(names) > 2 else {}
    alone = {name: _test(a.select(rest), b.select(rest))[2] for name, rest in others.items()}
    guilty = max(alone, key=alone.__getitem__) if alone and probability < DOUBT else None
    keep = [n for n in names if n != guilty]
    off = _differences(a, b, _common(a.select(keep), b.select(keep)))
    return Agreement(
        chi2,
        degrees,
        probability,
        dict(zip(names, (1e3 * np.linalg.norm(off[:, 3:], axis=1)).tolist(), strict=True)),
        dict(zip(names, np.degrees(np.linalg.norm(off[:, :3], axis=1)).tolist(), strict=True)),
        guilty,
        alone[guilty] if guilty else float("nan"),
    )


def _test(a: Placed, b: Placed) -> tuple[float, int, float]:
    from scipy.stats import chi2 as distribution

    off = _differences(a, b, _common(a, b)).ravel()
    gauge = np.vstack([adjoint(invert(T)) for T in a.cameras])  # the world turned and shifted
    if not (a.metric and b.metric):  # and grown
        local = np.einsum("cji,cj->ci", a.cameras[:, :3, :3], a.cameras[:, :3, 3])
        gauge = np.column_stack([gauge, np.hstack([np.zeros_like(local), local]).ravel()])
    rest = np.linalg.svd(gauge)[0][:, gauge.shape[1] :]
    off, covariance = rest.T @ off, rest.T @ a.apart(b) @ rest
    squared, degrees = float(off @ np.linalg.solve(covariance, off)), len(off)
    return squared, degrees, float(distribution.sf(squared, degrees))


def _common(a: Placed, b: Placed) -> Array:
    """T_a_b (4, 4): the motion that brings the cameras of b nearest to those of a, centres and axes alike."""
    if len(a.cameras) == 1:
        return a.cameras[0] @ invert(b.cameras[0])
    extent = float(np.linalg.norm(np.ptp(a.cameras[:, :3, 3], axis=0))) / 2
    return rigid_motions(*(_corners(p.cameras, extent) for p in (b, a)))


def _corners(cameras: Array, reach: float) -> Array:
    """Each camera's centre, and the ends of its axes: (4C, 3)."""
    centres = cameras[:, :3, 3]
    ends = [centres + reach * cameras[:, :3, k] for k in range(3)]
    return np.concatenate([centres, *ends])


def _differences(a: Placed, b: Placed, T_a_b: Array) -> Array:
    """(C, 6) rotation and translation from the cameras of a to those of b, in the cameras' own frames."""
    out = []
    for here, there in zip(a.cameras, b.cameras, strict=True):
        D = invert(here) @ T_a_b @ there
        out.append(np.concatenate([vector_from_rotation(D[:3, :3]), D[:3, 3]]))
    return np.array(out)
