"""Run a program that dies as soon as it, a process below it or a native library asks for a network (Linux).

    python quiet_process.py closed|serving PROGRAM ARGUMENTS

closed: any socket but those between processes of this machine (AF_UNIX) ends it by SIGSYS. serving: it may listen and
answer, but not connect. A filter of system calls (seccomp) needs neither rights nor tools, and what it refuses is seen.
"""

from __future__ import annotations

import ctypes
import os
import platform
import struct
import sys

# By machine: the kernel's name for it, and its numbers of socket and connect.
_NUMBERS = {"x86_64": (0xC000003E, 41, 42), "aarch64": (0xC00000B7, 198, 203)}
_LOAD, _AND, _EQUAL, _RETURN = 0x20, 0x54, 0x15, 0x06
_NUMBER_AT, _MACHINE_AT, _FAMILY_AT, _TYPE_AT = 0, 4, 16, 24  # in what a filter is given of a call
_ALLOW, _KILL = 0x7FFF0000, 0x80000000
_NO_NEW_RIGHTS, _SECCOMP, _FILTER = 38, 22, 2  # for prctl
_UNIX, _STREAM = 1, 1

HAS_GUARD = sys.platform == "linux" and platform.machine() in _NUMBERS


def _program(serving: bool) -> bytes:
    """Return the filter: operation, steps to go where true, where false, value."""
    machine, socket, connect = _NUMBERS[platform.machine()]
    steps = [
        (_LOAD, 0, 0, _MACHINE_AT),
        (_EQUAL, 0, 8, machine),
        (_LOAD, 0, 0, _NUMBER_AT),
        (_EQUAL, 7 if serving else 6, 0, connect),
        (_EQUAL, 0, 5, socket),
        (_LOAD, 0, 0, _FAMILY_AT),
        (_EQUAL, 3, 0, _UNIX),
        (_LOAD, 0, 0, _TYPE_AT),
        (_AND, 0, 0, 0xF),
        (_EQUAL, 0 if serving else 1, 1, _STREAM),
        (_RETURN, 0, 0, _ALLOW),
        (_RETURN, 0, 0, _KILL),
    ]
    return b"".join(struct.pack("HBBI", *step) for step in steps)


def close_the_network(serving: bool) -> None:
    """Refuse sockets to this process and to all that it starts, for ever; raises `OSError`."""
    program = _program(serving)
    content = ctypes.create_string_buffer(program, len(program))
    described = struct.pack("HP", len(program) // 8, ctypes.addressof(content))
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_NO_NEW_RIGHTS, 1, 0, 0, 0) or libc.prctl(_SECCOMP, _FILTER, described, 0, 0):
        raise OSError(ctypes.get_errno(), "the kernel takes no filter of system calls")


if __name__ == "__main__":
    close_the_network(sys.argv[1] == "serving")
    os.execvp(sys.argv[2], sys.argv[2:])
