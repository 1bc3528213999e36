"""Truth records: what the simulator really did to the machine, beside the samples that show it."""

from pydantic import BaseModel, ConfigDict, Field

from simulator.scenario import NamedSource

__all__ = ["TruthRecord"]


class TruthRecord(BaseModel):
    """The true condition from one time on; sent at the start, at every change, and every second during a ramp."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    time_ns: int = Field(description="acquisition time of the first sample this is true for, ns since 1970 UTC")
    data_s: float = Field(description="the same, seconds from the first sample")
    run: int
    machine: str
    scenario: str
    seed: int
    relative_changes: dict[str, float] = Field(description="every parameter's change from the original machine")
    speed_rpm: float
    sources: tuple[NamedSource, ...]
    excitation_level: float = Field(default=1.0, description="factor on the white noise that drives all sources")
    anomalies: dict[str, float] = Field(default={}, description="size of a crack, a rub, added mass; absent if none")
    sensor_faults: dict[str, dict[str, float | None]] = Field(
        description="by channel the active faults and their values, null where the kind has none"
    )
    ramping: tuple[str, ...] = Field(
        description="what is still on its way: parameters, sources, sensors, anomalies, 'speed', …"
    )

    @property
    def text(self) -> str:
        """One short line for a progress display.

        Examples
        --------
        >>> TruthRecord(time_ns=0, data_s=0, run=1, machine="lab", scenario="s", seed=1, speed_rpm=1320, sources=(),
        ...             relative_changes={"k_by": -0.2}, sensor_faults={}, ramping=()).text
        'k_by -20 %'
        """
        parts = [f"{name} {change:+.3g} %" for name, change in self._percent() if change]
        parts += [f"{kind.replace('_', ' ')} {100 * size:.3g} %" for kind, size in self.anomalies.items()]
        parts += [f"{channel} {'+'.join(faults)}" for channel, faults in self.sensor_faults.items()]
        return ", ".join(parts) or "no fault"

    def _percent(self) -> list[tuple[str, float]]:
        return [(name, round(100 * change, 6)) for name, change in self.relative_changes.items()]
