"""The state of a monitor, divided so that little of it is written with every hop.

::

    arrays -- small ------------> state, written with every hop
           '- 4 kB and more ----> parts, named by a digest of their content: most stay the same for many hops
    hops of the sequential test -> parts, each named by the hop's end: none changes afterwards
"""

import hashlib
from collections.abc import Collection, Iterable, Mapping
from operator import itemgetter

import numpy as np

from models.checkpoint import from_bytes, prefixed, to_bytes, unprefixed
from models.diagnosis.verdict.sequential_state import hop_arrays
from models.diagnosis.verdict.stretch import Stretch

_HOP = "hop "
_LARGE = 4096


def divided(
    arrays: Mapping[str, np.ndarray], hops: Mapping[int, list[tuple[int, Stretch]]], kept: Collection[str]
) -> tuple[bytes, tuple[tuple[str, bytes], ...], tuple[str, ...]]:
    """State, new parts (not in `kept`) by name, and the names of all parts; the hops are `SequentialState.hops`."""
    large = {name: array for name, array in arrays.items() if array.nbytes >= _LARGE}
    names = {f"{_HOP}{end_ns:019}": came for end_ns, came in hops.items()}
    known = frozenset(kept)
    parts = {f"{name} {_digest(array)}": {name: array} for name, array in large.items()}
    parts |= {name: prefixed(name, hop_arrays(came)) for name, came in names.items() if name not in known}
    return (
        to_bytes({name: array for name, array in arrays.items() if name not in large}),
        tuple((name, to_bytes(part)) for name, part in parts.items() if name not in known),
        (*parts, *(name for name in names if name in known)),
    )


def joined(state: bytes, parts: Iterable[bytes]) -> tuple[dict[str, np.ndarray], list[dict[str, np.ndarray]]]:
    """Arrays of the monitor, and arrays of each hop of the sequential test, oldest first.

    Raises
    ------
    CheckpointError
        As `from_bytes`.
    """
    arrays, hops = from_bytes(state), []
    for part in map(from_bytes, parts):
        name = next(iter(part), "")
        if name.startswith(_HOP):
            hops.append((name, unprefixed(name.partition("/")[0], part)))
        else:
            arrays |= part
    return arrays, [hop for _, hop in sorted(hops, key=itemgetter(0))]


def _digest(array: np.ndarray) -> str:
    form = str(array.shape).encode()[:16]
    return hashlib.blake2b(np.ascontiguousarray(array).data, digest_size=8, person=form).hexdigest()
