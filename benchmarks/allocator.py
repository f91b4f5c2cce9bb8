"""The C library's allocator, which decides who pays for fresh pages of memory."""

from __future__ import annotations

import ctypes
import platform

#: Of mallopt, from glibc's malloc.h.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_NEVER = 2**30


def keep_freed_blocks() -> str:
    """Have the process keep what it frees, where it can, and say which it is.

    A large block that went back to the system comes anew page by page, which takes longer than
    many a layer. Which call that hits depends on what the calls before it freed, so that a ratio
    would tell of the order of the candidates.
    """
    if platform.libc_ver()[0] != "glibc":
        return "the system's own ways"
    mallopt = ctypes.CDLL(None).mallopt
    kept = mallopt(_M_MMAP_THRESHOLD, _NEVER) and mallopt(_M_TRIM_THRESHOLD, _NEVER)
    return "glibc, freed blocks are kept" if kept else "glibc, freed blocks may go back"
