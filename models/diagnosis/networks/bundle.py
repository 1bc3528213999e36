"""The trained bundle: a manifest (JSON) and weights (safetensors) in one directory, without code or pickle.

::

    lab/
    ├── manifest.json        machine, equations, units, seeds, versions, healthy spread, hash of the weights
    └── weights.safetensors  relation networks, float64: 28.input_scale, 28.W1, …
                             amortised networks, float32: basis.mean, …, amortised.28.W1, …;
                             amortised networks of the second reading: near.basis.mean, …

Loading refuses a bundle that is damaged or was trained for another machine, and says what differs.
"""

import hashlib
import json
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal
from weakref import WeakValueDictionary

import numpy as np
from pydantic import BaseModel, Field, ValidationError
from safetensors import SafetensorError
from safetensors.numpy import load, save

from models.diagnosis.networks.amortised import (
    LAYERS,
    NEAR,
    OWN,
    AmortisedNetwork,
    AmortisedNetworks,
    Calibration,
    NearNetworks,
)
from models.diagnosis.networks.features import FeatureBasis
from models.diagnosis.networks.relation import HIDDEN, EquationNetwork, Healthy, Network, equation_by_number
from models.errors import BundleError
from models.machine import Machine
from models.mistakes import did_you_mean, mistakes

MANIFEST = "manifest.json"
SHIPPED_BUNDLES = Path(__file__).parents[2] / "bundles"
_Array = np.ndarray[Any, np.dtype[Any]]
_Arrays = dict[str, _Array]
_FORMAT = 2
_PHYSICS = {"rotor", "operation", "condition", "rate_hz", "window"}
# By hash of the file and name of the array: machines with the same bundle share its weights while any of them uses it.
_shared: WeakValueDictionary[tuple[str, str], _Array] = WeakValueDictionary()


class EquationEntry(BaseModel, extra="forbid", frozen=True):
    """One equation of the bundle."""

    number: str
    channels: tuple[str, ...] = Field(description="measured states in order, references first")
    units: Literal["SI"] = Field(default="SI", description="units of the channels")
    inputs: tuple[str, ...] = Field(description="inputs in order, divided by the rms of the target")
    parameters: tuple[str, ...]
    hidden: int
    healthy: Healthy


class AmortisedEntry(BaseModel, extra="forbid", frozen=True):
    """The amortised networks, see `models.diagnosis.networks.amortised.AmortisedNetworks`."""

    channels: tuple[str, ...] = Field(min_length=1, description="measured states in order")
    units: Literal["SI"] = Field(default="SI", description="units of the channels")
    equations: tuple[Literal["28", "29", "30", "31"], ...]
    layers: tuple[int, ...]
    calibration: dict[str, Calibration]
    coherent: dict[str, Calibration] = Field(default={}, description="where the forces are coherent; empty: same")
    coherence_limit: float = Field(default=1.0, ge=0, le=1, description="mean squared coherence beyond which they are")
    calibration_windows: int = Field(ge=1)
    novelty_limit: float = Field(gt=0, allow_inf_nan=False)
    log_range: float = Field(gt=0, allow_inf_nan=False)
    # Not stored if None, so that bundles with one reading keep their identity.
    near: dict[str, float] | None = Field(
        default=None,
        exclude_if=lambda value: value is None,
        description="largest remainders that a second reading was trained for; none: there is no second reading",
    )


class Training(BaseModel, extra="forbid", frozen=True):
    """Everything needed to train the bundle again."""

    seed: int
    training_windows: int
    calibration_windows: int
    network_calibration_windows: int = Field(default=0, description="the same for the amortised networks")
    drawn_conditions: int = Field(
        default=0, description="random machines and conditions of each reading of the amortised ones"
    )
    versions: dict[str, str]


class Manifest(BaseModel, extra="forbid", frozen=True):
    """Description of a bundle."""

    format: int
    machine: str
    physics: dict[str, Any] = Field(description="rotor, operation, condition, rate and window it was trained for")
    equations: tuple[EquationEntry, ...]
    amortised: AmortisedEntry | None = None
    training: Training
    weights_sha256: str


@dataclass(frozen=True, slots=True)
class Bundle:
    """Trained networks of one machine."""

    manifest: Manifest
    networks: tuple[EquationNetwork, ...]  # relation networks in the order of the equation table
    amortised: AmortisedNetworks | None = None

    @property
    def identity(self) -> str:
        """Twelve hexadecimal digits that change with anything in the bundle."""
        return hashlib.sha256(_canonical(self.manifest)).hexdigest()[:12]


def _canonical(manifest: Manifest) -> bytes:
    return json.dumps(manifest.model_dump(mode="json"), sort_keys=True, indent=1).encode()


def _physics(machine: Machine) -> dict[str, Any]:
    return machine.model_dump(mode="json", include=_PHYSICS)


def save_bundle(
    directory: Path,
    machine: Machine,
    networks: tuple[EquationNetwork, ...],
    training: Training,
    amortised: AmortisedNetworks | None = None,
) -> Bundle:
    """Write a bundle.

    Raises
    ------
    BundleError
        If a network is not calibrated or the directory cannot be written.
    """
    arrays: _Arrays = {}
    entries = []
    for trained in networks:
        number, healthy = trained.equation.number, trained.healthy
        if healthy is None:
            raise BundleError(f"{directory}: equation {number} has no healthy spread: calibrate it before saving")
        arrays |= _fields(trained.network, f"{number}.")
        entries.append(
            EquationEntry(
                number=number,
                channels=trained.equation.channels,
                inputs=trained.equation.input_names,
                parameters=trained.equation.parameters,
                hidden=HIDDEN,
                healthy=healthy,
            )
        )
    entry = None
    if amortised is not None:
        if set(amortised.calibration) != {name for network in amortised.networks for name in OWN[network.equation]}:
            raise BundleError(f"{directory}: the amortised networks are not calibrated: calibrate them before saving")
        arrays |= _amortised_arrays(amortised)
        if amortised.near is not None:
            arrays |= _amortised_arrays(amortised.near, "near.")
        entry = _amortised_entry(amortised, training)
    weights = save(arrays)
    manifest = Manifest(
        format=_FORMAT,
        machine=machine.name,
        physics=_physics(machine),
        equations=tuple(entries),
        amortised=entry,
        training=training,
        weights_sha256=hashlib.sha256(weights).hexdigest(),
    )
    try:
        directory.mkdir(parents=True, exist_ok=True)
        (directory / "weights.safetensors").write_bytes(weights)
        (directory / MANIFEST).write_bytes(_canonical(manifest) + b"\n")
    except OSError as error:
        raise BundleError(f"{directory}: cannot be written ({error.strerror})") from error
    return Bundle(manifest, networks, amortised)


def load_bundle(name_or_path: str | Path, machine: Machine) -> Bundle:
    """Load a bundle, shipped (``lab``) or from a directory, and check that it belongs to a machine.

    It must have been trained for the machine's rotor, operation, condition range, rate and window.

    Raises
    ------
    BundleError
        Naming what is missing, damaged, or different, with both values.
    """
    directory = Path(name_or_path)
    if not directory.is_dir() and (SHIPPED_BUNDLES / str(name_or_path)).is_dir():
        directory = SHIPPED_BUNDLES / str(name_or_path)
    try:
        manifest = Manifest.model_validate_json((directory / MANIFEST).read_bytes())
        weights = (directory / "weights.safetensors").read_bytes()
    except OSError as error:
        if directory.is_dir() and not isinstance(error, FileNotFoundError):
            raise BundleError(f"{error.filename}: cannot be read ({error.strerror})") from error
        shipped = sorted(entry.name for entry in SHIPPED_BUNDLES.iterdir() if entry.is_dir())
        why = f"no {Path(error.filename).name} in it" if directory.is_dir() else "there is no such folder"
        raise BundleError(
            f"{directory}: not a bundle, {why}; shipped bundles: {', '.join(shipped)}"
            f"{did_you_mean(directory.name, shipped)}"
        ) from error
    except ValidationError as error:
        told = "; ".join(text for _, text in mistakes(error, Manifest))
        raise BundleError(f"{directory}/manifest.json: damaged, or of another version: {told}") from error
    if manifest.format != _FORMAT:
        raise BundleError(f"{directory}: format is {manifest.format}, this program reads {_FORMAT}")
    digest = hashlib.sha256(weights).hexdigest()
    if digest != manifest.weights_sha256:
        raise BundleError(
            f"{directory}/weights.safetensors: sha256 is {digest[:12]}…, "
            f"the manifest says {manifest.weights_sha256[:12]}…"
        )
    numbers = [entry.number for entry in manifest.equations]
    if len(set(numbers)) < len(numbers):
        raise BundleError(f"{directory}: an equation occurs twice: {', '.join(numbers)}")
    differences = list(_differences(manifest.physics, _physics(machine)))
    if differences:
        raise BundleError(f"{directory}: trained for another machine than {machine.title}: {'; '.join(differences)}")
    try:
        arrays = {name: _shared.setdefault((digest, name), array) for name, array in load(weights).items()}
    except SafetensorError as error:
        raise BundleError(f"{directory}/weights.safetensors: {error}") from error
    for array in arrays.values():
        array.flags.writeable = False
    amortised = None if manifest.amortised is None else _amortised(directory, manifest.amortised, arrays)
    return Bundle(manifest, tuple(_network(directory, entry, arrays) for entry in manifest.equations), amortised)


def _network(directory: Path, entry: EquationEntry, arrays: _Arrays) -> EquationNetwork:
    """One equation's network, checked against this program's equation table."""
    where, healthy = f"{directory}: equation {entry.number}", entry.healthy
    try:
        equation = equation_by_number(entry.number)
    except KeyError:
        raise BundleError(f"{where} is not in this program's table") from None
    checks: tuple[tuple[str, object, object], ...] = (
        ("channels", entry.channels, equation.channels),
        ("inputs", entry.inputs, equation.input_names),
        ("parameters", entry.parameters, equation.parameters),
        ("hidden", entry.hidden, HIDDEN),
        ("lengths of z_scale and spread", (len(healthy.z_scale), len(healthy.spread)), (len(entry.parameters),) * 2),
        *(
            (f"length of {name}", len(values), len(entry.parameters))
            for name in ("floor", "gain", "freedom")
            if (values := getattr(healthy, name))
        ),
    )
    for field, found, expected in checks:
        if found != expected:
            raise BundleError(f"{where}: {field} are {found}, this program expects {expected}")
    n_inputs = len(equation.input_names)
    shapes = {"input_scale": (n_inputs,), "W1": (n_inputs, HIDDEN), "b1": (HIDDEN,), "W2": (HIDDEN,), "b2": (1,)}
    parts = {
        name: _finite(arrays, f"{entry.number}.{name}", np.dtype(np.float64), shape, f"{where}: weight {name}")
        for name, shape in shapes.items()
    }
    if not np.all(parts["input_scale"] > 0):
        raise BundleError(f"{where}: weight input_scale has a value that is not above 0")
    return EquationNetwork(equation, Network(**parts), healthy)


def _finite(arrays: _Arrays, name: str, kind: np.dtype[Any], shape: tuple[int, ...], what: str) -> _Array:
    array = arrays.get(name)
    if array is None or array.shape != shape or array.dtype != kind or not np.isfinite(array).all():
        state = "missing" if array is None else f"{array.dtype}{array.shape}"
        raise BundleError(f"{what} is {state}, expected finite {kind}{shape}")
    return array


def _fields(part: Network | FeatureBasis, prefix: str) -> _Arrays:
    return {f"{prefix}{one.name}": np.ascontiguousarray(getattr(part, one.name)) for one in fields(part)}


def _amortised_arrays(amortised: AmortisedNetworks | NearNetworks, stage: str = "") -> _Arrays:
    arrays = _fields(amortised.basis, f"{stage}basis.")
    for network in amortised.networks:
        where = f"{stage}amortised.{network.equation}"
        for number, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True), start=1):
            arrays[f"{where}.W{number}"], arrays[f"{where}.b{number}"] = weight, bias
        arrays[f"{where}.direct"] = network.direct
    return arrays


def _amortised_entry(amortised: AmortisedNetworks, training: Training) -> AmortisedEntry:
    return AmortisedEntry.model_validate(
        {
            "channels": amortised.states,
            "equations": tuple(network.equation for network in amortised.networks),
            "layers": LAYERS,
            "calibration": amortised.calibration,
            "coherent": amortised.coherent,
            "coherence_limit": amortised.coherence_limit,
            "calibration_windows": training.network_calibration_windows or training.calibration_windows,
            "novelty_limit": amortised.novelty_limit,
            "log_range": amortised.log_range,
            "near": None if amortised.near is None else NEAR,
        }
    )


def _amortised(directory: Path, entry: AmortisedEntry, arrays: _Arrays) -> AmortisedNetworks:
    """The amortised networks, with the shape of every array checked against the others."""
    where = f"{directory}: amortised networks"
    if entry.layers != LAYERS:
        raise BundleError(f"{where}: layers are {entry.layers}, this program expects {LAYERS}")
    parameters = {name for number in entry.equations for name in OWN[number]}
    for calibrated in (entry.calibration, *([entry.coherent] if entry.coherent else [])):
        if set(calibrated) != parameters:
            raise BundleError(f"{where}: calibrated are {sorted(calibrated)}, expected {sorted(parameters)}")
    for name, one in (*entry.calibration.items(), *entry.coherent.items()):
        if len(one.log_deviation) != len(one.z_scale) or list(one.log_deviation) != sorted(one.log_deviation):
            raise BundleError(f"{where}: calibration of {name}: expected ascending log_deviation, one z_scale for each")
    if entry.near not in (None, NEAR):
        raise BundleError(f"{where}: remainders are {entry.near}, this program expects {NEAR}")
    return AmortisedNetworks(
        entry.channels,
        *_stage(where, entry, arrays, ""),
        calibration=entry.calibration,
        novelty_limit=entry.novelty_limit,
        log_range=entry.log_range,
        coherent=entry.coherent,
        coherence_limit=entry.coherence_limit,
        near=None if entry.near is None else NearNetworks(*_stage(where, entry, arrays, "near.")),
    )


def _stage(
    where: str, entry: AmortisedEntry, arrays: _Arrays, stage: str
) -> tuple[FeatureBasis, tuple[AmortisedNetwork, ...]]:
    """Basis and networks of one reading."""
    n_inputs = arrays.get(f"{stage}basis.centre", np.empty(0)).size
    n_common = arrays.get(f"{stage}basis.precision_factor", np.empty((0, 0))).shape[0]
    n_series, n_bins, n_kept = arrays.get(f"{stage}basis.directions", np.empty((0, 0, 0))).shape
    shapes: dict[str, tuple[int, ...]] = {
        "basis.mean": (n_series, 1, n_bins),
        "basis.directions": (n_series, n_bins, n_kept),
        "basis.centre": (n_inputs,),
        "basis.scale": (n_inputs,),
        # Novelty is judged once, before the first reading, so the second basis has no factor.
        "basis.precision_factor": (n_common, 0 if stage else n_common),
    }
    for number in entry.equations:
        own = len(OWN[number])
        first = n_inputs if number == "29" else n_common
        sizes = (first, *LAYERS, 2 * own + own * (own - 1) // 2)
        for layer, (n_in, n_out) in enumerate(pairwise(sizes), start=1):
            shapes[f"amortised.{number}.W{layer}"] = (n_in, n_out)
            shapes[f"amortised.{number}.b{layer}"] = (n_out,)
        shapes[f"amortised.{number}.direct"] = (first, own)
    own_arrays = {
        name: _finite(arrays, f"{stage}{name}", np.dtype(np.float32), shape, f"{where}: {stage}{name}")
        for name, shape in shapes.items()
    }
    basis = FeatureBasis(*(own_arrays[f"basis.{one.name}"] for one in fields(FeatureBasis)))
    layers = range(1, len(LAYERS) + 2)
    return basis, tuple(
        AmortisedNetwork(
            number,
            tuple(own_arrays[f"amortised.{number}.W{layer}"] for layer in layers),
            tuple(own_arrays[f"amortised.{number}.b{layer}"] for layer in layers),
            own_arrays[f"amortised.{number}.direct"],
        )
        for number in entry.equations
    )


def _differences(trained: Any, present: Any, path: str = "") -> list[str]:
    """Fields whose values differ, with both values."""
    if isinstance(trained, dict) and isinstance(present, dict):
        found: list[str] = []
        for key in sorted({*trained, *present}):
            found += _differences(trained.get(key), present.get(key), f"{path}.{key}" if path else str(key))
        return found
    return [] if trained == present else [f"{path} is {present}, trained for {trained}"]
