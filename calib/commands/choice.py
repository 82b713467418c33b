# SPDX-License-Identifier: BSD-3-Clause
"""Options of which a person gives one."""

from collections.abc import Mapping

from camera_node.errors import ConfigError


def require_one(given: Mapping[str, object], why: str = "") -> None:
    """Raise ConfigError unless one value, of options by the names that the error shows, is neither None nor False."""
    if sum(value is not None and value is not False for value in given.values()) != 1:
        *most, last = given
        raise ConfigError(f"give one of {', '.join(most)} and {last}{why}")
