# SPDX-License-Identifier: BSD-3-Clause
"""What calibration says over Zenoh, in the encoding of `camera_node.messages`; the key is `Keys.rig`."""

import msgspec

from camera_node.messages import VERSION


class RigMessage(msgspec.Struct, frozen=True, kw_only=True):
    """The calibration in force, as the text of its `rig.yaml`."""

    version: int = VERSION
    t_ns: int
    yaml: str
