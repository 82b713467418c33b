# SPDX-License-Identifier: BSD-3-Clause
"""What a diagnosis found."""

from typing import Literal

import msgspec


class Finding(msgspec.Struct, frozen=True):
    """One check: its subject, the state in words, and what to do about it; empty where all is well."""

    level: Literal["ok", "warning", "error"]
    subject: str
    state: str
    remedy: str = ""

    @property
    def line(self) -> str:
        return f"{self.level:7} {self.subject}: {self.state}" + (f"; {self.remedy}" if self.remedy else "")
