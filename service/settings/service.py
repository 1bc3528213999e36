"""Settings of the monitor: a TOML file, and environment variables over it.

A field is overridden by an environment variable named after its place, with two underscores between the levels:
``ROTORWATCH_HTTP__PORT=9090`` is ``port`` in ``[http]``. Lists and tables are written as JSON:
``ROTORWATCH_MACHINES='[{"file": "lab", "bundle": "lab"}]'``.
"""

import os
import re
from pathlib import Path
from typing import Literal, Self

from pydantic import BaseModel, Field, JsonValue, ValidationError, field_validator, model_validator
from pydantic_settings import BaseSettings, PydanticBaseSettingsSource, SettingsConfigDict, SettingsError

from models.errors import MachineFileError
from models.machine import MachineFile, load_machine_file
from models.mistakes import did_you_mean, in_folder, mistakes, read_toml, unseen_mistakes
from models.signals.link import LinkSettings, TlsSettings, endpoint_fault, is_address
from service.history.records import Retention, StoreError
from service.settings.access import AccessSettings, check_access
from service.settings.webhooks import WebhookSettings

DEFAULT_LISTEN = "tcp/127.0.0.1:7447"

_ENV_PREFIX = "ROTORWATCH_"
_SHOWN = {"http", "queue", "shards", "recording", "replay", "log"}
"""Tables without a secret."""


class HttpSettings(BaseModel, extra="forbid", frozen=True):
    """Address, connection limits and timeouts of the HTTP API."""

    host: str = Field(default="127.0.0.1", min_length=1, description="address to listen on")

    @field_validator("host")
    @classmethod
    def _one_host(cls, host: str) -> str:
        # The last part of a name is never a number; one of numbers alone would be an address.
        is_name = re.fullmatch(r"([\w-]{1,63}\.)*(?!\d+\.?$)[\w-]{1,63}\.?", host, re.ASCII)
        if not is_name and not is_address(host):
            raise ValueError(
                f"{host!r} is neither an address nor a name of this computer, expected such as 0.0.0.0, ::1 or "
                "localhost; the port is http.port"
            )
        return host

    port: int = Field(default=8080, ge=0, le=65535, description="TCP port; 0 takes a free one, which is printed")
    connections: int = Field(
        default=300,
        ge=1,
        le=100_000,
        description="most connections at once; never more than a third of the files that the process may open",
    )
    connections_per_address: int = Field(
        default=100, ge=1, le=100_000, description="most connections of one address, proxies of [access] excepted"
    )
    head_timeout_s: float = Field(
        default=10.0, ge=0.1, le=3600.0, description="longest time until the head of a request has arrived, in seconds"
    )
    body_timeout_s: float = Field(
        default=60.0, ge=0.1, le=86_400.0, description="longest time until its body has arrived, in seconds"
    )
    send_timeout_s: float = Field(
        default=60.0, ge=0.1, le=86_400.0, description="longest time for which a reader takes nothing, in seconds"
    )


class MachineEntry(BaseModel, extra="forbid", frozen=True):
    """One monitored machine."""

    file: str = Field(min_length=1, description="shipped machine by name, or path relative to the settings file")
    bundle: str | None = Field(
        default=None,
        min_length=1,
        description="bundle with trained networks or commissioning: shipped name, or folder relative to the settings "
        "file. Without one, only the levels of a machine with unknown parameters are watched; others are monitored "
        "without networks",
    )

    def load(self) -> MachineFile:
        """Load the machine file; raises `MachineFileError`, naming the file, the field and the value found."""
        return load_machine_file(self.file)


class QueueSettings(BaseModel, extra="forbid", frozen=True):
    """Blocks of one machine that have arrived and are not evaluated yet.

    With ``when_full = "drop"`` a monitor that cannot keep up loses blocks and counts them; the source is never slowed
    down. With ``"wait"`` it slows the source down instead: right for batch runs, where a publisher sends recorded or
    simulated data as fast as it can, wrong for a live machine, because everything else on the same link waits too.
    """

    blocks: int = Field(default=1500, ge=1, le=1_000_000, description="most blocks that wait, per machine")
    mb: float = Field(default=64.0, gt=0, le=100_000, description="most megabytes that wait, per machine")
    when_full: Literal["drop", "wait"] = Field(default="drop", description="what happens to further blocks")


class HistorySettings(BaseModel, extra="forbid", frozen=True):
    """Where reports, alarms and the data for a restart are kept, and for how long."""

    url: str | None = Field(
        default=None,
        min_length=1,
        description="database: sqlite:///FILE, relative to the settings file, or postgresql://USER:PASSWORD@HOST/NAME; "
        "sqlite:///:memory: keeps nothing beyond the end of the program. Left out: history.sqlite in the user's state "
        "folder",
    )
    retention: Retention = Field(default=Retention(), description="how long records are kept; alarms are kept for ever")

    @field_validator("url")
    @classmethod
    def _known(cls, url: str | None) -> str | None:
        if url is not None:
            from service.history.database import checked_url  # noqa: PLC0415  # many commands need no sqlalchemy

            try:
                checked_url(url)
            except StoreError as error:
                raise ValueError(str(error)) from None
        return url

    @property
    def database(self) -> str:
        """The URL, or the default if it is left out."""
        if self.url is not None:
            return self.url
        folder = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "rotorwatch"
        return f"sqlite:///{folder.absolute() / 'history.sqlite'}"

    @property
    def in_memory(self) -> bool:
        """Whether it is kept in memory, where no other program finds it."""
        return self.database.endswith(":memory:")


class RecordingSettings(BaseModel, extra="forbid", frozen=True):
    """Where everything under the machines' keys is recorded, and what is kept; sizes are per machine.

    Whole files are kept or dropped. A file that reaches into the time around an alarm falls under the limits for alarms
    instead of the ordinary ones.
    """

    directory: str | None = Field(
        default=None, min_length=1, description="where recordings go, relative to the settings file; off without it"
    )
    rotate_s: float = Field(default=300.0, ge=1.0, le=86_400.0, description="longest time in one file, in seconds")
    rotate_mb: float = Field(default=256.0, ge=0.1, le=65_536.0, description="size at which a file is closed, in MB")
    keep_gb: float = Field(default=20.0, gt=0.0, le=1e6, description="most kept of files without an alarm, in GB")
    keep_days: float = Field(default=7.0, gt=0.0, le=36_500.0, description="how long these are kept, in days")
    alarm_before_s: float = Field(
        default=600.0, ge=0.0, le=86_400.0, description="time before an alarm event that is kept with it, in seconds"
    )
    alarm_after_s: float = Field(default=600.0, ge=0.0, le=86_400.0, description="the same after it, in seconds")
    alarm_keep_gb: float = Field(default=40.0, gt=0.0, le=1e6, description="most kept of files with an alarm, in GB")
    alarm_keep_days: float = Field(default=365.0, gt=0.0, le=36_500.0, description="how long these are kept, in days")
    queue_mb: float = Field(
        default=64.0, ge=0.1, le=16_384.0, description="most data that wait in memory to be written, in MB"
    )

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.alarm_before_s > self.keep_days * 86_400.0:
            raise ValueError(
                f"alarm_before_s is {self.alarm_before_s:g}, longer than keep_days ({self.keep_days:g}): what came "
                "before an alarm would be gone when it is raised"
            )
        if self.rotate_mb > 1000.0 * min(self.keep_gb, self.alarm_keep_gb):
            raise ValueError(
                f"rotate_mb is {self.rotate_mb:g}, more than keep_gb ({self.keep_gb:g}) or alarm_keep_gb "
                f"({self.alarm_keep_gb:g}) allow in all: a file would be dropped as soon as it is closed"
            )
        return self


class ShardSettings(BaseModel, extra="forbid", frozen=True):
    """Processes that share the machines; each computes on one core at a time."""

    count: int | None = Field(
        default=None,
        ge=1,
        le=1024,
        description="number of processes; if left out, one for every fifteen machines, at most one per core",
    )


class FleetSettings(BaseModel, extra="forbid", frozen=True):
    """Where shards on other computers reach the process that serves their machines; only for ``rotorwatch fleet``."""

    listen: str = Field(
        description='endpoint that all computers of the fleet reach, such as "tcp/10.0.0.5:7448"; clients need a '
        "password that is generated at each start"
    )
    tls: TlsSettings | None = Field(default=None, description='certificates, if listen begins with "tls/"')

    @field_validator("listen")
    @classmethod
    def _endpoint(cls, listen: str) -> str:
        if (fault := endpoint_fault(listen)) is not None:
            raise ValueError(fault)
        return listen


class ReplaySettings(BaseModel, extra="forbid", frozen=True):
    """Replays of recordings that are started over HTTP; results are kept below the directory of the recordings."""

    enabled: bool | None = Field(
        default=None,
        description="whether replays may be started; if left out, only if the HTTP API listens on loopback",
    )
    jobs: int = Field(default=1, ge=1, le=64, description="most replays that run at once")
    nice: int = Field(default=10, ge=0, le=19, description="by how much their priority is lowered, at most 19")
    kept: int = Field(default=20, ge=1, le=10_000, description="number of latest replays whose results are kept")


class LogSettings(BaseModel, extra="forbid", frozen=True):
    """What is logged to standard error, and how."""

    level: Literal["debug", "info", "warning", "error"] = Field(default="info", description="least serious level shown")
    format: Literal["console", "json"] = Field(default="console", description="for people, or one JSON object a line")


class ServiceSettings(BaseSettings):
    """All settings of the monitor; without a file it monitors the shipped machine ``lab``."""

    model_config = SettingsConfigDict(
        extra="forbid", frozen=True, env_prefix=_ENV_PREFIX, env_nested_delimiter="__", validate_default=True
    )

    link: LinkSettings = Field(
        default=LinkSettings(listen=(DEFAULT_LISTEN,)),
        description="Zenoh: role and endpoints; loopback only if left out",
    )
    http: HttpSettings = Field(default=HttpSettings(), description="HTTP API")
    access: AccessSettings = Field(
        default=AccessSettings(), description="who may use the HTTP API: holders of tokens, if left out"
    )
    machines: tuple[MachineEntry, ...] = Field(
        default=(MachineEntry(file="lab", bundle="lab"),), min_length=1, description="machines to monitor"
    )
    queue: QueueSettings = Field(default=QueueSettings(), description="blocks that wait for evaluation")
    history: HistorySettings = Field(default=HistorySettings(), description="reports, alarms, restarts")
    shards: ShardSettings = Field(default=ShardSettings(), description="processes that share the machines")
    fleet: FleetSettings | None = Field(default=None, description="shards on the computers of a Ray cluster")
    recording: RecordingSettings = Field(default=RecordingSettings(), description="recordings; off without directory")
    replay: ReplaySettings = Field(default=ReplaySettings(), description="replays over HTTP")
    webhooks: tuple[WebhookSettings, ...] = Field(default=(), description="who receives alarm events")
    log: LogSettings = Field(default=LogSettings(), description="log")

    @model_validator(mode="after")
    def _reachable(self) -> Self:
        if not self.link.listen and not self.link.connect:
            raise ValueError("link has neither listen nor connect: no stream could reach the monitor")
        names = [hook.name for hook in self.webhooks]
        if repeated := [name for name in names if names.count(name) > 1]:
            raise ValueError(f"webhooks: two are called {repeated[0]}, expected different names")
        return self

    @property
    def shown(self) -> dict[str, dict[str, JsonValue]]:
        """Settings that a caller who may configure the monitor may see: all tables without a secret."""
        return self.model_dump(mode="json", include=_SHOWN)

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
    if path is not None and not fields:  # left by an editor on a full disk, for example
        raise MachineFileError(f"{path}: is empty, expected settings (TOML)")
    for table, kind in (
        ("sensors", "machine file, to be named in [[machines]]"),
        ("channels", "mapping for an import"),
    ):
        if table in fields:
            raise MachineFileError(f"{path}: is a {kind}, expected settings")
    place = Path("default settings") if path is None else path
    # Others may belong to other programs: Kubernetes makes ROTORWATCH_PORT for a service of that name.
    for name in sorted(os.environ):
        table, nested, _ = name.removeprefix(_ENV_PREFIX).lower().partition("__")
        if name.startswith(_ENV_PREFIX) and nested and table not in ServiceSettings.model_fields:
            raise MachineFileError(
                f"environment variable {name}: {table}: unknown{did_you_mean(table, ServiceSettings.model_fields)}"
            )
    told = [f"{place}: {text}" for text in unseen_mistakes(fields, ServiceSettings)]
    try:
        settings = ServiceSettings(**fields)  # type: ignore[arg-type]  # checked by pydantic, that is the point
    except ValidationError as error:
        told += [f"{_culprit(at, place)}: {text}" for at, text in mistakes(error, ServiceSettings, fields)]
        raise MachineFileError("\n".join(told)) from error
    except SettingsError as error:
        name = str(error).partition('"')[2].partition('"')[0]
        raise MachineFileError(
            f"environment variable {_ENV_PREFIX}{name.upper()}: expected JSON, "
            f"found {os.environ.get(_ENV_PREFIX + name.upper(), '')!r}"
        ) from error
    if told:
        raise MachineFileError("\n".join(told))
    folder = Path() if path is None else path.parent
    entries = tuple(_resolved(entry, folder) for entry in settings.machines)
    history, recording = settings.history, settings.recording
    if history.url is not None:
        history = history.model_copy(update={"url": _beside(folder, history.url)})
    if recording.directory is not None:
        directory = folder / recording.directory
        if directory.exists() and not directory.is_dir():
            raise MachineFileError(f"{place}: recording.directory: {directory} is not a folder, expected one")
        recording = recording.model_copy(update={"directory": str(directory)})
    update = {"machines": entries, "recording": recording, "history": history}
    settings = in_folder(settings, folder).model_copy(update=update)
    check_distinct(place, settings)
    check_access(str(place), settings.access, settings.http.host)
    settings.link.check_reach(str(place))
    return settings


def _beside(folder: Path, url: str) -> str:
    """The URL of an SQLite file with its path relative to a folder; any other URL as it is."""
    scheme, separator, path = url.partition(":///")
    if scheme != "sqlite" or not separator or path == ":memory:":
        return url
    return f"sqlite:///{folder.absolute() / path}"


def _culprit(at: tuple[int | str, ...], place: Path) -> str:
    """The file, or the environment variable that is to be changed instead."""
    parts = [str(part).upper() for part in at]
    names = (_ENV_PREFIX + "__".join(parts[:depth]) for depth in range(len(parts), 0, -1))
    culprit = next((name for name in names if name in os.environ), None)
    return str(place) if culprit is None else f"environment variable {culprit}"


def _resolved(entry: MachineEntry, folder: Path) -> MachineEntry:
    # A machine file is known by its suffix; a bundle is a folder, so a name that is no folder is a shipped one.
    file, bundle = entry.file, entry.bundle
    file = str(folder / file) if file.endswith(".toml") else file
    bundle = str(folder / bundle) if bundle is not None and (folder / bundle).exists() else bundle
    return MachineEntry(file=file, bundle=bundle)


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
