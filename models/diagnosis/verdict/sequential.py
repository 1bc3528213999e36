"""Sequential test: large changes at once, small ones as soon as enough data is there.

At every hop, stretches of several lengths that end now are tested: short ones inside the window, the window itself, and
sums of 2, 4, 8, … windows that do not overlap. This is a generalised likelihood ratio over dyadic lengths. Each length
has its share of the declared rate of false alarms.

A stretch that straddles a change mixes two machines, and a parameter that did not change may then read wrong. So as
soon as a short stretch and a longer one contradict each other, the change is dated, and older data no longer count:
only *clean* stretches, which begin after that date, say which parameters changed. Until one is long enough, a
straddling stretch may name one parameter, the one that stands out most. A change too small for the short stretches to
see leaves a negligible bias (of second order in the change), so sums of windows across it are used as they are.

All times are those of the data.
"""

from bisect import bisect_right
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime

import numpy as np
from scipy.special import ndtr

from models.diagnosis.misfit import Rival
from models.diagnosis.verdict.calibration import Thresholds, month_thresholds, window_thresholds
from models.diagnosis.verdict.change_point import read_changes
from models.diagnosis.verdict.isolation import Isolation, isolate, model_test, reading_of, rival_of
from models.diagnosis.verdict.sequential_state import SequentialState, finding
from models.diagnosis.verdict.stretch import Stretch, added
from models.machine import MachineFile
from models.physics.rotor import PARAMETER_TEXT, PARAMETERS
from models.signals.block import FloatArray
from rotorwatch.records.windows import Candidate, Finding, Parameter, Verdict

# Stretches, in hops, shorter than the window, in which larger changes are looked for. Their standard errors are right:
# on 150 healthy stretches of each length and either layout of sources (rotor kit, seed 301) z of no parameter scatters
# by more than 1.04.
_SHORT_HOPS = (2, 4, 7)
_DOUBLINGS = 6
# Probability that stretches of an unchanged machine contradict each other at one hop. It would cost only older data.
_CONTRADICTION_RATE = 1e-7
_PROBABLE = 0.05  # least probability with which a parameter is reported as one that may have changed
# Least distance from zero, in standard errors, of a reading astride its change; a smaller one says more about the date
# of the change than about its size, and tends to be too large.
_LEAST_ASTRIDE_ERRORS = 3.0
# Misfit, in standard deviations, below which a short stretch ends the verdict that the machine is outside the model.
_INSIDE = 2.0
_EITHER = "; or all sensors of a place have a wrong gain, which explains the data as well"


@dataclass(frozen=True, slots=True)
class SequentialSettings:
    """Lengths and declared rate."""

    hop_s: float  # data time between tests, s
    window_hops: int  # hops of a full window
    short_hops: tuple[int, ...] = _SHORT_HOPS  # hops of the short stretches, shortest first
    false_alarms_per_month: float = 1.0  # over all parameters and lengths together
    # Standard error of every parameter that more windows do not remove: an estimate relative to nominal values does not
    # become exact however long it is averaged.
    systematic: float = 0.002

    @classmethod
    def for_machine(
        cls, machine: MachineFile, per_month: float | None = None, *, short: bool = True
    ) -> "SequentialSettings":
        """Settings with which a machine is monitored, at its declared rate or at another one.

        `short` says whether stretches shorter than the window can be evaluated.
        """
        return cls(
            hop_s=machine.window.hop_s,
            window_hops=machine.window.hops,
            short_hops=tuple(hops for hops in _SHORT_HOPS if short and hops < machine.window.hops),
            false_alarms_per_month=machine.alarms.false_alarms_per_month if per_month is None else per_month,
        )

    @property
    def shape_rate(self) -> float:
        """Rate at which the shape of any channel of an unchanged machine may be called changed in one window."""
        per_month = month_thresholds(self.false_alarms_per_month, self.hop_s, self.window_hops, 1)
        return 2 * float(ndtr(-per_month.first))

    @property
    def lengths(self) -> tuple[int, ...]:
        """Hops of all stretches, shortest first."""
        return (*self.short_hops, *(self.window_hops * 2**n for n in range(_DOUBLINGS + 1)))

    def thresholds(self, hops: int) -> Thresholds:
        """Thresholds of the stretches of one length."""
        return month_thresholds(
            self.false_alarms_per_month, self.hop_s, hops, len(PARAMETERS), n_stretches=len(self.lengths)
        )


class SequentialTest:
    """Tests one hop after the other."""

    def __init__(self, settings: SequentialSettings, by: str = "likelihood") -> None:
        self.settings = settings
        self.state = SequentialState()
        # Why no parameter is named or read at the latest hop, see `Diagnosis`; empty if it is evaluable.
        self.unexplained = ""
        # The stretch that decided at the latest hop, or the window if that was shorter.
        self._decided: Stretch | None = None
        self._by = by
        self._thresholds = settings.thresholds
        self._contradiction = window_thresholds(_CONTRADICTION_RATE, len(PARAMETERS)).first
        self._slack_ns = round(settings.hop_s * 0.5e9)

    def clear(self) -> None:
        """Forget everything: the data's clock was set, or another machine is watched."""
        self.state = SequentialState()

    def wanted(self) -> tuple[int, ...]:
        """Lengths, in hops, of the short stretches worth evaluating at the next hop; each costs as much as a window.

        On an unchanged machine these are all of them; after a change, the longest clean one and the shortest, which
        shows if the change goes on.
        """
        short, state = self.settings.short_hops, self.state
        if not short:
            return ()
        windows = state.sums.get(1)
        if state.change_ns is not None and windows:
            hop_ns = self.settings.hop_s * 1e9
            next_hops = (windows[-1].end_ns - state.change_ns + self._slack_ns + hop_ns) // hop_ns
            if next_hops < self.settings.window_hops:
                longest = max((hops for hops in short if hops <= next_hops), default=short[0])
                return tuple(sorted({short[0], longest}))
        return short

    @property
    def unchanged(self) -> bool:
        """Whether no change is found and no window is astride one: `update` then needs only short ones with news."""
        return not self.state.findings and self.wanted() == self.settings.short_hops

    @property
    def astride(self) -> tuple[str, ...]:
        """Parameters found changed within the latest window."""
        windows = self.state.sums.get(1)
        return tuple(one.name for one in self.state.findings if windows and one.found_ns > windows[-1].start_ns)

    @property
    def astride_s(self) -> float:
        """For how much longer windows that are outside the model may be astride a change, s."""
        began_ns, windows = self.state.outside_ns, self.state.sums.get(1)
        if began_ns is None or not windows:
            return 0.0
        lasts_ns = round(self.settings.window_hops * self.settings.hop_s * 1e9)
        return max(0, lasts_ns - (windows[-1].end_ns - began_ns)) / 1e9

    def update(self, looks: Mapping[int, Stretch], *, foreign: bool = False, rivals: Collection[str] = ()) -> Verdict:
        """Judge one hop.

        Parameters
        ----------
        looks : mapping of int to Stretch
            Stretches that end with this hop, by their length in hops: the full window, and the short ones that are
            there. `wanted` says which suffice.
        foreign : bool
            Whether something was seen that no change of a parameter causes.
        rivals : collection of str
            Parameters whose change would explain it as well: if only such are found changed, it need not be foreign.
        """
        window_hops = self.settings.window_hops
        own = {hops: looks[hops] for hops in self.settings.short_hops if hops in looks}
        for windows, total in self._accumulate(looks[window_hops].believed()).items():
            own[windows * window_hops] = total.blurred(self.settings.systematic)
        own[window_hops] = looks[window_hops]
        self._watch_for_contradiction(own)  # without the shared error, which makes none contradict another
        # Sums of windows of two states say nothing of the machine as it is, nor of a change that one window straddles.
        every = {
            hops: look.complete().believed()
            for hops, look in own.items()
            if hops <= window_hops or self._is_clean(look)
        }
        clean = {hops: look for hops, look in every.items() if self._is_clean(look)}
        deciding = [hops for hops in clean if hops <= window_hops]
        # The model is tested on the clean data of one window at most: a straddled change would look like a misfit.
        by, unexplained, outside, confidence = None, "", False, None
        if deciding:
            by = clean[deciding[-1]]
            unexplained = by.unexplained
            outside, confidence = model_test(by, self._thresholds(deciding[-1]))
        outside = self._is_outside(outside or bool(unexplained), by, own[window_hops])
        loud = {hops: look for hops, look in every.items() if self._is_loud(hops, look)}
        found = {hops: isolate(look, self._thresholds(hops)) for hops, look in loud.items()}
        verdicts = {hops: verdict for hops, verdict in found.items() if verdict.changed}
        decided, isolation = self._decide(every, clean, verdicts)
        self._decided = max(decided, every[window_hops], key=lambda look: look.duration_s)
        if unexplained:
            # Earlier findings stay: data that say nothing neither confirm nor withdraw them.
            isolation = replace(isolation, changed=())
        else:
            self._note(isolation.changed, every, clean, verdicts)
        current = () if by is None or unexplained else self._current_readings(by, isolation.changed)
        self.unexplained = unexplained
        findings = () if unexplained else self.state.findings
        either = foreign and not outside and findings != () and {one.name for one in findings} <= set(rivals)
        isolation = replace(isolation, outside=outside or (foreign and not either), outside_confidence=confidence)
        detected = by is None or (bool(verdicts) and not unexplained)
        return Verdict(
            changed=findings,
            text=_in_words(findings, isolation, detected=detected, read=current) + either * _EITHER,
            detected=detected,
            confidence=isolation.confidence,
            candidates=() if unexplained else _candidates(isolation),
            alternatives=() if unexplained else isolation.alternatives,
            low_confidence=isolation.low_confidence or either,
            outside_model=isolation.outside,
            outside_confidence=isolation.outside_confidence,
            decided_s=decided.duration_s,
            settled=window_hops in clean and self._changed_by_ns() <= clean[window_hops].start_ns + self._slack_ns,
            current=current,
        )

    def rival(self, changed: Collection[str], rivals: Sequence[Rival]) -> str:
        """Causes outside the model that explain the latest hop as well as these changes, see `rival_of`."""
        hops = self.settings.window_hops
        return "" if self._decided is None else rival_of(self._decided, changed, rivals, self._thresholds(hops))

    def _is_loud(self, hops: int, look: Stretch) -> bool:
        """Whether a stretch may name anything: no set explains more than all parameters together."""
        explained = float(look.estimate[0] @ look.vector[list(look.known)])
        return explained > self._thresholds(hops).first ** 2

    def _accumulate(self, window: Stretch) -> dict[int, Stretch]:
        """Add the window to what is remembered; returns it and the sums of windows that end with it."""
        sums, length_ns = self.state.sums, round(self.settings.window_hops * self.settings.hop_s * 1e9)
        found, windows, total = {1: window}, 1, window
        while windows < 2**_DOUBLINGS:
            ring = sums.setdefault(windows, [])
            ring.append(total)
            while ring[0].end_ns < total.start_ns - windows * length_ns:
                ring.pop(0)
            before = bisect_right(ring, total.start_ns + self._slack_ns, key=lambda one: one.end_ns)
            if not before:
                return found
            del ring[: before - 1]  # no later sum will reach further back
            total = added([ring[0], total])
            windows *= 2
            found[windows] = total
        return found

    def _is_outside(self, said: bool, by: Stretch | None, window: Stretch) -> bool:
        """Whether the machine counts as outside the model.

        `said` is the verdict of `by`, the longest clean stretch of a window at most, if there is one. While the window
        is outside, a short stretch withdraws an earlier verdict only if it is well inside: it has little power, and
        with a few hops none. A verdict that has lasted longer than any window is astride a change is withdrawn only by
        a whole clean window: on a machine that no parameters explain, stretches contradict each other, and a short one
        decides little.
        """
        state = self.state
        if said:
            state.outside_ns = window.end_ns if state.outside_ns is None else state.outside_ns
            return True
        if state.outside_ns is not None and (by is None or by.start_ns > window.start_ns):
            lasting_s = (window.end_ns - state.outside_ns) / 1e9
            whole = model_test(window, self._thresholds(self.settings.window_hops))[0] or bool(window.unexplained)
            doubtful = by is not None and (by.misfit_z is None or by.misfit_z > _INSIDE)
            if (whole and doubtful) or lasting_s >= self.settings.window_hops * self.settings.hop_s:
                return True
        if by is not None:
            state.outside_ns = None
        return False

    def _is_clean(self, look: Stretch) -> bool:
        change_ns = self.state.change_ns
        return change_ns is None or look.start_ns >= change_ns - self._slack_ns

    def _watch_for_contradiction(self, every: Mapping[int, Stretch]) -> None:
        """Date a change if a stretch contradicts a longer clean one that contains it.

        A stretch that the model explains also contradicts a longer one that it does not: that one mixes two machines.
        """
        clean = [(hops, look) for hops, look in every.items() if self._is_clean(look)]
        values = [_values(look) for _, look in clean]
        for at, (hops, short) in enumerate(clean):
            if hops > self.settings.window_hops:
                return
            explained = short.known and not short.unexplained and not model_test(short, self._thresholds(hops))[0]
            worst = _differences(values[at], values[at + 1 :])
            for (_, longer), whole, differs in zip(clean[:at:-1], values[:at:-1], worst[::-1], strict=True):
                if differs > self._contradiction or (explained and longer.unexplained):
                    inside = hops < self.settings.window_hops
                    self.state.change_ns = short.end_ns if inside else short.start_ns
                    self.state.dated_ns = short.end_ns
                    if not longer.unexplained:
                        self.state.before = tuple(whole[0].tolist())
                    return

    def _decide(
        self, every: Mapping[int, Stretch], clean: Mapping[int, Stretch], verdicts: Mapping[int, Isolation]
    ) -> tuple[Stretch, Isolation]:
        """The stretch that decides which parameters changed: the longest clean one that names any.

        One with no name in common with a shorter one is left out: it holds older data, in which a gradual change looks
        like a change of another parameter with correlated errors.
        """
        names: list[set[str]] = []
        decided = None
        for hops in sorted(clean):
            if hops in verdicts and all(before & set(verdicts[hops].changed) for before in names):
                decided = clean[hops], verdicts[hops]
                names.append(set(verdicts[hops].changed))
        if decided is not None:
            return decided
        for hops, look in every.items():
            if hops not in clean and hops in verdicts:
                leader = self._leader(look, verdicts[hops], clean)
                if leader is not None:
                    return look, leader
        shown = self.settings.window_hops if self.settings.window_hops in clean else min(clean, default=min(every))
        verdict = isolate(every[shown], self._thresholds(shown))
        return every[shown], replace(verdict, changed=())  # nothing that a straddling stretch names is believed

    def _leader(self, look: Stretch, verdict: Isolation, clean: Mapping[int, Stretch]) -> Isolation | None:
        """What a straddling stretch may name: the parameter that moved most, if it moved away from nominal.

        A parameter on its way back to nominal reads as changed for as long as the stretch holds old data. A stretch
        that no single machine explains names nothing: with one source of force, all its readings are far outside their
        errors, and the one that stands out may not be the parameter that changed.
        """
        if verdict.outside:
            return None
        before = np.array(self.state.before)
        values, variances = _values(look)
        most = int(np.argmax(np.abs(values - before) / np.sqrt(variances)))
        if PARAMETERS[most] not in verdict.changed or abs(values[most]) < abs(before[most]):
            return None
        if clean:
            now, now_variances = _values(clean[max(clean)])
            if abs(now[most] - values[most]) > self._contradiction * np.sqrt(now_variances[most]):
                return None
        return replace(verdict, changed=(PARAMETERS[most],))

    def _note(
        self,
        changed: tuple[str, ...],
        every: Mapping[int, Stretch],
        clean: Mapping[int, Stretch],
        verdicts: Mapping[int, Isolation],
    ) -> None:
        """Keep when each changed parameter was first found; forget findings that no longer hold."""
        known = {one.name: one for one in self.state.findings}
        found = {name: known[name] for name in known if name in changed or self._still_holds(known[name], clean)}
        for name in changed:
            if name not in known:
                by = [every[hops] for hops, verdict in verdicts.items() if name in verdict.changed]
                # A change that the first window shows may be as old as that window; a later change has just come.
                first = self.state.change_ns is None and len(self.state.sums[1]) == 1
                look = by[-1 if first else 0]
                found[name] = finding(name, look.start_ns, look.end_ns, look.duration_s)
        self.state.findings = tuple(found[name] for name in PARAMETERS if name in found)

    def _still_holds(self, earlier: Finding, clean: Mapping[int, Stretch]) -> bool:
        """Whether an earlier finding still holds: there is no whole clean window yet, and the clean data agree.

        What was found while the change came may be an effect of data of both states: clean data have to name it, too.
        """
        if self.settings.window_hops in clean:
            return False
        if not clean:
            return True
        if earlier.found_ns > (self.state.dated_ns or 0) - min(self.settings.lengths) * self.settings.hop_s * 1e9:
            return False
        at = PARAMETERS.index(earlier.name)
        values, variances = _values(clean[max(clean)])
        return bool(abs(values[at] - self.state.before[at]) < self._contradiction * np.sqrt(variances[at]))

    def _current_readings(self, look: Stretch, changed: tuple[str, ...]) -> tuple[Parameter, ...]:
        """Free readings of a stretch; those of changed parameters are means over what else may have changed."""
        values, covariance = look.estimate
        errors = np.sqrt(np.diag(covariance)).tolist()
        read = {name: (value, error) for name, value, error in zip(look.names, values.tolist(), errors, strict=True)}
        named = [i for i in look.known if PARAMETERS[i] in changed]
        by_ns, hop_ns = self._changed_by_ns(), round(self.settings.hop_s * 1e9)
        windows = [one for one in self.state.sums[1] if one.known == look.known]
        astride = bool(windows) and windows[-1].end_ns == look.end_ns and windows[-1].start_ns < by_ns - self._slack_ns
        if named and astride:
            # A window of both states that does not fit, as with narrow resonances, does not read in proportion to them.
            most = self.settings.thresholds(self.settings.window_hops).outside
            fit = next((n for n, one in enumerate(windows) if (one.misfit_z or 0.0) > most), len(windows) - 1)
            sizes, spreads, since_ns = read_changes([*windows[:fit], windows[-1]], named, hop_ns, by_ns)
            self._date(changed, since_ns)
        inside = astride and look.start_ns == windows[-1].start_ns
        if named and not inside:
            sizes, spreads, _ = read_changes([look], named, hop_ns, look.start_ns)
        for at, i in enumerate(named):
            value, error = float(sizes[at]), float(spreads[at])
            if inside and abs(value) < _LEAST_ASTRIDE_ERRORS * error:
                del read[PARAMETERS[i]]
            else:
                read[PARAMETERS[i]] = value, error
        return tuple(reading_of(look, name, self._by, value, error) for name, (value, error) in read.items())

    def _changed_by_ns(self) -> int:
        """When all that is found had changed at the latest: the end of the stretch that dated it, or found it later."""
        dated = self.state.dated_ns or 0
        later = [one.found_ns for one in self.state.findings if one.found_ns - one.stretch_s * 1e9 > dated]
        return max(dated, *later, 0)

    def _date(self, changed: tuple[str, ...], since_ns: tuple[int, int, int] | None) -> None:
        """Date the changed parameters; one that was found before that moment changed earlier and keeps its date."""
        if since_ns is not None:
            dates = {"since_ns": since_ns[0], "between_ns": since_ns[1:]}
            self.state.findings = tuple(
                one.model_copy(update=dates) if one.name in changed and one.found_ns >= since_ns[0] else one
                for one in self.state.findings
            )


def _candidates(isolation: Isolation) -> tuple[Candidate, ...]:
    """Parameters that may be among the changed ones."""
    likely = sorted(zip(isolation.probability, PARAMETERS, strict=True), key=lambda one: -one[0])
    return tuple(
        Candidate(name=name, text=PARAMETER_TEXT[name], probability=probability)
        for probability, name in likely
        if probability >= _PROBABLE
    )


def _in_words(findings: Sequence[Finding], isolation: Isolation, *, detected: bool, read: Sequence[Parameter]) -> str:
    if findings:
        found = ", ".join(
            f"{one.text} ({one.name}) since {_clock(one.since_ns)}, found {_clock(one.found_ns)} in "
            f"{one.stretch_s:.0f} s of data"
            for one in findings
        )
        # Never printed as 100.0 %.
        sure = "above 99.9 %" if isolation.confidence > 0.9995 else f"{100 * isolation.confidence:.1f} %"
        within = " among changes of parameters" if isolation.outside else ""
        text = f"changed: {found}; confidence {sure}{within}"
    elif detected:
        text = "something has changed; too little data yet to say what"
    else:
        known = {one.name for one in read} | ({"EI"} if any(one.by == "baseline" for one in read) else set())
        unread = ", ".join(name for name in PARAMETERS if name not in known)  # without parameters no shaft is read
        text = f"nothing has changed{unread and f'; not read: {unread}'}" if read else "no parameter could be read"
    if isolation.outside:
        text += "; outside the model: something has changed that no parameter describes, or a sensor is at fault"
    return text


def _clock(time_ns: int) -> str:
    return f"{datetime.fromtimestamp(time_ns // 10**9, UTC):%H:%M:%S}"


def _differences(part: tuple[FloatArray, FloatArray], wholes: Sequence[tuple[FloatArray, FloatArray]]) -> list[float]:
    """Largest difference of a stretch from each that contains it, in standard errors of the difference.

    The variance of the difference between a part and the whole is the difference of their variances (Hausman), but at
    least half of the part's variance, because both variances are estimates.
    """
    if not wholes:
        return []
    values, variances = np.array([one[0] for one in wholes]), np.array([one[1] for one in wholes])
    common = np.isfinite(part[1]) & np.isfinite(variances)
    spread = np.maximum(part[1] - np.where(common, variances, 0.0), part[1] / 2)
    differs: FloatArray = np.max(np.abs(part[0] - values) / np.sqrt(spread), axis=1, initial=0.0, where=common)
    return list(differs.tolist())


def _values(look: Stretch) -> tuple[FloatArray, FloatArray]:
    """Values and variances of all `PARAMETERS`; 0 and infinity for what was not evaluable."""
    values, variances = np.zeros(len(PARAMETERS)), np.full(len(PARAMETERS), np.inf)
    known, (found, covariance) = list(look.known), look.estimate
    values[known], variances[known] = found, np.diag(covariance)
    return values, variances
