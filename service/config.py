"""Settings of the monitor: a TOML file, and environment variables over it.

A field is overridden by an environment variable named after its place, with two underscores between the levels:
``ROTORWATCH_HTTP__PORT=9090`` is ``port`` in ``[http]``. Lists and tables are written as JSON:
``ROTORWATCH_MACHINES='[{"file": "lab", "bundle": "lab"}]'``.
"""

import os
from pathlib import Path
from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic_settings import BaseSettings, PydanticBaseSettingsSource, SettingsConfigDict, SettingsError

from models.errors import MachineFileError
from models.machine import Machine, load_machine, read_toml, validation_text
from models.signals.link import LinkSettings

__all__ = [
    "DEFAULT_LISTEN",
    "HistorySettings",
    "HttpSettings",
    "LogSettings",
    "MachineEntry",
    "QueueSettings",
    "ServiceSettings",
    "check_distinct",
    "load_settings",
]

DEFAULT_LISTEN = "tcp/127.0.0.1:7447"

_STRICT = ConfigDict(extra="forbid", frozen=True)
_ENV_PREFIX = "ROTORWATCH_"


class HttpSettings(BaseModel):
    """Where the HTTP API is served."""

    model_config = _STRICT

    host: str = Field(default="127.0.0.1", min_length=1, description="address to listen on; the API has no password")
    port: int = Field(default=8080, ge=0, le=65535, description="TCP port; 0 takes a free one, which is printed")


class MachineEntry(BaseModel):
    """One monitored machine."""

    model_config = _STRICT

    file: str = Field(min_length=1, description="shipped machine by name, or path relative to the settings file")
    bundle: str | None = Field(
        default=None,
        min_length=1,
        description="trained networks: shipped bundle by name, or folder relative to the settings file; without them "
        "the equations are reported as not evaluable",
    )

    def load(self) -> Machine:
        """Load the machine file.

        Raises
        ------
        MachineFileError
            Naming the file, the field and the value found.
        """
        return load_machine(self.file)


class QueueSettings(BaseModel):
    """Blocks of one machine that have arrived and are not evaluated yet.

    With ``when_full = "drop"`` a monitor that cannot keep up loses blocks and counts them; the source is never slowed
    down. With ``"wait"`` it slows the source down instead: right for batch runs, where a publisher sends recorded or
    simulated data as fast as it can, wrong for a live machine, because everything else on the same link waits too.
    """

    model_config = _STRICT

    blocks: int = Field(default=600, ge=1, le=1_000_000, description="most blocks that wait, per machine")
    when_full: Literal["drop", "wait"] = Field(default="drop", description="what happens to a block beyond that")


class HistorySettings(BaseModel):
    """What is kept in memory for the HTTP API, per machine."""

    model_config = _STRICT

    reports: int = Field(
        default=20_000, ge=1, le=10_000_000, description="window reports; about 6 kB each, one per hop"
    )
    alarm_events: int = Field(default=5_000, ge=1, le=10_000_000, description="alarm events")


class LogSettings(BaseModel):
    """What is logged to standard error, and how."""

    model_config = _STRICT

    level: Literal["debug", "info", "warning", "error"] = Field(default="info", description="least serious level shown")
    format: Literal["console", "json"] = Field(default="console", description="for people, or one JSON object a line")


class ServiceSettings(BaseSettings):
    """Everything the monitor can be told; without a file it watches the shipped machine ``lab``."""

    model_config = SettingsConfigDict(
        extra="forbid", frozen=True, env_prefix=_ENV_PREFIX, env_nested_delimiter="__", validate_default=True
    )

    link: LinkSettings = Field(
        default=LinkSettings(listen=(DEFAULT_LISTEN,)),
        description="Zenoh: role and endpoints; loopback only if left out",
    )
    http: HttpSettings = Field(default=HttpSettings(), description="HTTP API")
    machines: tuple[MachineEntry, ...] = Field(
        default=(MachineEntry(file="lab", bundle="lab"),), min_length=1, description="machines to monitor"
    )
    queue: QueueSettings = Field(default=QueueSettings(), description="blocks that wait for evaluation")
    history: HistorySettings = Field(default=HistorySettings(), description="what is kept for the HTTP API")
    log: LogSettings = Field(default=LogSettings(), description="log")

    @model_validator(mode="after")
    def _reachable(self) -> Self:
        if not self.link.listen and not self.link.connect:
            raise ValueError("link has neither listen nor connect: no stream could reach the monitor")
        return self

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Environment over file; the file's fields arrive as arguments of the constructor."""
        _ = settings_cls, dotenv_settings, file_secret_settings
        return env_settings, init_settings


def load_settings(path: Path | None = None) -> ServiceSettings:
    """Load the settings file, with the environment over it.

    Parameters
    ----------
    path : Path, optional
        TOML file; without one, the defaults.

    Returns
    -------
    ServiceSettings
        Paths of machine files and bundles are resolved against the folder of the settings file.

    Raises
    ------
    MachineFileError
        Naming the file or environment variable, the field and the value found, one fault per line.
    """
    fields = {} if path is None else read_toml(path)
    place = Path("default settings") if path is None else path
    try:
        settings = ServiceSettings(**fields)  # type: ignore[arg-type]  # checked by pydantic, that is the point
    except ValidationError as error:
        raise MachineFileError(_blame(place, error)) from error
    except SettingsError as error:
        raise MachineFileError(f"environment: {error}") from error
    folder = Path() if path is None else path.parent
    entries = tuple(_resolved(entry, folder) for entry in settings.machines)
    settings = settings.model_copy(update={"machines": entries})
    check_distinct(place, settings)
    return settings


def _blame(place: Path, error: ValidationError) -> str:
    """Fault by fault, say whether the file or an environment variable is to be changed."""
    lines = validation_text(place, error).splitlines()
    faults = error.errors()
    if len(lines) != len(faults):  # a message of several lines: leave the text as it is
        return "\n".join(lines)
    for number, fault in enumerate(faults):
        parts = [str(part).upper() for part in fault["loc"]]
        names = (_ENV_PREFIX + "__".join(parts[:depth]) for depth in range(len(parts), 0, -1))
        culprit = next((name for name in names if name in os.environ), None)
        if culprit is not None:
            lines[number] = lines[number].replace(str(place), f"environment variable {culprit}", 1)
    return "\n".join(lines)


def _resolved(entry: MachineEntry, folder: Path) -> MachineEntry:
    def beside(name: str) -> str:
        path = folder / name
        return str(path) if path.exists() else name

    # A machine file is known by its suffix; a bundle is a folder, so a name that is no folder is a shipped one.
    file = str(folder / entry.file) if entry.file.endswith(".toml") else entry.file
    return MachineEntry(file=file, bundle=None if entry.bundle is None else beside(entry.bundle))


def check_distinct(place: Path, settings: ServiceSettings) -> None:
    """Load every machine file and check that no two describe the same machine.

    Raises
    ------
    MachineFileError
        If one cannot be used, or two have the same site and name.
    """
    seen: dict[str, str] = {}
    for entry in settings.machines:
        root = entry.load().keys.root
        if root in seen:
            raise MachineFileError(f"{place}: machines: {seen[root]} and {entry.file} both describe {root}")
        seen[root] = entry.file
