# SPDX-License-Identifier: BSD-3-Clause
"""Runs a program under the system call filter and the limits of a service file, as systemd would:

python tests/seccomp.py configs/systemd/roundel-fusion.service python -m fusion --config arena.yaml
"""

import ctypes
import errno
import os
import re
import resource
import struct
import subprocess
import sys
from pathlib import Path

HEADER = Path("/usr/include/x86_64-linux-gnu/asm/unistd_64.h")  # numbers of the system calls
PR_SET_NO_NEW_PRIVS, PR_SET_SECCOMP, SECCOMP_MODE_FILTER = 38, 22, 2
LOAD, JUMP_IF_EQUAL, RETURN = 0x20, 0x15, 0x06  # BPF: load a word, compare with a constant, return a constant
ALLOW, ERROR = 0x7FFF0000, 0x00050000 | errno.EPERM  # verdicts; the second is SystemCallErrorNumber=EPERM


def members(group: str) -> set[str]:
    """The system calls of a group such as @system-service."""
    text = subprocess.run(
        ["systemd-analyze", "syscall-filter", group], capture_output=True, text=True, check=True
    )
    names = {line.strip() for line in text.stdout.splitlines()[1:] if line.strip() and "#" not in line}
    return {name for entry in names for name in (members(entry) if entry.startswith("@") else {entry})}


def allowed(unit: Path) -> set[str]:
    """The system calls that the SystemCallFilter lines of a service file allow."""
    names: set[str] = set()
    for value in re.findall(r"(?m)^SystemCallFilter=(.*)$", unit.read_text()):
        listed = {name for group in value.lstrip("~").split() for name in members(group)}
        names = names - listed if value.startswith("~") else names | listed
    return names


def install_filter(names: set[str]) -> None:
    """Refuse all other system calls of this process and its children with EPERM."""
    numbers = dict(re.findall(r"(?m)^#define __NR_(\w+) (\d+)$", HEADER.read_text()))
    known = sorted(int(numbers[name]) for name in names & numbers.keys())
    program = [struct.pack("<HBBI", LOAD, 0, 0, 0)]  # seccomp_data.nr
    for number in known:
        program += [
            struct.pack("<HBBI", JUMP_IF_EQUAL, 0, 1, number),
            struct.pack("<HBBI", RETURN, 0, 0, ALLOW),
        ]
    program.append(struct.pack("<HBBI", RETURN, 0, 0, ERROR))
    code = ctypes.create_string_buffer(b"".join(program))
    header = ctypes.create_string_buffer(struct.pack("<HxxxxxxQ", len(program), ctypes.addressof(code)))
    libc = ctypes.CDLL(None, use_errno=True)
    for arguments in ((PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0), (PR_SET_SECCOMP, SECCOMP_MODE_FILTER, header, 0, 0)):
        if libc.prctl(*arguments) != 0:
            raise OSError(ctypes.get_errno(), "prctl")


def main() -> None:
    """Apply the filter and the memory limit of a service file, then execute the program."""
    unit = Path(sys.argv[1])
    names = allowed(unit) | {"execve"}
    if match := re.search(r"(?m)^MemoryMax=(\d+)G$", unit.read_text()):
        limit = int(match[1]) << 30
        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    install_filter(names)
    os.execvp(sys.argv[2], sys.argv[2:])


if __name__ == "__main__":
    main()
