"""Machines of several kinds for benchmarks of the whole service: files, bundles, and simulated streams."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

import models
from models.machine import Machine, MachineFile, load_machine_file
from models.signals.block import SampleBlock
from simulator.scenario import load_scenario
from simulator.stream import blocks

_TILT = """
[[sensors]]
name = "{name}"
quantity = "{quantity}"
location = "disc"
direction = "{direction}"
unit = "rad{per_s}"
"""
_WATCHED = """
[[sensors]]
name = "a{number}"
quantity = "acceleration"
location = "place {number}"
direction = "y"
unit = "m/s2"
"""
_KIT = 9  # channels of the rotor kit including the shaft angle; four tilt channels can be added


def rotor_kit(rate_hz: float = 2000.0, hop_s: float = 5.0, *, tilt: bool = False) -> str:
    """Text of the shipped rotor kit's machine file with the given rate and hop, and optionally four tilt channels."""
    shipped = Path(models.__file__).parent / "machines" / "lab.toml"
    text = shipped.read_text(encoding="utf-8")
    text = text.replace("rate_hz = 2000.0", f"rate_hz = {rate_hz}").replace("hop_s = 5.0", f"hop_s = {hop_s}")
    for quantity, per_s in (("tilt", ""), ("tilt_rate", "/s")) if tilt else ():
        for direction in "yz":
            name = f"{quantity}-{direction}"
            text += _TILT.format(name=name, quantity=quantity, direction=direction, per_s=per_s)
    return text


@dataclass(frozen=True, slots=True)
class MachineKind:
    """A kind of machine: number of channels, rate, and how it is evaluated."""

    channels: int = _KIT
    rate_hz: float = 2000.0
    hop_s: float = 5.0
    diagnosed: bool = True  # a rotor kit with known parameters; otherwise only levels are watched
    networks: bool = True  # the shipped networks, which are for the rotor kit at 2 kHz with hops of 5 s

    @property
    def fields(self) -> dict[str, Any]:
        """All fields by name."""
        return asdict(self)

    @property
    def bundle(self) -> dict[str, str]:
        """Entry of the settings that names the networks; empty without them."""
        return {"bundle": "lab"} if self.networks else {}

    def text(self) -> str:
        """Machine file of ``demo/lab``."""
        if self.diagnosed:
            if self.channels not in {_KIT, _KIT + 4}:
                raise SystemExit(f"a rotor kit has {_KIT} channels, or {_KIT + 4}, not {self.channels}")
            return rotor_kit(self.rate_hz, self.hop_s, tilt=self.channels > _KIT)
        heading = f'site = "demo"\nname = "lab"\nrate_hz = {self.rate_hz}\n\n[window]\nhop_s = {self.hop_s}\n'
        return heading + "".join(_WATCHED.format(number=number) for number in range(self.channels))

    def machine(self, folder: Path, name: str) -> MachineFile:
        """Write the file of a machine of this kind to the folder, and load it."""
        file = folder / f"{name}.toml"
        file.write_text(self.text().replace('name = "lab"', f'name = "{name}"', 1), encoding="utf-8")
        return load_machine_file(str(file))

    def stream(self, folder: Path, seed: int, length_s: float, block_s: float) -> list[SampleBlock]:
        """Blocks of one machine from time 0 on: a simulated rotor kit, or noise if only levels are watched."""
        if self.diagnosed:
            scenario, _ = load_scenario("healthy")
            given, machine = scenario.overridden(seed=seed, duration_s=length_s), self.machine(folder, "lab")
            assert isinstance(machine, Machine)  # noqa: S101  # its file gives all parameters
            return [block for block, _ in blocks(given, machine, block_s, start_ns=0)]
        rng, size = np.random.default_rng(seed), (round(self.rate_hz * block_s), self.channels)
        return [
            SampleBlock(
                start_ns=round(number * block_s * 1e9),
                sequence=number,
                run=1,
                rate_hz=self.rate_hz,
                samples=rng.standard_normal(size, np.float32),
            )
            for number in range(round(length_s / block_s))
        ]
