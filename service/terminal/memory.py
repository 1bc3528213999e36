"""Settings of a process's memory allocator and garbage collector."""

import ctypes
import gc

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8  # of malloc.h
_KEPT_BYTES, _LARGE_BYTES = 64 << 20, 32 << 20


def prepare_memory() -> None:
    """Configure glibc's allocator for numerics in many threads.

    All threads share two arenas. By default, glibc creates up to eight arenas per core, and each keeps its peak memory:
    after hundreds of thousands of messages of all sizes, the monitor held twice the memory that it used.

    Memory freed by a hop is kept for the next. By default, glibc returns arrays of more than 128 kB to the kernel, and
    obtaining them again, page by page, took longer than the arithmetic of a hop.
    """
    library = ctypes.CDLL(None)
    if hasattr(library, "mallopt"):  # not in every C library
        library.mallopt(_M_ARENA_MAX, 2)
        library.mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES)
        library.mallopt(_M_MMAP_THRESHOLD, _LARGE_BYTES)


def keep_loaded() -> None:
    """Exclude all objects loaded so far, which live until the process ends, from garbage collection.

    A full collection traversed all of them, which stopped all threads for a tenth of a second, and each answer of
    twenty thousand records made one likely.
    """
    gc.collect()
    gc.freeze()
