"""Source: Universal File Format, data set 58 (functions at nodal degrees of freedom), time responses."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from service.interchange.source import Reference, Source, SourceError, Timing, readable

_TIME_RESPONSE = 1
_EVEN = 1e-6


class UniversalSource(Source):
    """A UFF file, read whole. A data set is named by its first line where that is unique, and by number: ``set 1``."""

    kind, package, entry = "UFF", "pyuff", "data set"

    def __init__(self, path: Path) -> None:
        with readable(path, self.kind, self.package):
            import pyuff  # noqa: PLC0415  # an extra

            if not path.is_file():
                raise SourceError(f"{path}: no such file")
            file = pyuff.UFF(str(path))
            numbers = [number for number, kind in enumerate(file.get_set_types()) if kind == 58]
            read = file.read_sets(numbers) if numbers else []
        sets: list[dict[str, Any]] = [read] if isinstance(read, dict) else list(read)
        sets = [found for found in sets if found["func_type"] == _TIME_RESPONSE]
        if not sets:
            raise SourceError(f"{path}: holds no time response (data set 58 with function type 1)")
        titles = [str(found["id1"]).strip() for found in sets]
        self._sets = {f"set {number + 1}": found for number, found in enumerate(sets)}
        for title, found in zip(titles, sets, strict=True):
            if title not in ("", "NONE") and titles.count(title) == 1:
                self._sets.setdefault(title, found)
        super().__init__(path, {name: np.asarray(found["data"]) for name, found in self._sets.items()})

    def timing(self, columns: Sequence[Reference]) -> Timing:
        """Rate from the abscissa's increment, or from its values where the file gives no increment."""
        rates = [self._rate_hz(reference) for reference in columns]
        for reference, rate_hz in zip(columns, rates, strict=True):
            if abs(rate_hz / rates[0] - 1) > _EVEN:
                raise SourceError(
                    f"{self.path}: {reference} has {rate_hz:g} samples per second, {columns[0]} has {rates[0]:g}; "
                    "expected the same"
                )
        return Timing(rate_hz=rates[0] if rates else None)

    def unit(self, column: Reference) -> str:
        """Label of the ordinate's unit."""
        label = str(self._sets[column.column]["ordinate_axis_units_lab"]).strip()
        return "" if label == "NONE" else label

    def _rate_hz(self, reference: Reference) -> float:
        self._column(reference)  # refuses what is not there
        found = self._sets[reference.column]
        step_s = float(found["abscissa_inc"])
        if found["abscissa_spacing"] == 1 and step_s > 0:
            return 1 / step_s
        steps = np.diff(np.asarray(found["x"], dtype=np.float64))
        if steps.size == 0 or steps.min() <= 0 or np.ptp(steps) > _EVEN * steps.mean() + 1e-9:
            raise SourceError(f"{self.path}: {reference} is not sampled evenly, expected one time step throughout")
        return float(1 / steps.mean())
