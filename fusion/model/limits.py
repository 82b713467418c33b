# SPDX-License-Identifier: BSD-3-Clause
"""The tunable limits of tracking: a module of its own because server, tracking and recordings all read them."""

import msgspec


class Limits(msgspec.Struct, frozen=True, kw_only=True):
    """Tunable limits; the defaults suit printed roundels and calibrated cameras. Messages of servers of other versions
    may have further ones."""

    lost_after_s: float = 0.3  # without an observation
    # How long a frame set waits for a camera from when the fastest one usually delivers; cheap USB ones lag by 100 ms.
    lateness_ms: float = 150.0
    tracked_sigma_m: float = (
        0.05  # a robot with a larger position sigma is `coasting`, even while it is visible
    )


class LimitSettings(Limits, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The limits in arena.yaml, where an unknown one is a mistake."""
