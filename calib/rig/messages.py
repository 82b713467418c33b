# SPDX-License-Identifier: BSD-3-Clause
"""The message of calibration on Zenoh, encoded as in `camera_node.protocol.messages`; its key is `Keys.rig`."""

import time

import msgspec
import yaml

from calib.rig.rig import Rig, dump_rig
from camera_node.protocol.messages import VERSION, MessageError


class RigMessage(msgspec.Struct, frozen=True, kw_only=True):
    """The calibration in force, as the text of its `rig.yaml`."""

    version: int = VERSION
    t_ns: int
    yaml: str

    @classmethod
    def of(cls, rig: Rig) -> "RigMessage":
        """The message of a rig that is in force from now on."""
        return cls(t_ns=time.time_ns(), yaml=dump_rig(rig))

    def rig(self) -> Rig:
        """Decode the rig.

        Raises:
            MessageError: the text is not a valid rig.yaml; the error is one line.
        """
        try:
            return msgspec.yaml.decode(self.yaml, type=Rig)
        except (msgspec.MsgspecError, yaml.YAMLError, ValueError, RecursionError) as error:
            raise MessageError(f"not a valid rig.yaml: {' '.join(str(error).split())[:200]}") from None
