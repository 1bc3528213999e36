"""How the memory of a process is handed out, and looked through."""

import ctypes
import gc

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8  # of malloc.h
_KEPT_BYTES, _LARGE_BYTES = 64 << 20, 32 << 20


def prepare_memory() -> None:
    """Settings for numerics in many threads.

    Two arenas of the C library's memory for all threads: by default glibc gives each thread of up to eight per core one
    of its own, and each keeps what it once needed. After hundreds of thousands of messages of all sizes the monitor
    held twice the memory that it used.

    What a hop has freed is kept for the next one: by default glibc hands arrays of more than 128 kB back to the kernel,
    and getting them again, page by page, took longer than the arithmetic of a hop.
    """
    library = ctypes.CDLL(None)
    if hasattr(library, "mallopt"):  # not everywhere
        library.mallopt(_M_ARENA_MAX, 2)
        library.mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES)
        library.mallopt(_M_MMAP_THRESHOLD, _LARGE_BYTES)


def keep_loaded() -> None:
    """Spare the garbage collector what a process has loaded by now, which stays to its end.

    A full collection looked through all of it, a tenth of a second in which no thread runs, and each answer of twenty
    thousand records made one likely.
    """
    gc.collect()
    gc.freeze()
