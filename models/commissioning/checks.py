"""Checks whether healthy recordings are suitable for commissioning a machine, with advice on what to record if not."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np
from pydantic import BaseModel, Field

from models.commissioning.healthy import HealthyRecording, foreign_lines
from models.diagnosis.baseline.relation import one_source
from models.diagnosis.misfit import ACROSS, DELAY
from models.diagnosis.readings import Diagnosis
from models.diagnosis.sensors.disagreement import LEAST_DELAY_S
from models.diagnosis.sensors.level import at_range_end
from models.diagnosis.sensors.reference import Naming
from models.diagnosis.shape import SEEN_GROWTH, ShapePower
from models.diagnosis.verdict.isolation import isolate_window
from models.diagnosis.window.statistics import WindowStatistics
from models.machine import MachineFile
from models.physics.rotor import PARAMETER_TEXT
from models.signals.channels import with_channel_names
from models.stream_settings import NEAR, time_scale
from rotorwatch.records.windows import SensorFault

_FEWEST_HOPS = 8
_FEW_WINDOWS = 6
_MUCH_REFUSED, _TOO_MUCH_REFUSED = 0.01, 0.2
_STEADY_SPEED = 0.05
_STEADY_LEVEL = 2.0  # ratio of the rms between the halves of a recording; chance alone reaches 1.3 in half a minute
SAME_SPEED = 0.03  # relative difference within which speeds count as one
# Cross-axis part of a sensor, as when mounted two degrees off, below which a window does not count against the theory.
_LITTLE = 0.035
_MOST_OUTSIDE = 0.8  # share of healthy windows outside a theory beyond which it is not the machine's
_RATE = 1e-3  # probability that a healthy machine fails a comparison of its own windows
# Differences matter above this part of the limit of the parameter's alarm. Sensors are calibrated to some per cent, but
# with one force standard errors are less than a thousandth, so smaller differences can be significant.
MATTERS = 1 / 3
_DAMPINGS = {"c_by", "c_bz"}
_LOUD_LINE, _DOMINANT_LINE = 0.05, 0.5  # share of a foreign line in the power of a channel's random part


class Check(BaseModel, extra="forbid", frozen=True):
    """One question about the recordings, and its answer."""

    name: str = Field(description="what was asked")
    verdict: Literal["passed", "limited", "refused"]
    text: str = Field(description="the answer in a sentence, with its figures")
    advice: str = Field(default="", description="what to record or change instead; empty where nothing is needed")


def check_data(machine: MachineFile, recordings: Sequence[HealthyRecording]) -> Check:
    """Check whether there are enough data, and how much was lost."""
    told = partial(Check, name="enough data")
    hops = sum(len(one.hops) for one in recordings)
    used_s = sum(one.duration_s for one in recordings)
    refused: Counter[str] = Counter()
    for one in recordings:
        refused.update(dict(one.refused))
    gaps, missing_s = sum(one.gaps for one in recordings), sum(one.missing_s for one in recordings)
    window = machine.window
    lost = (
        "no gaps" if not gaps else f"one gap of {missing_s:.3g} s" if gaps == 1 else f"{gaps} gaps of {missing_s:.3g} s"
    )
    if refused:
        last = next(one.last_refusal for one in reversed(recordings) if one.last_refusal)
        lost += f", {sum(refused.values())} blocks refused (the latest: {last})"
    stopped_s = sum(one.stopped_s for one in recordings)
    if stopped_s:
        lost += f"; {stopped_s:.4g} s left out in which the machine stood still, ran up or coasted down"
    files = "one recording" if len(recordings) == 1 else f"{len(recordings)} recordings"
    found = f"{used_s:.4g} s of usable data in {files}; {lost}"
    wanted_s = _FEW_WINDOWS * machine.window_data_s
    advice = f"record at least {_FEW_WINDOWS * window.length_s:g} s without interruption, in one or several files"
    if hops < _FEWEST_HOPS:
        if refused:
            advice = f"import again if the channels of the machine file have changed since, or {advice}"
        return told(verdict="refused", text=f"too short: {found}", advice=advice)
    span_s = sum((one.hops[-1].end_ns - one.hops[0].start_ns) / 1e9 for one in recordings if one.hops)
    share = missing_s / span_s
    if share > _TOO_MUCH_REFUSED:
        advice = f"find out why {share:.0%} of the data are missing, and {advice}"
        return told(verdict="refused", text=f"too many gaps: {found}", advice=advice)
    # Each recording first fills the lags, which costs one hop; six windows less those hops are enough.
    lead_s = sum(one.plan.fresh / one.plan.rate_hz for one in recordings)
    if used_s + lead_s < wanted_s or share > _MUCH_REFUSED or refused:
        return told(verdict="limited", text=found, advice=advice)
    return told(verdict="passed", text=found)


def check_sensors_of(
    machine: MachineFile,
    findings: Mapping[str, Sequence[SensorFault]],
    windows: Mapping[str, Sequence[WindowStatistics]],
) -> Check:
    """Check whether a sensor was faulty during the recordings, or reached the end of its range."""
    told = partial(Check, name="sensors")
    faults: dict[tuple[str, str, tuple[str, ...]], list[str]] = {}
    for recording, found in findings.items():
        for finding in found:
            faults.setdefault((recording, finding.kind, finding.states), []).append(finding.text)
    naming = Naming(machine.sensors)
    ends = [f"{name}: {end}" for name, found in windows.items() for end in at_range_end(found, naming)]
    if not faults and ends:
        text = f"{'; '.join(ends)}: the range ends there, and stronger vibration would be clipped (data-clipped)"
        return told(verdict="limited", text=text, advice="choose a wider measuring range, and record again")
    if not faults:
        return told(verdict="passed", text="no sensor stuck, clipped, swapped, delayed or in contradiction")
    return told(
        verdict="refused",
        text="; ".join(
            f"{recording}: {texts[0]}" + (f" (in {len(texts)} windows)" if len(texts) > 1 else "")
            for (recording, _, _), texts in faults.items()
        ),
        advice="repair, re-range or rewire these sensors, or correct their units and scales, and record again: a fault "
        "must not become the healthy state",
    )


def check_speed_given(machine: MachineFile, windows: Sequence[WindowStatistics]) -> Check | None:
    """Refusal if the shaft is so fast that other windows suit it and the file does not state the speed; else None."""
    speeds = [window.speed_rad_s / (2 * np.pi) for window in windows if np.isfinite(window.speed_rad_s)]
    fastest_hz = max(map(abs, speeds), default=0.0)  # `check_steady` refuses a falling angle
    modes_hz = () if machine.rotor is None else machine.rotor.modes_hz
    stated_hz, tolerance = 0.0, 0.0
    if machine.operation is not None:
        stated_hz, tolerance = machine.operation.speed_rpm / 60, machine.operation.speed_tolerance
    suited = time_scale(modes_hz, fastest_hz) >= NEAR * time_scale(modes_hz, stated_hz)
    if suited or fastest_hz <= stated_hz * (1 + tolerance):
        return None
    return Check(
        name="window settings",
        verdict="refused",
        text=f"the shaft turns at {60 * fastest_hz:.0f} rpm, and the windows are those of a slower machine",
        advice=f"give speed_rpm = {60 * fastest_hz:.0f} in [operation] of the machine file, and where its speed varies "
        "speed_tolerance: what [window] leaves out follows from it; the recordings can stay",
    )


def check_speed_range(machine: MachineFile, windows: Sequence[WindowStatistics]) -> Check | None:
    """Refusal if no later window at the recorded speeds would be evaluated, a limit if some would not; else None."""
    operation = machine.operation
    rpm = [abs(window.speed_rad_s) * 30 / np.pi for window in windows if np.isfinite(window.speed_rad_s)]
    if operation is None or not rpm:
        return None
    outside = [one for one in rpm if abs(one / operation.speed_rpm - 1) > operation.speed_tolerance]
    if not outside:
        return None
    seen = " to ".join(dict.fromkeys(f"{one:.0f}" for one in (min(outside), max(outside))))
    slowest, fastest = (operation.speed_rpm * (1 + sign * operation.speed_tolerance) for sign in (-1, 1))
    return Check(
        name="speed range",
        verdict="refused" if len(outside) == len(rpm) else "limited",
        text=f"the machine turned at {seen} rpm, and is evaluated from {slowest:.0f} to {fastest:.0f} rpm alone: "
        "speed_rpm ± speed_tolerance of the machine file",
        advice="correct speed_rpm in [operation] of the machine file, or give a larger speed_tolerance; the recordings "
        "can stay",
    )


def check_steady(
    machine: MachineFile, recordings: Sequence[HealthyRecording], windows: Mapping[str, Sequence[WindowStatistics]]
) -> Check:
    """Check whether the shaft angle grows, and whether speed and level are steady within each recording."""
    told = partial(Check, name="stationary")
    falling = [one.name for one in recordings if any(window.speed_rad_s < 0 for window in windows[one.name])]
    if falling:
        return told(
            verdict="refused",
            text=f"{', '.join(falling)}: the shaft angle falls, expected to grow from 0 to 2π in every turn",
            advice="send 2π minus the angle; where the shaft turns from z to y, take y to point the other way, as seen "
            "from the shaft's other end",
        )
    moved = []
    for recording in recordings:
        for window in windows[recording.name]:
            slowest, fastest = window.speed_range
            if np.isfinite(slowest) and fastest - slowest > _STEADY_SPEED * window.speed_rad_s:
                rpm = 30 / np.pi
                speeds = f"{slowest * rpm:.0f} to {fastest * rpm:.0f} rpm"
                moved.append(f"{recording.name}: the speed goes from {speeds} within {window.duration_s:.3g} s")
                break
        powers = np.array([np.diag(w.as_mounted.correlation[0]) for w in windows[recording.name]])
        powers = np.maximum(powers, 0.0)  # rounding may make the power of a dead channel negative
        half = len(powers) // 2
        if half:
            ratio = np.sqrt(powers[half:].mean(axis=0) / np.maximum(powers[:half].mean(axis=0), np.finfo(float).tiny))
            worst = int(np.argmax(np.abs(np.log(np.maximum(ratio, np.finfo(float).tiny)))))
            if not 1 / _STEADY_LEVEL <= ratio[worst] <= _STEADY_LEVEL:
                channel = with_channel_names(windows[recording.name][0].as_mounted.states[worst], machine.sensors)
                moved.append(
                    f"{recording.name}: the random vibration of {channel} in the second half is "
                    f"{round(ratio[worst], 6):.2g} times that of the first"
                )
    if not moved:
        return told(verdict="passed", text="speed and level are steady within every recording")
    advice = "record in steady operation: one file for each speed or load, each of at least two windows"
    return told(verdict="refused", text="; ".join(moved), advice=advice)


def check_lines(machine: MachineFile, recordings: Sequence[HealthyRecording]) -> Check:
    """Check whether anything other than noise and the rotation excites the machine."""
    told = partial(Check, name="second excitation")
    found = [(one.name, line) for one in recordings for line in foreign_lines(one)]
    loud = [(recording, line) for recording, line in found if line.share > _LOUD_LINE]
    if not loud:
        return told(verdict="passed", text="no line stands out except those of the rotation")
    text = "; ".join(
        f"{recording}: a steady line at {line.frequency_hz:.2f} Hz makes {100 * line.share:.3g} % of the random "
        f"vibration of {with_channel_names(line.state, machine.sensors)}"
        for recording, line in loud
    )
    advice = (
        "a neighbouring machine, a gear or the mains also excites the rotor: the relations hold for noise "
        "and unbalance; record while the other machine is stopped, or exclude the line from the band"
    )
    no_angle, given = all(one.plan.angle_column is None for one in recordings), machine.operation
    orders = [2 * np.pi * line.frequency_hz / given.speed_rad_s for _, line in loud] if given else []
    if no_angle and (given is None or any(abs(one - 1) < given.speed_tolerance for one in orders)):
        cure = "measure the shaft angle" if given else "give speed_rpm in [operation], or measure the shaft angle"
        advice = f"without a phase reference this may be the rotation itself: {cure}; if it is not, {advice}"
    dominant = (no_angle and given is None) or any(line.share > _DOMINANT_LINE for _, line in loud)
    return told(verdict="refused" if dominant else "limited", text=text, advice=advice)


def check_recordings(
    machine: MachineFile, differences: Sequence[tuple[str, float, str]], speeds_rad_s: Mapping[str, float]
) -> Check | None:
    """Check whether recordings agree, each read against the relations learned from the others; None for a single one.

    `differences` are parameter, its change, and a sentence. Recordings at different speeds may differ because the
    bearings depend on the speed, which limits the diagnosis between the speeds. At one speed, differences that matter
    to no alarm, or of damping alone, only widen later intervals (`Relation.allowance`).
    """
    told = partial(Check, name="recordings agree")
    if len(speeds_rad_s) < 2:
        return None
    if not differences:
        return told(verdict="passed", text=f"the same relation holds in all {len(speeds_rad_s)} recordings")
    text = "; ".join(sentence for *_, sentence in differences)
    speeds = sorted(speeds_rad_s.values())
    if speeds[-1] <= speeds[0] * (1 + SAME_SPEED) or not np.all(np.isfinite(speeds)):
        limits = {name: MATTERS * machine.alarms.for_parameter(name).raise_above for name, *_ in differences}
        matter = {name for name, by, _ in differences if abs(by) > limits[name]}
        if not matter:
            text += ", less than a third of its alarm limit: later intervals allow for it"
            return told(verdict="passed", text=text)
        advice = (
            "the machine was not the same in all of them, or the load alters its bearing: commission on "
            "recordings of one load, or find out what changed"
        )
        if matter <= _DAMPINGS:
            return told(
                verdict="limited",
                text=f"{text}, at one speed; stiffness agrees, and later intervals allow for what differs",
                advice=f"if nothing has changed, no damping can be told under every force here; otherwise, {advice}",
            )
        return told(verdict="refused", text=f"{text}, at one speed", advice=advice)
    text += "; a baseline is kept for each speed, and nothing is evaluated between the speeds"
    advice = "record at more speeds between these if the machine runs there"
    return told(verdict="limited", text=text, advice=advice)


def check_sources(windows: Mapping[str, Sequence[WindowStatistics]]) -> Check:
    """Check whether the recordings were excited in more than one way, at level none.

    With one source every channel is a filtered copy of every other, and very different relations fit the same
    recording.
    """
    told = partial(Check, name="ways of excitation")
    alone = [recording for recording, own in windows.items() if own and all(one_source(window) for window in own)]
    if len(alone) < len(windows):
        return told(verdict="passed", text="several independent forces excite the machine")
    if not _share_source([windows[name] for name in alone]):
        text = f"a single source excites everything in each of {len(alone)} recordings; together they can tell more"
        return told(verdict="passed", text=text)
    where = "in the only recording" if len(alone) == 1 else f"in the same way in all {len(alone)} recordings"
    return told(
        verdict="limited",
        text=f"a single source excites everything, {where}: what else holds the shaft cannot "
        "be told for certain, and some later readings may be off by more than their intervals",
        advice="add a recording of another condition: another speed or load, or a time when something else "
        "shakes the machine",
    )


def _share_source(recordings: Sequence[Sequence[WindowStatistics]]) -> bool:
    """Whether recordings with one source each share it: all at one speed, and their mean spectrum shows one source."""
    speeds = [window.speed_rad_s for own in recordings for window in own if np.isfinite(window.speed_rad_s)]
    if speeds and max(speeds) > (1 + SAME_SPEED) * min(speeds):
        return False
    # Normalised, so that no window dominates the mean.
    spectra = [window.spectrum / np.einsum("fii->", window.spectrum).real for own in recordings for window in own]
    return one_source(replace(recordings[0][0], spectrum=np.mean(spectra, axis=0)))


def check_determined(reasons: Sequence[str], *, only_shapes: bool = False) -> Check:
    """Check whether the recordings determine every relation that the sensors allow; `reasons` say why not.

    With `only_shapes` there is no relation at all: each channel is only compared with its own healthy shape.
    """
    told = partial(Check, name="relations determined")
    if not reasons:
        return told(verdict="passed", text="the recordings determine every relation these sensors allow")
    advice = "measure what is missing, or record a second condition: another speed, another load, a louder machine"
    text = "; ".join(dict.fromkeys(reasons))
    if only_shapes:
        text += (
            "; at most, a natural frequency or a channel is called changed, and no part of the machine will be named"
        )
        advice += "; a machine with more than one bearing and one disc may never satisfy these relations"
    return told(verdict="limited", text=text, advice=advice)


def check_shapes(machine: MachineFile, powers: Mapping[str, ShapePower], windows: int) -> Check:
    """Check whether changes of shape can be detected with so many healthy windows, if only shapes are compared."""
    told = partial(Check, name="changes would be seen")
    names = {state: with_channel_names(state, machine.sensors) for state in powers}
    seen = {names[state]: one.growth for state, one in powers.items() if one.growth <= SEEN_GROWTH}
    blind = {names[state]: one for state, one in powers.items() if one.growth > SEEN_GROWTH}
    text = "no channel's change of shape would be reported"
    if seen:
        least = max(seen, key=seen.__getitem__)
        text = f"noise that makes a channel {seen[least]:.2g} times as loud ({least}) is reported as a changed shape"
    if not blind:
        return told(verdict="passed", text=text)
    text += (
        f"; with {windows} healthy windows not even noise that makes {', '.join(blind)} {SEEN_GROWTH:g} times as loud "
        "is reported"
    )
    wanted = max((one.windows or 0 for one in blind.values()), default=0)
    if wanted <= windows:
        advice = (
            "rely on the levels, which are compared with the healthy machine, or set limits for them yourself: the "
            "healthy signal of these channels is noise-like"
        )
        return told(verdict="limited", text=text, advice=advice)
    advice = (
        f"record about {wanted} windows, {wanted * machine.window.length_s:g} s: with fewer, a window must differ more "
        "from them to be beyond chance"
    )
    if not seen:
        advice += (
            "; or give these sensors a location of another name, such as DE, and import or record again: then levels "
            "alone are learned"
        )
    return told(verdict="limited" if seen else "refused", text=text, advice=advice)


def check_agreement(machine: MachineFile, diagnoses: Sequence[Diagnosis], what: str | None = None) -> Check:
    """Check whether healthy windows agree with the reference that they were read against.

    `what` names the reference, such as "the parameters in the machine file"; without it, that is the other half of the
    data.
    """
    name, between = "halves agree", "between the halves of the healthy data"
    if what is not None:
        name, between = f"agrees with {what}", f"between the healthy data and {what}"
    readable = [each for each in diagnoses if each.evaluable]
    if not readable:
        reasons = dict.fromkeys(reading.reason for each in diagnoses for reading in each.parameters if reading.reason)
        text = f"nothing could be compared: {'; '.join(reasons) or 'there is only one window'}"
        return Check(name=name, verdict="limited", text=text, advice="record at least two full windows")
    rate = _RATE / len(readable)
    isolations = [isolate_window(each, rate) for each in readable]
    differ = [
        (reading.name, reading.relative_change or 0.0)
        for each, one in zip(readable, isolations, strict=True)
        for reading in each.evaluable
        if reading.name in one.changed
    ]
    named = Counter(name for name, by in differ if abs(by) > MATTERS * machine.alarms.for_parameter(name).raise_above)
    outside = sum(one.outside for one in isolations)
    why = _best_explanation(machine, readable)
    if named:
        worst = named.most_common(1)[0][0]
        readings = [reading for each in readable for reading in each.evaluable if reading.name == worst]
        reading = max(readings, key=lambda one: abs(one.z or 0.0))
        text = (
            f"{PARAMETER_TEXT[worst]} differs {between}: {reading.relative_change or 0.0:+.1%}, "
            f"{abs(reading.z or 0.0):.1f} standard errors, in {named[worst]} of {len(readable)} windows{why}"
        )
        return Check(
            name=name,
            verdict="refused",
            text=text,
            advice="the machine, its operation or a sensor was not the same throughout: record again in one condition, "
            "one file for each speed or load",
        )
    if 2 * outside > len(readable):
        little = sum(one.outside and _is_little(each) for each, one in zip(readable, isolations, strict=True))
        other = outside - little > _MOST_OUTSIDE * len(readable)
        return Check(
            name=name,
            verdict="refused" if what is not None and other else "limited",
            text=f"{outside} of {len(readable)} windows differ by more than chance explains, {between}{why}",
            advice=f"check {'what explains it best, and ' if why else ''}masses and dimensions in [rotor], or give "
            "fewer parameters there, so that more is learned from the recordings",
        )
    if differ:
        worst, by = max(differ, key=lambda one: abs(one[1]))
        text = f"no difference that matters {between}: {PARAMETER_TEXT[worst]} by {by:+.1%} at most"
        return Check(name=name, verdict="passed", text=text)
    worst_z = max(abs(r.z or 0.0) for each in readable for r in each.evaluable)
    text = f"no difference {between}: at most {worst_z:.1f} standard errors in {len(readable)} windows"
    return Check(name=name, verdict="passed", text=text)


def _best_explanation(machine: MachineFile, diagnoses: Sequence[Diagnosis]) -> str:
    """The most frequent suspect, of its median size and in the names of the channels; empty without any."""
    suspects: list[tuple[str, float, str]] = []
    for each in diagnoses:
        if each.suspect:
            tried = () if each.goodness is None else each.goodness.alternatives
            best = max(tried, key=lambda one: abs(one.z), default=None)
            cause = each.suspect.partition(" (")[0]
            suspects.append((cause, 0.0 if best is None else best.change, each.suspect))
    for cause, count in Counter(one for one, _, _ in suspects).most_common(1):
        _, _, median = sorted(one for one in suspects if one[0] == cause)[count // 2]
        return f"; best explained by: {with_channel_names(median, machine.sensors)}, in {count} of them"
    return ""


def _is_little(diagnosis: Diagnosis) -> bool:
    """Whether the best explanation is a small cross-axis part or delay of a sensor, which `HealthyMisfit` takes off.

    The effect of a delay on the readings is checked before.
    """
    tried = () if diagnosis.goodness is None or diagnosis.unexplained else diagnosis.goodness.alternatives
    best = max(tried, key=lambda one: abs(one.z), default=None)
    return best is not None and abs(best.change) < {ACROSS: _LITTLE, DELAY: LEAST_DELAY_S}.get(best.quantity, 0.0)
