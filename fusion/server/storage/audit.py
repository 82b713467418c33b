# SPDX-License-Identifier: BSD-3-Clause
"""Notes who changed the rig and the robots: a line in the log, and in a file that is forced to the disk and bounded."""

import contextlib
import logging
import os
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import zenoh

from camera_node.foundation.errors import RoundelError, printable
from camera_node.foundation.rate_limit import RateLimit
from camera_node.protocol.requests import RequestSource, payload_of, sender_of

log = logging.getLogger("fusion.audit")
Answer = Callable[[zenoh.Query], bytes]
MAX_ENTRIES = 32  # of each list or map in a request that a line quotes
MAX_TEXT = 64
MAX_SOURCE_TEXT = 200  # of a claimed source in the log
DEPTH = 2  # of a request that a line quotes
MAX_QUOTED = 4000  # bytes of a request in a line
# Of refused requests, which anybody may send: 4 MB a day at 500 bytes, so that the files hold the changes of weeks.
REFUSED_HZ, REFUSED_BURST = 0.1, 20
MAX_BYTES = 10_000_000  # of one file
MAX_OLD = 9  # files before it: `audit.jsonl.1` is the newest of them


class AuditLog:
    """Notes every request for a change: what, when, from whom, and whether it was done.

    Refused requests are noted at a bounded rate; the next one that is noted tells how many were not.

    Proven is what Zenoh knows of a connection: its address, and with TLS the name in the client's certificate. Claimed
    is what a request says of itself: the session that sent it and its `source`. Without access rights anybody can claim
    anything; with them only sessions with the right to change have requests that arrive here.

    Args:
        path: the file to append to, one JSON object a line, with older ones beside it; None for the log only.
        session: the server's, whose connections are known.
    """

    def __init__(self, path: str | None, session: zenoh.Session) -> None:
        self._session = session
        self._file = AuditFile(Path(path)) if path else None
        self._refused, self._omitted = RateLimit(REFUSED_HZ, REFUSED_BURST), 0

    def audited(self, change: str, answer: Answer) -> Answer:
        """An answer to requests that notes each of them as `change`."""

        def answer_and_note(query: zenoh.Query) -> bytes:
            try:
                reply = answer(query)
            except RoundelError as error:
                self._note_refusal(change, query, error)
                raise
            self._note(change, query, "done")
            return reply

        return answer_and_note

    def _note_refusal(self, change: str, query: zenoh.Query, error: RoundelError) -> None:
        if not self._refused.passes():
            self._omitted += 1
            return
        self._note(change, query, f"refused: {error}", self._omitted)
        self._omitted = 0

    def _note(self, change: str, query: zenoh.Query, outcome: str, omitted: int = 0) -> None:
        sender, request = sender_of(query), quote(payload_of(query))
        link = next((link for link in self._session.info.links() if str(link.zid) == sender), None)
        source = request.pop("source", None) if isinstance(request, dict) else None
        if len(msgspec.json.encode(request)) > MAX_QUOTED:
            request = "too long to be quoted"
        entry = {
            "time": datetime.now(UTC).isoformat(timespec="milliseconds"),
            "change": change,
            "outcome": outcome[:500],
            "refused_before": omitted,
            "request": request,
            "certificate": link.auth_identifier if link else None,
            "address": str(link.dst) if link else None,
            "claimed_session": sender or None,
            "claimed_source": source,
        }
        proven = entry["certificate"] or entry["address"] or "an unknown session"
        claimed = _describe_source(source) or sender or "unknown"
        log.info("%s by %s (claims to be %s): %s", change, proven, claimed, outcome)
        self._append(msgspec.json.encode(entry))

    def _append(self, line: bytes) -> None:
        """Append a line and force it to the disk. A fault of the disk is logged; the change stays."""
        if self._file is None:
            return
        try:
            self._file.append(line)
        except OSError as error:
            log.warning("the audit file %s can't be written: %s", self._file.path, error.strerror)


def _describe_source(source: Any) -> str:
    """The claimed source of a request in words; empty where it is none."""
    try:
        return printable(msgspec.convert(source, RequestSource), MAX_SOURCE_TEXT)
    except msgspec.ValidationError:
        return ""


def quote(payload: bytes) -> Any:
    """The outline of a request in MessagePack or JSON: names and short values, without columns of numbers."""
    try:
        is_json = payload.lstrip()[:1] == b"{"
        return _outline(
            msgspec.json.decode(payload) if is_json else msgspec.msgpack.decode(payload or b"\x80"), DEPTH
        )
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return f"{len(payload)} bytes that are no request"


def _outline(value: Any, depth: int) -> Any:
    if isinstance(value, dict) and depth:
        return {str(k)[:MAX_TEXT]: _outline(v, depth - 1) for k, v in list(value.items())[:MAX_ENTRIES]}
    if isinstance(value, dict | list):
        return [str(entry)[:MAX_TEXT] for entry in list(value)[:MAX_ENTRIES]]
    return value[:MAX_TEXT] if isinstance(value, str) else value if isinstance(value, int | float) else None


class AuditFile:
    """Appends lines and forces them to the disk.

    A file that would exceed `max_bytes` becomes `<name>.1`, that one `<name>.2` and so on.

    Args:
        path: of the present file.
        max_bytes: of each file; a longer line has a file of its own.

    Attributes:
        path: as given.

    All methods raise OSError if the disk refuses.
    """

    def __init__(self, path: Path, max_bytes: int = MAX_BYTES) -> None:
        self.path, self._max_bytes = path, max_bytes

    def append(self, line: bytes) -> None:
        """Append a line without its line feed, and force it to the disk."""
        line += b"\n"
        with contextlib.suppress(FileNotFoundError):
            if self.path.stat().st_size + len(line) > self._max_bytes:
                self._rotate()
        handle = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o640)
        try:
            os.write(handle, line)
            os.fsync(handle)
        finally:
            os.close(handle)

    def _rotate(self) -> None:
        """Renaming replaces the oldest file; each step is atomic."""
        for number in range(MAX_OLD, 0, -1):
            with contextlib.suppress(FileNotFoundError):
                os.replace(self._old(number - 1), self._old(number))

    def _old(self, number: int) -> Path:
        return self.path.with_name(f"{self.path.name}.{number}") if number else self.path
