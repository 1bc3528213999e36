"""State of the sequential test from hop to hop, and its conversion to named arrays and back."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from models.checkpoint import checked
from models.diagnosis.verdict.stretch import Stretch
from models.errors import CheckpointError
from models.physics.rotor import PARAMETER_TEXT, PARAMETERS
from rotorwatch.records.windows import Finding

_LOWER = np.tril_indices(len(PARAMETERS))  # elements of an information matrix that are remembered: it is symmetric
_NO_LIMITS = (1, 0)  # for a date that has none
_DATES = ("change_ns", "dated_ns", "outside_ns")


@dataclass(slots=True)
class SequentialState:
    """All that the test remembers."""

    # Latest stretches of one window (key 1) and sums of 2, 4, … windows from which longer sums may be made, oldest
    # first.
    sums: dict[int, list[Stretch]] = field(default_factory=dict)
    change_ns: int | None = None  # data before this belongs to another condition of the machine
    # Values of `PARAMETERS` in that condition, in the scale of their errors.
    before: tuple[float, ...] = (0.0,) * len(PARAMETERS)
    findings: tuple[Finding, ...] = ()  # what has been found and still holds
    dated_ns: int | None = None  # end of the stretch that showed the latest change: the change had come by then
    outside_ns: int | None = None  # end of the first stretch outside the model, if it has been outside ever since

    def checkpoint(self) -> dict[str, np.ndarray]:
        """Everything but the sums, which are in `hops`, as named arrays."""
        dates = zip(_DATES, (self.change_ns, self.dated_ns, self.outside_ns), strict=True)
        rows = [(PARAMETERS.index(one.name), one.since_ns, one.found_ns) for one in self.findings]
        between = [one.between_ns or _NO_LIMITS for one in self.findings]
        oldest = [(windows, ring[0].end_ns) for windows, ring in self.sums.items() if ring]
        return {
            **{name: np.array([] if at is None else [at], dtype=np.int64) for name, at in dates},
            "before": np.array(self.before, dtype=np.float64),
            "between_ns": np.array(between, dtype=np.int64).reshape(-1, 2),
            "findings": np.array(rows, dtype=np.int64).reshape(-1, 3),
            "finding_stretch_s": np.array([one.stretch_s for one in self.findings], dtype=np.float64),
            "oldest": np.array(oldest, dtype=np.int64).reshape(-1, 2),
        }

    def hops(self) -> dict[int, list[tuple[int, Stretch]]]:
        """What each hop, by its end, has added to `sums`: number of windows and stretch. Past hops do not change."""
        found: dict[int, list[tuple[int, Stretch]]] = {}
        for windows, ring in self.sums.items():
            for one in ring:
                found.setdefault(one.end_ns, []).append((windows, one))
        return found

    @classmethod
    def restored(
        cls, arrays: Mapping[str, np.ndarray], hops: Iterable[Mapping[str, np.ndarray]] = ()
    ) -> "SequentialState":
        """State from what `checkpoint` returned, and the `hops`, oldest first, as `hop_arrays` returned them."""
        state = cls(before=tuple(checked(arrays, "before", np.float64, (len(PARAMETERS),)).tolist()))
        findings = checked(arrays, "findings", np.int64, (None, 3))
        lengths = checked(arrays, "finding_stretch_s", np.float64, (len(findings),))
        if np.any((findings[:, 0] < 0) | (findings[:, 0] >= len(PARAMETERS))):
            raise CheckpointError(f"findings are of parameters {findings[:, 0].tolist()}, there are {len(PARAMETERS)}")
        # Checkpoints of earlier versions lack these.
        never = np.zeros(0, np.int64)
        between = np.tile(_NO_LIMITS, (len(findings), 1))
        added = {"dated_ns": never, "outside_ns": never, "between_ns": between, **arrays}
        state.change_ns, state.dated_ns, state.outside_ns = (
            next(iter(checked(added, name, np.int64, (None,)).tolist()), None) for name in _DATES
        )
        between = checked(added, "between_ns", np.int64, (len(findings), 2))
        state.findings = tuple(
            finding(PARAMETERS[number], since, found, length, (low, high) if low <= high else None)
            for (number, since, found), length, (low, high) in zip(
                findings.tolist(), lengths.tolist(), between.tolist(), strict=True
            )
        )
        oldest: dict[int, int] = dict(checked(arrays, "oldest", np.int64, (None, 2)).tolist())
        state.sums = {windows: [] for windows in oldest}
        for hop in hops:
            for windows, one in _restored_hop(hop):
                if windows in oldest and one.end_ns >= oldest[windows]:
                    state.sums[windows].append(one)
        for windows, end_ns in oldest.items():
            if not state.sums[windows] or state.sums[windows][0].end_ns != end_ns:
                raise CheckpointError(f"the sum of {windows} windows up to end_ns {end_ns} is missing")
        return state


def hop_arrays(came: Sequence[tuple[int, Stretch]]) -> dict[str, np.ndarray]:
    """One of `SequentialState.hops` as named arrays."""
    n, stretches = len(PARAMETERS), [one for _, one in came]
    shared = [one.common for one in stretches if one.common is not None]
    return {
        "times": np.array([(windows, one.start_ns, one.end_ns) for windows, one in came], dtype=np.int64),
        "has": np.array([(one.misfit_z is not None, one.common is not None) for one in stretches]),
        "vector": np.array([one.vector for one in stretches]),
        "information": np.array([one.information[_LOWER] for one in stretches]),
        "misfit_z": np.array([one.misfit_z for one in stretches if one.misfit_z is not None], dtype=np.float64),
        "common": np.array(shared, dtype=np.float64).reshape(-1, n, n),
    }


def _restored_hop(arrays: Mapping[str, np.ndarray]) -> list[tuple[int, Stretch]]:
    n = len(PARAMETERS)
    times = checked(arrays, "times", np.int64, (None, 3))
    has = checked(arrays, "has", np.bool_, (len(times), 2))
    vectors = checked(arrays, "vector", np.float64, (len(times), n))
    lower = checked(arrays, "information", np.float64, (len(times), _LOWER[0].size))
    information = np.zeros((len(times), n, n))
    information[:, _LOWER[0], _LOWER[1]] = information[:, _LOWER[1], _LOWER[0]] = lower
    n_misfits, n_shared = np.count_nonzero(has, axis=0).tolist()
    misfits = iter(checked(arrays, "misfit_z", np.float64, (n_misfits,)).tolist())
    shared = iter(checked(arrays, "common", np.float64, (n_shared, n, n)))
    found = []
    for at, (windows, start_ns, end_ns) in enumerate(times.tolist()):
        has_misfit, has_common = has[at]
        misfit_z, common = next(misfits) if has_misfit else None, next(shared) if has_common else None
        found.append((windows, Stretch(start_ns, end_ns, vectors[at], information[at], misfit_z, common)))
    return found


def finding(  # what a record holds
    name: str, since_ns: int, found_ns: int, stretch_s: float, between_ns: tuple[int, int] | None = None
) -> Finding:
    """A parameter that changed, and the stretch that found it first; see `Finding`."""
    text = PARAMETER_TEXT[name]
    return Finding(
        name=name, text=text, since_ns=since_ns, between_ns=between_ns, found_ns=found_ns, stretch_s=stretch_s
    )
