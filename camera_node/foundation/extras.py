# SPDX-License-Identifier: BSD-3-Clause
"""Imports of packages that only some users need, and what to install where they are missing."""

from importlib import import_module
from typing import Any

from camera_node.foundation.errors import ConfigError


def require(module: str, extra: str, purpose: str) -> Any:
    """Import a module of an optional package.

    Args:
        module: its full name.
        extra: the extra of this package that installs it.
        purpose: what needs it, as the subject of a sentence.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = module.split(".")[0]
        raise ConfigError(f"{purpose} needs {package} ({error}); pip install 'roundel[{extra}]'") from None
