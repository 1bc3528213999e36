"""What a monitor says: of one window, of one block, of the machine; and what it remembers."""

from dataclasses import dataclass, replace

from models.diagnosis.fallback.shape import ChannelShape
from models.diagnosis.readings import EquationReading, ParameterReading
from models.diagnosis.sensors.finding import SensorFinding
from models.diagnosis.verdict.detectable import DetectableChange
from models.diagnosis.verdict.sequential import SequentialVerdict
from models.ingest import Verdict
from rotorwatch.records.health import HealthState
from service.monitor.alarms.alarm import Alarm, AlarmEvent
from service.monitor.evaluation import Opinion

__all__ = ["DataQuality", "MachineHealth", "MonitorReport", "MonitorState", "Tally", "WindowReport"]


@dataclass(frozen=True, slots=True)
class DataQuality:
    """What came in since the monitor started.

    Attributes
    ----------
    accepted : int
        Blocks accepted.
    refused : dict of str to int
        Blocks refused, by reason.
    gaps : int
        Interruptions before accepted blocks.
    missing_s : float
        Data time that the gaps cost.
    last_refusal : str
        Latest reason for refusing a block, in a sentence.
    last_gap : str
        Latest gap, in a sentence.
    """

    accepted: int = 0
    refused: tuple[tuple[str, int], ...] = ()
    gaps: int = 0
    missing_s: float = 0.0
    last_refusal: str = ""
    last_gap: str = ""

    def counted(self, verdict: Verdict) -> "DataQuality":
        """Return the same after one more block."""
        if verdict.reason is not None:
            refused = dict(self.refused)
            refused[verdict.reason] = refused.get(verdict.reason, 0) + 1
            return replace(self, refused=tuple(sorted(refused.items())), last_refusal=verdict.text)
        accepted = self.accepted + 1
        if verdict.continuous:
            return replace(self, accepted=accepted)
        missing_s = self.missing_s + verdict.gap_s
        return replace(self, accepted=accepted, gaps=self.gaps + 1, missing_s=missing_s, last_gap=verdict.text)


@dataclass(frozen=True, slots=True)
class WindowReport:
    """One evaluation of the window, at the end of a hop.

    Attributes
    ----------
    start_ns, end_ns : int
        Oldest and newest data in the window.
    state : HealthState
        After this window: warming, healthy, alert, danger, outside-model, data-health, unchanged (no
        equation can be evaluated, but every channel is as it was) or not-evaluable.
    filled : float
        Fraction of a full window.
    speed_rad_s : float or None
        Mean speed in the window.
    parameters : tuple of ParameterReading
        Readings of the whole window by the diagnostician that decides: the likelihood, or the baseline.
    equations : tuple of EquationReading
        The networks' opinion, equation by equation.
    opinions : tuple of Opinion
        What the other diagnosticians read, and whether they agree.
    misfit_z : float or None
        How far the window is from what the model can explain; standard normal where the model holds.
    suspect : str
        What explains the misfit best, if one thing does.
    verdict : SequentialVerdict or None
        What has changed since the machine was nominal; the alarms are decided on it.
    detectable : tuple of DetectableChange
        What would have been noticed in this window, parameter by parameter.
    reason : str
        Why the window was not evaluated; empty if it was.
    sensors : tuple of SensorFinding
        Faults of sensors in the window; with any of them nothing is said of the machine.
    shapes : tuple of ChannelShape
        Where no equation can be evaluated: whether each channel's vibration is as it was.
    """

    start_ns: int
    end_ns: int
    state: HealthState
    filled: float
    speed_rad_s: float | None = None
    parameters: tuple[ParameterReading, ...] = ()
    equations: tuple[EquationReading, ...] = ()
    opinions: tuple[Opinion, ...] = ()
    misfit_z: float | None = None
    suspect: str = ""
    verdict: SequentialVerdict | None = None
    detectable: tuple[DetectableChange, ...] = ()
    reason: str = ""
    sensors: tuple[SensorFinding, ...] = ()
    shapes: tuple[ChannelShape, ...] = ()


@dataclass(frozen=True, slots=True)
class MonitorReport:
    """What one block did.

    Attributes
    ----------
    verdict : Verdict
        Accepted or refused, and why.
    windows : tuple of WindowReport
        One per hop that the block completed.
    events : tuple of AlarmEvent
        What happened to alarms.
    data_s : float
        Length of the block, if it was accepted.
    fault : Exception or None
        A defect of the monitor that came to light with the block; what it cost is said in `windows` and `events`.
    """

    verdict: Verdict
    windows: tuple[WindowReport, ...] = ()
    events: tuple[AlarmEvent, ...] = ()
    data_s: float = 0.0
    fault: Exception | None = None


@dataclass(frozen=True, slots=True)
class MonitorState:
    """All that a monitor remembers between two blocks.

    Attributes
    ----------
    alarms : str
        The alarms, JSON.
    state : bytes
        Everything else but the hops of the window (`models.checkpoint`).
    new_hops : tuple of (int, bytes)
        Hops of the window that are not known to be kept already, by the time of their end, oldest first.
    hops : tuple of int
        Ends of all hops that are in the window, oldest first.
    end_ns : int or None
        End of the newest data; None before the first.
    """

    alarms: str
    state: bytes
    new_hops: tuple[tuple[int, bytes], ...]
    hops: tuple[int, ...]
    end_ns: int | None


@dataclass(frozen=True, slots=True)
class MachineHealth:
    """Where the machine stands.

    Attributes
    ----------
    state : HealthState
    filled : float
        Fraction of a full window.
    latest : WindowReport or None
        The latest window.
    alarms : tuple of Alarm
        All that have been seen so far.
    quality : DataQuality
    sequence : int
        Number of the latest alarm event.
    reason : str
        Why nothing is said of the machine; empty if something is.
    end_ns : int or None
        End of the newest data; None before the first.
    """

    state: HealthState
    filled: float
    latest: WindowReport | None
    alarms: tuple[Alarm, ...]
    quality: DataQuality
    sequence: int = -1
    reason: str = ""
    end_ns: int | None = None


@dataclass(frozen=True, slots=True)
class Tally:
    """What a worker has done since it started, for whoever measures the service.

    Attributes
    ----------
    windows, blocks : int
        Windows evaluated, blocks taken.
    step_s : float
        Time spent in the monitor altogether.
    commit_s : float
        Time spent waiting for the history altogether.
    data_s : float
        Length of the data taken altogether.
    """

    windows: int = 0
    blocks: int = 0
    step_s: float = 0.0
    commit_s: float = 0.0
    data_s: float = 0.0
