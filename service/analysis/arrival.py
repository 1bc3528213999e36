"""Examines a machine's stream as it arrives, without a monitor."""

from collections import defaultdict
from collections.abc import Collection, Sequence

import numpy as np

from models.arrivals import Senders
from models.commissioning.commissioned import Installed
from models.descriptor import descriptor_mismatch
from models.diagnosis.sensors.missing import MissingNumbers
from models.diagnosis.window.moments import plan_for
from models.errors import WireError
from models.ingest import Admission, Gate
from models.levels.measures import hop_levels, window_levels
from models.machine import MachineFile
from models.signals.block import SampleBlock
from models.signals.recording import RecordedMessage
from models.signals.waveform import waveform_of
from models.signals.wire import decode_block
from rotorwatch.records.levels import three_digits
from service.analysis.revolutions import Excerpt
from service.monitor.conversion import rfc3339
from service.monitor.levels import LevelWatch

_MOST_BREAKS = 3
"""Most breaks in the stream that are reported individually."""

_LARGEST_ZONE_H, _CLOSE_TO_ZONE_S = 14, 60.0
"""A clock that differs by a quarter of an hour or a multiple, up to this and within this, may show local time."""


def examined(
    machine: MachineFile, messages: Sequence[RecordedMessage], others: Collection[str] = ()
) -> tuple[list[str], list[str]]:
    """What arrives under a machine's keys, in words, and what is missing or differs from the machine file.

    The messages are given in order of arrival; `others` are the keys of other streams.
    """
    place, keys = machine.title, machine.keys
    troubles: list[str] = []
    announced = [one.payload for one in messages if one.key == keys.descriptor]
    if not announced:
        troubles.append(
            "no channel descriptor was announced in this time, and no publisher answers a query for it (docs/wire.md): "
            "names and units of the channels cannot be compared"
        )
    troubles += descriptor_mismatch(announced[-1], machine) if announced else ()
    stream = [one for one in messages if one.key == keys.stream]
    if not stream:
        keys_heard = sorted({*others, *(one.key for one in messages)})
        heard = f"; heard were {', '.join(keys_heard)}" if keys_heard else ""
        return [f"{place}: no sample blocks"], [f"nothing arrived under {keys.stream}{heard}", *troubles]
    gate, missing, senders = Gate(machine, partial=True), MissingNumbers(machine.sensors), Senders()
    refused, rates = defaultdict[str, list[str]](list), set[float]()
    accepted: list[SampleBlock] = []
    breaks: list[Admission] = []
    for message in stream:
        try:
            block = decode_block(message.payload, message.attachment, message.encoding)
        except WireError as error:
            refused["malformed"].append(f"it cannot be decoded: {error}")
            continue
        rates.add(block.rate_hz)
        senders.take(block)
        verdict = gate.judge(block)
        if not verdict.accepted:
            refused[str(verdict.reason)].append(verdict.text)
            continue
        if not verdict.continuous:
            breaks.append(verdict)
        if not verdict.continuous or verdict.new_snapshot:
            accepted.clear()
        accepted.append(missing.take(block))
    if senders.conflict:
        troubles.append(f"two publishers contradict each other: {senders.conflict}")
    troubles += _of_breaks(breaks)
    troubles += [f"{len(texts)} blocks would be refused, for example: {texts[0]}" for texts in refused.values()]
    lines = [f"{place}: {len(stream)} sample blocks, {len(stream) - sum(map(len, refused.values()))} of them usable"]
    if rates:
        found = ", ".join(f"{rate:g}" for rate in sorted(rates))
        lines.append(f"sampling rate {found} Hz, expected {machine.rate_hz:g}")
    if accepted:
        troubles += [fault.text for fault in missing.found(accepted[0].start_ns, accepted[-1].end_ns)]
        ahead_s = (accepted[-1].end_ns - stream[-1].log_time_ns) / 1e9
        clocks = "ahead of" if ahead_s > 0 else "behind"
        newest = rfc3339(accepted[-1].end_ns)
        # Not a trouble: simulators and replays may be anywhere in time.
        hours = round(ahead_s / 900) / 4
        local = 0 < abs(hours) <= _LARGEST_ZONE_H and abs(ahead_s - 3600 * hours) < _CLOSE_TO_ZONE_S
        zone = f": perhaps local time (by {abs(hours):g} h), expected UTC" if local else ""
        lines.append(f"newest sample of {newest}, {three_digits(abs(ahead_s))} s {clocks} this computer's clock{zone}")
        lines += _of_samples(machine, accepted, troubles)
    return lines, troubles


def _of_breaks(breaks: Sequence[Admission]) -> list[str]:
    """Describe where a block does not follow the previous one: all in one sentence, then the first ones."""
    told = [one.text for one in breaks[:_MOST_BREAKS]]
    if len(breaks) <= _MOST_BREAKS:
        return told
    missing_s = sum(one.gap_s for one in breaks)
    many = f"{len(breaks)} times a block does not follow the previous one; {missing_s:.3g} s of data are missing"
    return [f"{many}, for example:", *told]


def _of_samples(machine: MachineFile, blocks: Sequence[SampleBlock], troubles: list[str]) -> list[str]:
    """Describe duration, speed and levels of consecutive blocks; append what is wrong with them to `troubles`."""
    plan = plan_for(machine, levels=True)
    samples = plan.to_si(np.concatenate([block.samples for block in blocks]))
    duration_s = (blocks[-1].end_ns - blocks[0].start_ns) / 1e9
    what = "without a gap" if machine.schedule is None else "in the latest snapshot"
    # Blocks may each begin within the tolerance and still drift away from the rate, the shorter the further.
    first_to_last_s = (blocks[-1].start_ns - blocks[0].start_ns) / 1e9
    counted = sum(len(block.samples) for block in blocks[:-1])
    off_s = first_to_last_s - counted / machine.rate_hz
    if abs(off_s) > 2 * machine.ingest.time_tolerance_s + machine.ingest.rate_tolerance * first_to_last_s:
        troubles.append(
            f"by their time stamps, {counted / first_to_last_s:.6g} samples come in a second, expected "
            f"{machine.rate_hz:g}: speed and frequencies are wrong by {off_s / first_to_last_s:.2%}, or start_ns does "
            "not come from counting samples"
        )
    lines = [f"{duration_s:.3g} s {what}, in blocks of {np.median([len(one.samples) for one in blocks]):g} samples"]
    speed, angle = np.nan, None
    if plan.angle_column is None:
        lines.append("no shaft angle (keyphasor): no phases, and 1x only near a known speed")
    else:
        angle = samples[:, -1]
        speed = Excerpt(blocks[0].start_ns, plan.rate_hz, samples, angle).speed_rad_s
        lines.append(f"keyphasor: the shaft turns at {abs(speed) * 30 / np.pi:.1f} rpm")
        if abs(speed) < np.pi:
            troubles.append(
                f"the shaft angle does not turn; it is between {angle.min():.3g} and {angle.max():.3g} rad: the "
                "machine stands still, the keyphasor gives no pulses, or its signal is sent instead of an angle from 0 "
                "to 2 pi"
            )
    if plan.levels is None:
        return lines
    vibration = samples[:, : plan.columns.size]
    hop = hop_levels(plan.levels, *waveform_of(vibration), angle)
    found = window_levels(plan.levels, [hop], np.array([speed]), phase_reference=angle is not None, errors=False)
    watch = LevelWatch(plan, machine, Installed(machine))
    lines += [f"  {channel.text}" for channel in watch.judged(found)]
    for column, name in enumerate(machine.sensors[at].name for at in plan.columns):
        if np.ptp(vibration[:, column]) == 0:
            troubles.append(f"{name} shows no signal: a sensor that is not connected, or a range far too wide")
    return lines
