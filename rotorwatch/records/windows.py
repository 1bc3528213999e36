"""Results for a window: parameters, equations, opinions, verdict, sensor faults."""

from typing import Literal

from pydantic import Field

from rotorwatch.records.fields import EXAMPLE_NS, Number, ParameterName, ParameterText, Reason, Record
from rotorwatch.records.sensor_faults import FaultKind

Interval = tuple[float, float]


class UnbalanceVector(Record):
    """The unbalance over the nominal one; angles count from the nominal heavy spot in the direction of rotation."""

    magnitude_change: float = Field(description="relative change of its size, never below -1", examples=[-0.02])
    magnitude_interval_95: Interval = Field(description="95 % interval of that", examples=[(-0.05, 0.01)])
    turned_deg: float | None = Field(
        description="angle by which the heavy spot has turned; null where so little is left that it has none",
        examples=[90.4],
    )
    turned_interval_95_deg: Interval | None = Field(description="95 % interval of that", examples=[(88.9, 91.9)])
    change: float = Field(
        description="size of the vector by which it changed, over the nominal unbalance", examples=[1.41]
    )
    change_interval_95: Interval = Field(description="95 % interval of that", examples=[(1.37, 1.45)])
    change_angle_deg: float | None = Field(
        description="direction of that vector; null where it is within its errors", examples=[135.2]
    )
    text: str = Field(
        description="the change in words",
        examples=["a vector of 61 % of the nominal unbalance at 35° from the heavy spot (size +54 %, turned by 13°)"],
    )


class Parameter(Record):
    """One physical parameter's relative change in one window."""

    name: ParameterName
    text: ParameterText
    by: str = Field(description="who says so: likelihood, network or relation", examples=["likelihood"])
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
        description="of e where there is a phase reference: size and direction. Once the heavy spot has turned, "
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
    msd_healthy: Number = Field(default=None, description="the same on healthy windows, mean", examples=[0.0018])
    parameters: tuple[Parameter, ...] = Field(
        default=(), description="the residual projected on the equation's own parameters"
    )
    reason: Reason = ""


class Agreement(Record):
    """Whether two diagnosticians say the same of one parameter."""

    name: ParameterName
    between: tuple[str, str] = Field(description="who is compared", examples=[("likelihood", "relation")])
    verdict: Literal["agree", "disagree", "only-one"] = Field(
        description="agree, disagree, or only-one where only one of them could read the parameter", examples=["agree"]
    )
    difference_z: Number = Field(
        default=None,
        description="second minus first change in combined standard errors, fewer where these have heavy tails",
        examples=[0.8],
    )


class Opinion(Record):
    """What a diagnostician other than the likelihood reads in the same window."""

    by: str = Field(description="who: network or relation", examples=["relation"])
    parameters: tuple[Parameter, ...] = Field(default=(), description="what it reads")
    agreement: tuple[Agreement, ...] = Field(default=(), description="how that compares with the likelihood")
    reason: Reason = ""


class Finding(Record):
    """One parameter that changed, and how that was found."""

    name: ParameterName
    text: ParameterText
    since_ns: int = Field(
        description="when it changed, as far as it is known; without `between_ns` the start of the stretch of data "
        "that found it first",
        examples=[EXAMPLE_NS - 20_000_000_000],
    )
    between_ns: tuple[int, int] | None = Field(
        default=None,
        exclude_if=lambda value: value is None,
        description="95 % limits of that moment; left out where the windows do not show it",
        examples=[(EXAMPLE_NS - 22_500_000_000, EXAMPLE_NS - 17_500_000_000)],
    )
    found_ns: int = Field(description="end of that stretch", examples=[EXAMPLE_NS - 10_000_000_000])
    stretch_s: float = Field(description="length of that stretch", examples=[10.0])


class Candidate(Record):
    """A parameter that may have changed."""

    name: ParameterName
    text: ParameterText
    probability: float = Field(description="that it is among those that changed", examples=[0.97])


class Alternative(Record):
    """A set of parameters that may have changed, beside others that were weighed."""

    names: tuple[ParameterName, ...] = Field(description="the set; empty: nothing changed", examples=[("c_by",)])
    probability: float = Field(description="that these changed and nothing else", examples=[0.0004])
    explained: float = Field(
        description="share of what all parameters together explain that this set explains by itself", examples=[0.08]
    )


class Verdict(Record):
    """What has changed, from stretches of data of all lengths that end with this hop; alarms are decided on it."""

    changed: tuple[Finding, ...] = Field(description="parameters that changed; empty: none")
    text: str = Field(
        description="the verdict in a sentence",
        examples=[
            "changed: bearing stiffness, horizontal (k_by) since 00:03:05, found 00:03:15 in 10 s of data; "
            "confidence 99.6 %"
        ],
    )
    detected: bool = Field(description="something changed, whether or not it is clear yet what", examples=[True])
    confidence: float = Field(
        description="probability of exactly this set of parameters among all sets", examples=[0.996]
    )
    candidates: tuple[Candidate, ...] = Field(
        default=(), description="parameters that may have changed, the most probable first; those below 5 % left out"
    )
    alternatives: tuple[Alternative, ...] = Field(
        default=(),
        exclude_if=lambda value: not value,
        description="sets that were weighed, the most probable first: the likeliest, each parameter by itself, none; "
        "left out while nothing is seen",
    )
    low_confidence: bool = Field(
        description="parameters have low confidence: outside the model, or several sets explain the data",
        examples=[False],
    )
    outside_model: bool = Field(
        description="something changed that no parameter describes, or a sensor is at fault", examples=[False]
    )
    outside_confidence: Number = Field(
        description="how sure that is, 0.5 for not at all; null without a test", examples=[0.5]
    )
    decided_s: float = Field(description="length of the stretch of data that decided", examples=[20.0])
    settled: bool = Field(
        description="no change within the window: `parameters` hold for one state of the machine", examples=[False]
    )
    current: tuple[Parameter, ...] = Field(
        description="readings of the machine since the last change, from at most one window and those before it; of "
        "changed parameters over all that may have changed beside them, and over when. Without those of which there "
        "is too little data yet"
    )


class Detectable(Record):
    """Smallest change of one parameter, alone, that would be found with 95 % probability."""

    name: ParameterName
    loss: float = Field(description="relative change downwards; -1: not even a total loss", examples=[-0.025])
    gain: float = Field(description="relative change upwards", examples=[0.026])
    length_s: float = Field(description="data that takes", examples=[60.0])


class SensorFault(Record):
    """One fault of a sensor, or of one of several that contradict each other."""

    states: tuple[str, ...] = Field(description="what the channels in question measure", examples=[("y1",)])
    kind: FaultKind = Field(description="what is wrong with it", examples=["gain"])
    text: str = Field(
        description="channels, value found and what was expected, in a sentence",
        examples=["gain of y1 is 20 % lower than when it was commissioned"],
    )
    value: Number = Field(description="; ".join(f"{kind}: {kind.measure}" for kind in FaultKind), examples=[-0.2])
    z: Number = Field(default=None, description="in standard errors; null where no chance is involved", examples=[41.0])


class Shape(Record):
    """Whether one channel's vibration is as it was on the healthy machine, where no equation can be evaluated."""

    state: str = Field(description="what the channel measures", examples=["y1"])
    verdict: str = Field(description="not changed, changed or not evaluable", examples=["not changed"])
    z: Number = Field(description="distance from the healthy shape, a standard normal value", examples=[0.4])
    limit: float = Field(description="what z must exceed to be called changed", examples=[3.1])
    text: str = Field(description="the same in a sentence", examples=["y1: not changed"])
