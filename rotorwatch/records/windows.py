"""Results for a window: parameters, equations, opinions, verdict, sensor faults."""

from typing import Literal

from pydantic import Field

from rotorwatch.records.fields import EXAMPLE_NS, Number, ParameterName, ParameterText, Reason, Record
from rotorwatch.records.sensor_faults import FaultKind

Interval = tuple[float, float]


class UnbalanceVector(Record):
    """Unbalance relative to the nominal one; angles count from the nominal heavy spot in the direction of rotation."""

    magnitude_change: float = Field(description="relative change of its magnitude, never below -1", examples=[-0.02])
    magnitude_interval_95: Interval = Field(description="95 % interval of that", examples=[(-0.05, 0.01)])
    turned_deg: float | None = Field(
        description="angle by which the heavy spot has turned; null if too little unbalance is left", examples=[90.4]
    )
    turned_interval_95_deg: Interval | None = Field(description="95 % interval of that", examples=[(88.9, 91.9)])
    change: float = Field(description="magnitude of the vector of change, over the nominal unbalance", examples=[1.41])
    change_interval_95: Interval = Field(description="95 % interval of that", examples=[(1.37, 1.45)])
    change_angle_deg: float | None = Field(
        description="direction of the vector of change; null if the vector is within its errors", examples=[135.2]
    )
    text: str = Field(
        description="the change in words",
        examples=["a vector of 61 % of the nominal unbalance at 35° from the heavy spot (size +54 %, turned by 13°)"],
    )


class Parameter(Record):
    """One physical parameter's relative change in one window."""

    name: ParameterName
    text: ParameterText
    by: str = Field(description="diagnostician: likelihood, network or relation", examples=["likelihood"])
    relative_change: Number = Field(
        default=None, description="relative change from nominal; null if not evaluable", examples=[-0.247]
    )
    standard_error: Number = Field(default=None, description="standard error of the relative change", examples=[0.0071])
    interval_95: Interval | None = Field(
        default=None, description="95 % interval of the relative change", examples=[(-0.261, -0.233)]
    )
    z: Number = Field(default=None, description="relative change in standard errors", examples=[-34.8])
    reason: Reason = ""
    vector: UnbalanceVector | None = Field(
        default=None,
        description="for e with a phase reference: size and direction. Once the heavy spot has turned, "
        "relative_change is the size of the vector of change",
        examples=[None],
    )


class Equation(Record):
    """Residual of one compatibility equation in one window."""

    equation: str = Field(description="number of the compatibility equation: 28 to 31", examples=["28"])
    title: str = Field(description="what the equation is about", examples=["bearing, horizontal"])
    evaluable: bool = Field(description="whether the window allowed an evaluation", examples=[True])
    msd: Number = Field(
        default=None,
        description="mean squared deviation between network and estimated correlation, over the target's mean square",
        examples=[0.0613],
    )
    msd_healthy: Number = Field(default=None, description="mean of `msd` on healthy windows", examples=[0.0018])
    parameters: tuple[Parameter, ...] = Field(
        default=(), description="the residual projected on the equation's own parameters"
    )
    reason: Reason = ""


class Agreement(Record):
    """Whether two diagnosticians read the same for one parameter."""

    name: ParameterName
    between: tuple[str, str] = Field(description="the two diagnosticians", examples=[("likelihood", "relation")])
    verdict: Literal["agree", "disagree", "only-one"] = Field(
        description="agree, disagree, or only-one if only one of them could read the parameter", examples=["agree"]
    )
    difference_z: Number = Field(
        default=None,
        description="second minus first change in combined standard errors, or fewer if their tails are heavy",
        examples=[0.8],
    )


class Opinion(Record):
    """What a diagnostician other than the likelihood reads in the same window."""

    by: str = Field(description="diagnostician: network or relation", examples=["relation"])
    parameters: tuple[Parameter, ...] = Field(default=(), description="its readings")
    agreement: tuple[Agreement, ...] = Field(default=(), description="comparison with the likelihood")
    reason: Reason = ""


class Finding(Record):
    """One parameter that changed, since when, and how the change was found."""

    name: ParameterName
    text: ParameterText
    since_ns: int = Field(
        description="when it changed, as far as known; without `between_ns`, the start of the stretch of data in "
        "which the change was first found",
        examples=[EXAMPLE_NS - 20_000_000_000],
    )
    between_ns: tuple[int, int] | None = Field(
        default=None,
        exclude_if=lambda value: value is None,
        description="95 % limits of the time of the change; left out if the windows do not show it",
        examples=[(EXAMPLE_NS - 22_500_000_000, EXAMPLE_NS - 17_500_000_000)],
    )
    found_ns: int = Field(description="end of the stretch that found it first", examples=[EXAMPLE_NS - 10_000_000_000])
    stretch_s: float = Field(description="length of that stretch", examples=[10.0])


class Candidate(Record):
    """A parameter that may have changed."""

    name: ParameterName
    text: ParameterText
    probability: float = Field(description="probability that it is among the parameters that changed", examples=[0.97])


class Alternative(Record):
    """One of the sets of parameters considered as having changed."""

    names: tuple[ParameterName, ...] = Field(description="the set; empty: nothing changed", examples=[("c_by",)])
    probability: float = Field(description="probability that these changed and nothing else", examples=[0.0004])
    explained: float = Field(
        description="share that this set explains by itself of what all parameters together explain", examples=[0.08]
    )


class Verdict(Record):
    """What has changed, decided on stretches of data of all lengths that end with this hop; alarms are based on it."""

    changed: tuple[Finding, ...] = Field(description="parameters that changed; empty: none")
    text: str = Field(
        description="the verdict in a sentence",
        examples=[
            "changed: bearing stiffness, horizontal (k_by) since 00:03:05, found 00:03:15 in 10 s of data; "
            "confidence 99.6 %"
        ],
    )
    detected: bool = Field(description="something changed, even if it is not yet clear what", examples=[True])
    confidence: float = Field(
        description="probability of exactly this set of parameters among all sets", examples=[0.996]
    )
    candidates: tuple[Candidate, ...] = Field(
        default=(), description="parameters that may have changed, the most probable first; those below 5 % left out"
    )
    alternatives: tuple[Alternative, ...] = Field(
        default=(),
        exclude_if=lambda value: not value,
        description="sets considered, the most probable first: the most likely ones, each parameter by itself, and "
        "none; left out while no change is seen",
    )
    low_confidence: bool = Field(
        description="parameters are named with low confidence: the machine is outside the model, or several sets "
        "explain the data",
        examples=[False],
    )
    outside_model: bool = Field(
        description="something changed that no parameter describes, or a sensor is at fault", examples=[False]
    )
    outside_confidence: Number = Field(
        description="confidence in that, 0.5 without evidence; null if not tested", examples=[0.5]
    )
    decided_s: float = Field(description="length of the stretch of data on which it was decided", examples=[20.0])
    settled: bool = Field(
        description="no change within the window: `parameters` hold for one state of the machine", examples=[False]
    )
    current: tuple[Parameter, ...] = Field(
        description="readings of the machine since the last change, from at most one window and those before it. "
        "Readings of changed parameters are means over what else may have changed, and over the time of the change; "
        "they are left out while there are too few data"
    )


class Detectable(Record):
    """Smallest change of one parameter, alone, that would be found with 95 % probability."""

    name: ParameterName
    loss: float = Field(description="smallest relative decrease; -1: not even a total loss", examples=[-0.025])
    gain: float = Field(description="smallest relative increase", examples=[0.026])
    length_s: float = Field(description="length of data needed", examples=[60.0])


class SensorFault(Record):
    """Fault of one sensor, or of one among several that contradict each other."""

    states: tuple[str, ...] = Field(description="states that the channels in question measure", examples=[("y1",)])
    kind: FaultKind = Field(description="kind of fault", examples=["gain"])
    text: str = Field(
        description="channels, value found and what was expected, in a sentence",
        examples=["gain of y1 is 20 % lower than when it was commissioned"],
    )
    value: Number = Field(description="; ".join(f"{kind}: {kind.measure}" for kind in FaultKind), examples=[-0.2])
    z: Number = Field(default=None, description="in standard errors; null if chance plays no part", examples=[41.0])


class Shape(Record):
    """Whether one channel's vibration is as it was on the healthy machine, where no equation can be evaluated."""

    state: str = Field(description="state that the channel measures", examples=["y1"])
    verdict: str = Field(description="not changed, changed or not evaluable", examples=["not changed"])
    z: Number = Field(description="distance from the healthy shape, a standard normal value", examples=[0.4])
    limit: float = Field(description="z above which the channel is reported as changed", examples=[3.1])
    text: str = Field(description="the same in a sentence", examples=["y1: not changed"])


class NaturalFrequency(Record):
    """Whether a natural frequency is that of the healthy machine; watched where a stiffness is not known well."""

    healthy_hz: float = Field(description="natural frequency of the healthy machine, Hz", examples=[11.8])
    hz: Number = Field(description="natural frequency in this window, Hz; null if not found", examples=[11.85])
    change: Number = Field(description="relative change", examples=[0.004])
    limit: float = Field(description="relative change beyond which it is reported as changed", examples=[0.03])
    verdict: str = Field(description="not changed, changed or not evaluable", examples=["not changed"])
    text: str = Field(
        description="the same in a sentence",
        examples=["natural frequency 11.8 Hz: not changed (now 11.85 Hz, +0.4%, limit 3.0%)"],
    )
