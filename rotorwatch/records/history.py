"""The history: lists with cursors, readings over time, the audit log."""

from pydantic import Field

from rotorwatch.records.alarms import AlarmCloudEvent
from rotorwatch.records.fields import EXAMPLE_NS, OfMachine, Record
from rotorwatch.records.health import MEASURES, Report
from rotorwatch.records.snapshots import CorrelationSnapshot, OrbitSnapshot, SpectrumSnapshot


class ReportList(Record):
    """Window reports, the latest to arrive first."""

    reports: tuple[Report, ...] = Field(description="the latest to arrive first")
    next_before: int | None = Field(
        description="pass it as `before` to get what is older; null if nothing older is kept", examples=[4711]
    )


class AlarmEventList(Record):
    """Alarm events in the order of their sequence, or, without `after`, in the reverse order."""

    events: tuple[AlarmCloudEvent, ...] = Field(description="with `after` oldest first, otherwise newest first")
    next_before: int | None = Field(
        description="pass it as `before` to get what is older; null if there is nothing older, and with `after`",
        examples=[17],
    )
    next_after: int | None = Field(
        description="pass it as `after` to go on from here, now or later; null without `after`", examples=[None]
    )


class Picture(Record):
    """A machine at one window: report, spectra, orbits and correlation functions."""

    report: Report
    spectra: SpectrumSnapshot
    orbits: OrbitSnapshot
    correlations: CorrelationSnapshot | None = Field(
        default=None,
        exclude_if=lambda value: value is None,
        description="correlation functions of the default pairs, without predictions; missing from pictures kept by "
        "an earlier version",
    )


class AlarmEvidence(OfMachine):
    """Evidence of one occurrence of an alarm: the machine before, when it was raised, and after the change."""

    name: str = Field(description="name of the alarm", examples=["k_by"])
    occurrence: int = Field(description="which occurrence of its condition, counted from 1", examples=[1])
    before: Picture | None = Field(
        description="latest picture kept while nothing was wrong (one per hour is kept); null if there is none",
        examples=[None],
    )
    raised: Picture = Field(description="picture of the window with which the alarm was raised")
    settled: Picture | None = Field(
        description="picture of the first window without data from before the change; null if there is none yet, or "
        "the alarm cleared before it",
        examples=[None],
    )


class Reading(Record):
    """One number read in one window."""

    number: int = Field(description="counts the machine's windows in the order of arrival", examples=[4711])
    end_ns: int = Field(description="end of the window", examples=[EXAMPLE_NS])
    value: float = Field(description="value as in the report", examples=[-0.247])
    standard_error: float | None = Field(description="standard error; null if there is none", examples=[0.0071])


class ReadingBucket(Record):
    """Readings of one name in windows that end within a stretch of time."""

    name: str = Field(description="which parameter, equation or level", examples=["k_by"])
    start_ns: int = Field(description="beginning of the bucket", examples=[EXAMPLE_NS - 60_000_000_000])
    length_ns: int = Field(description="length of the bucket", examples=[60_000_000_000])
    count: int = Field(description="number of readings", examples=[12])
    minimum: float = Field(description="smallest value", examples=[-0.251])
    mean: float = Field(description="mean value", examples=[-0.246])
    maximum: float = Field(description="largest value", examples=[-0.239])
    mean_standard_error: float | None = Field(
        description="mean of the standard errors of those that have one; null if none has", examples=[0.0072]
    )


class ReadingList(Record):
    """Readings of one quantity over time: one by one, or reduced to buckets of equal length."""

    quantity: str = Field(
        description="parameter (relative change), equation (mean squared difference), level (of a channel, in the "
        "unit given in reports) or a measure of the window: "
        + ", ".join(f"{name} ({Report.model_fields[field].description})" for name, (field, _) in MEASURES.items()),
        examples=["parameter"],
    )
    readings: tuple[Reading, ...] = Field(description="in the order of arrival; empty with `points`")
    buckets: tuple[ReadingBucket, ...] = Field(
        description="with `points`, by name and time; those without a reading are left out", examples=[()]
    )
    next_after: int | None = Field(
        description="pass it as `after` to go on; null if there is no more yet, and with `points`", examples=[4711]
    )


class Trend(OfMachine):
    """One reading of one machine over time, up to its newest window; n values each."""

    quantity: str = Field(description="as in the list of readings", examples=["parameter"])
    name: str = Field(description="which parameter, equation or level", examples=["k_by"])
    length_ns: int | None = Field(description="bucket length; null if there is none", examples=[1_800_000_000_000])
    starts_ns: tuple[int, ...] = Field(
        description="when each bucket begins; those without a reading are left out", examples=[(EXAMPLE_NS,)]
    )
    means: tuple[float, ...] = Field(description="mean of the readings in each bucket", examples=[(-0.246,)])


class TrendList(Record):
    """The requested trends."""

    trends: tuple[Trend, ...] = Field(description="one for each `of`, in that order")


class AuditRecord(Record):
    """One entry of the audit log."""

    number: int = Field(description="counts the entries", examples=[291])
    at_ns: int = Field(
        description="when the request arrived, by this computer's clock; the same before and after the operation",
        examples=[EXAMPLE_NS],
    )
    actor: str = Field(description="name of the caller's token; empty if there is none", examples=["anna"])
    address: str = Field(description="where the request came from", examples=["127.0.0.1"])
    method: str = Field(description="HTTP method", examples=["POST"])
    path: str = Field(description="path of the request", examples=["/api/v1/machines/demo/lab/alarms/k_by/acknowledge"])
    status: int = Field(description="HTTP status of the answer; 0 before the operation", examples=[200])
    action: str = Field(description="operation, in one word; `started` before it is done", examples=["acknowledge"])
    machine: str = Field(description="site/machine it concerns; empty if none", examples=["demo/lab"])
    alarm: str = Field(description="alarm it concerns; empty if none", examples=["k_by"])
    reason: str = Field(description="reason given, or why it was refused", examples=["seen, inspection is ordered"])


class AuditList(Record):
    """Entries of the audit log, newest first."""

    entries: tuple[AuditRecord, ...] = Field(description="newest first")
    next_before: int | None = Field(
        description="pass it as `before` to get what is older; null if there is nothing older", examples=[291]
    )
