"""Whether the theory explains a window (if not, parameters fitted to it mean nothing), and what else would explain it.

At the maximum of the likelihood, deviations for which the model has no parameter are tested by their scores (C. R. Rao,
Proc. Cambridge Phil. Soc. 44 (1948)): gain and delay of every channel, its sensitivity to the other plane, masses, and
a shaft stiffer in one plane than in the other. Each score is standard normal where the model holds, and its one-step
estimate gives the size of the deviation. What none of them explains shows in the total excess of the estimated over the
theoretical spectra.
"""

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from models.diagnosis.likelihood.scoring import Maximum, Weights, Whitened, inverse_factor
from models.diagnosis.likelihood.spectral_model import IDENTITY, STRUCTURAL, Sides, SpectralModel, packed, twice_packed
from models.diagnosis.misfit import ACROSS, DELAY, EACH_LATE, UNEQUAL, AlternativeTest, Goodness
from models.diagnosis.readings import beyond
from models.physics.rotor import PARAMETER_TEXT, STATE_INDEX, Q_shaft
from models.signals.block import BoolArray, ComplexArray, FloatArray, IndexArray
from models.signals.channels import Channel, parts_seen, state_name

# Signs for the elements of the dynamic matrix: +1 where they couple motions in y, -1 where they couple motions in z.
_SIGNS = np.kron([[1.0, 0.0], [0.0, -1.0]], np.ones((3, 3)))
# Degree of freedom in y that each acts on; the one in z is three further on.
_MASSES = {"mass at the bearing": 0, "mass of the disc": 1, "inertia of the disc": 2}
_OTHER_PLANE = str.maketrans("yz", "zy")
# Least share of an alternative's information that the model's parameters leave; with less the two cannot be told apart.
_LEAST_INFORMATION = 1e-4


def goodness_of_fit(
    model: SpectralModel, weights: Weights, found: Maximum, states: ComplexArray, dispersion: float = 1.0
) -> Goodness:
    """Test the alternatives at the maximum of one window.

    `states` are the estimated cross-spectra of the states, SI, shape (n_groups, n_states, n_states); with them,
    displacement and velocity are also compared with each other. The spectra scatter by `dispersion` times the variance
    that Gaussian excitation gives them.
    """
    names, slopes = _alternatives(model, found)
    score, left, told, _ = beyond_parameters(model, weights, found, slopes)
    alternatives = tuple(
        AlternativeTest(name, float(s / np.sqrt(i)), float(s / i))
        for name, s, i, sure in zip(names, score, left, told, strict=True)
        if sure
    )
    mismatches = model.motions.mismatches(states, model.centre, weights.averages)
    pairs = [_named(*mismatch, {one.name: one for one in alternatives}) for mismatch in mismatches]
    # The two gains of a pair are nearly one test, and a pair's mismatch is hardly random; the total excess adds one.
    tests = len(alternatives) - len(pairs) + 1
    total, expected, scatter = total_excess(model, weights, found)
    over = total - dispersion * expected
    return Goodness(over / (dispersion * scatter), (*alternatives, *pairs), tests, over)


def total_excess(model: SpectralModel, weights: Weights, found: Maximum) -> tuple[float, float, float]:
    """Σ ν ‖L⁻¹ŜL⁻ᴴ - I‖², and its expectation and standard deviation where the model holds.

    The groups give the scatter of every element; each fitted parameter takes one off the sum.
    """
    shared, excess = model.groups.shared, found.whitened.excess
    total = float(weights.averages @ np.einsum("fij,fji->f", excess, excess).real)
    scatter = float(model.n * np.sqrt(2 * np.sum(shared**2)))
    return total, model.n**2 * float(np.trace(shared)) - found.fitted, scatter


def beyond_parameters(
    model: SpectralModel, weights: Weights, found: Maximum, slopes: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray, FloatArray]:
    """What the model's parameters leave of deviations with these packed slopes, (n_deviations, n_groups, n²).

    These are the scores and the information on the deviations, each (n_deviations,); whether that information is more
    than rounding; and the changes of parameters that imitate the deviations, (n_deviations, size).
    """
    seen, weight = packed(found.whitened.excess), weights.averages[:, None]
    flat = found.derivatives.slopes.reshape(model.size, -1)
    weighted = (slopes * weight).reshape(len(slopes), -1)
    cross = weighted @ flat.T
    imitated = np.asarray(np.linalg.solve(found.information, cross.T).T, dtype=np.float64)
    score = weighted @ seen.ravel() - imitated @ (flat @ (seen * weight).ravel())
    alone = np.einsum("af,af->a", weighted, slopes.reshape(len(slopes), -1))
    left = alone - np.einsum("ap,ap->a", imitated, cross)
    return score, left, left > _LEAST_INFORMATION * alone, imitated


def _named(
    states: tuple[str, str], change: float, z: float, alternatives: dict[str, AlternativeTest]
) -> AlternativeTest:
    """Attribute a mismatch of displacement and velocity to the one whose gain explains the window better."""
    x, v = (f"gain of {state}" for state in states)
    z_x, z_v = (abs(alternatives[name].z) if name in alternatives else 0.0 for name in (x, v))
    if z_x > z_v:
        return AlternativeTest(x, z, 1 / (1 + change) - 1, states)
    return AlternativeTest(v, z, change, states)


def _alternatives(model: SpectralModel, found: Maximum) -> tuple[list[str], FloatArray]:
    """Names and packed slopes of all alternatives, shape (n_alternatives, n_groups, n²)."""
    point, L_inverse = found.whitened.point, found.whitened.L_inverse
    names, of_sensors = _of_sensors(model, L_inverse, point.S @ L_inverse.conj().swapaxes(1, 2))
    slopes = list(of_sensors)
    w2 = (2 * np.pi * model.groups.nodes_hz) ** 2
    rotor, sides = model.machine.rotor, Sides(point, L_inverse)
    for (name, first), mass in zip(_MASSES.items(), (rotor.m1_kg, rotor.m2_kg, rotor.I2_kg_m2), strict=True):
        names.append(name)
        slopes.append(sides.slope(mass * w2, slice(first, None, 3)))
    shaft = Q_shaft(rotor) * np.exp(found.theta[STRUCTURAL.index("EI")])
    names.append(UNEQUAL)
    slopes.append(sides.slope(-np.ones_like(w2), change=shaft * _SIGNS))
    return names, np.stack(slopes)


def _of_sensors(model: SpectralModel, L_inverse: ComplexArray, coloured: ComplexArray) -> tuple[list[str], FloatArray]:
    """Names and packed slopes of sensor errors: gain, sensitivity to the other plane, and delay.

    `coloured` is SL⁻ᴴ.
    """
    motions, w = model.motions, model.centre
    names, at_once, weights, by, shown, into = _tried(tuple(model.machine.sensors), motions.states)
    shares, factor = motions.shares(w), motions.factor(w, w)
    share = np.stack([shares[state][1] for state in motions.states])[by]
    seen = (share * (factor[:, into] / factor[:, shown]).T)[..., None] * coloured.swapaxes(0, 1)[shown]
    sides = L_inverse.transpose(2, 0, 1)[into][..., None] * seen[:, :, None]
    immediate = np.tensordot(weights[:at_once], twice_packed(sides), axes=1)
    delayed = np.tensordot(weights[at_once:], twice_packed((-1j * w)[:, None, None] * sides), axes=1)
    return [*names], np.concatenate([immediate, delayed])


@lru_cache(maxsize=64)
def _tried(
    channels: tuple[Channel, ...], states: tuple[str, ...]
) -> tuple[tuple[str, ...], int, FloatArray, IndexArray, IndexArray, IndexArray]:
    """Sensor errors to test: their names, how many of them (the first ones) are not delays, and their weights.

    Weights are of shape (n_names, n_entries). Each entry's state, the motion it shows, and its own motion follow.
    """
    of = np.array([STATE_INDEX[state] % 6 for state in states])
    dofs, numbers = np.unique(of, return_inverse=True)
    own, alone = np.eye(dofs.size)[numbers], np.eye(numbers.size)
    tried = {f"gain of {state}": one[:, None] * own for state, one in zip(states, alone, strict=True)}
    # A sensor that is turned, or sensitive across its axis, shows part of the other plane's motion at its place.
    across = (of[:, None] + 3) % 6 == dofs
    for state, one, other in zip(states, alone, across, strict=True):
        if other.any():
            tried[f"{ACROSS} of {state.translate(_OTHER_PLANE)} in {state}"] = np.outer(one, other)
    late = {name: delay @ own for name, delay in _delays(channels, states).items()}
    weights = np.stack([*tried.values(), *late.values()])
    by, shown = np.nonzero(weights.any(axis=0))
    return (*tried, *late), len(tried), weights[:, by, shown], by, shown, numbers[by]


def _delays(channels: Sequence[Channel], states: Sequence[str]) -> dict[str, FloatArray]:
    """Delays by name: the part of each state (row) that is a late part of a state (column), (n_states, n_states).

    Either one channel is late, or each is a little later than the one before, as from a multiplexed converter.
    """
    measured = {part for channel in channels for part in parts_seen(channel)}
    sources = [state if state in measured else state.replace("_dot", "_ddot") for state in states]  # integrated
    seen = np.array([[parts_seen(channel).get(source, 0.0) for source in sources] for channel in channels])
    late = np.linalg.pinv(seen).T[:, :, None] * seen[:, None]
    single = {f"{DELAY} of {state_name(one)}": made for one, made in zip(channels, late, strict=True) if made.any()}
    in_turn = {EACH_LATE: np.tensordot(np.arange(len(late)), late, axes=1)} if len(single) > 2 else {}
    return single | in_turn


# Largest change of a stiffness or damping that the model is believed to describe: a factor of five.
_MOST_LOG_RATIO = float(np.log(5))
# Mean squared excess over its expectation beyond which there is no maximum to follow: the next search starts cold.
_MOST_EXCESS = 100.0
# Largest deviation of the spectra from the theory (relative rms, without sampling error) at which readings are valid.
# However the model's parameters change, it stays below 0.05; a rub or a small mass causes up to 0.17.
_MOST_DEVIATION = 0.2
_SKIRTS = 2  # groups on either side into which a line spreads
# The same where a parameter reads as changed by more than a factor of two: a rub or a mass hardly moves the parameters,
# so a real change of that size must explain the window.
_LARGE, _MOST_DEVIATION_LARGE = float(np.log(2)), 0.1
# Largest share of the motion attributed to sensor noise although displacement and velocity agree on it. Beyond it, a
# spectrum without resonances has been taken for coloured noise, and the remainder fits any rotor.
_MOST_NOISE = 0.3
_UNSHARED = 5.0  # how many times more noise one sensor of a pair may have than the other
# Misfit that is not chance, and the factor by which the standard errors of most parameters may then exceed those on the
# nominal rotor. Within the model the factor stays below three; a line mistaken for the one resonance of a softer shaft
# leaves the bearings undetermined.
MOST_MISFIT, _BLIND = 4.0, 10.0


def unexplained_at(
    model: SpectralModel,
    weights: Weights,
    reached: Whitened,
    states: ComplexArray,
    times: float = 1.0,
    dispersion: float = 1.0,
) -> tuple[str, bool]:
    """Why readings at this point mean nothing, else empty; and whether nothing in the model comes near the window.

    `states` are the estimated cross-spectra of the states, SI, shape (n_groups, n_states, n_states); the limits are
    multiplied by `times`. For `dispersion` see `goodness_of_fit`.
    """
    excess, point, bins = reached.excess, reached.point, model.groups.bins
    squared = np.einsum("fij,fij->f", excess, excess.conj()).real / model.n**2
    deviation = max(0.0, float(np.mean(squared - dispersion / weights.averages))) ** 0.5
    far = bool(np.mean(weights.averages * squared) > times * _MOST_EXCESS)
    worst = int(np.argmax(np.abs(point.theta[: len(STRUCTURAL)])))
    log_ratio = float(point.theta[worst])
    impossible = abs(log_ratio) > times * _MOST_LOG_RATIO
    most = _MOST_DEVIATION if abs(log_ratio) <= _LARGE else _MOST_DEVIATION_LARGE
    if far or deviation > times * most:
        (text, limit), line = beyond(100 * deviation, 100 * most), ""
        where = int(squared.argmax())
        there = slice(max(0, where - _SKIRTS), where + _SKIRTS + 1)
        if 2 * squared[there].sum() > squared.sum():
            line = f", most of it at {model.groups.centre_hz[where]:.3g} Hz"
        why = f"its spectra deviate from it by {text} % (rms, without sampling error){line}, evaluation limit {limit} %"
        return why, far or impossible
    # Noise is a sensor's own: what both sensors of a motion show is motion, here motion that the theory cannot explain.
    shared = np.maximum(model.noise(point.theta) - _UNSHARED * model.motions.rest(states, model.centre), 0)
    share = float(np.mean(bins @ shared / (bins @ np.einsum("fii->fi", point.S).real)))
    if share > times * _MOST_NOISE:
        text, limit = beyond(100 * share, 100 * _MOST_NOISE)
        why = f"{text} % of what pairs of sensors have in common would be noise of each, evaluation limit {limit} %"
        return why, impossible
    if not impossible:
        return "", False
    extreme = math.exp(math.copysign(_MOST_LOG_RATIO, log_ratio))
    text, limit = beyond(max(math.exp(min(log_ratio, math.log(1e6))), 1e-6), extreme)
    side = "at least" if extreme < 1 else "at most"
    return f"{PARAMETER_TEXT[STRUCTURAL[worst]]} would be {text} times nominal, evaluated is {side} {limit} times", True


def unseen(model: SpectralModel, weights: Weights, found: Maximum, misfit_z: float) -> str:
    """Say which parameters this window hardly shows but one of the nominal rotor would; empty if at most half of those.

    Despite a misfit, readings mean something while the rotor is visible: they are those of the nearest rotor.
    """
    n = len(STRUCTURAL)
    usual = weights.centre.copy()
    usual[model.level_at] = IDENTITY
    point = model.at(usual, found.whitened.point.speed_rad_s)
    slopes = model.slopes(point, inverse_factor(point.S)) * np.sqrt(weights.averages)[:, None]
    flat = slopes.reshape(model.size, -1)
    expected, read = (
        np.sqrt(np.diag(np.linalg.inv(information))[:n])
        for information in (flat @ flat.T + np.diag(weights.pull), found.information)
    )
    seen = expected < 1 / _BLIND  # determined by these sensors at all
    lost = seen & ~(read < _BLIND * expected)
    if 2 * np.count_nonzero(lost) <= np.count_nonzero(seen):
        return ""
    text, limit = beyond(misfit_z, MOST_MISFIT)
    names = ", ".join(PARAMETER_TEXT[name] for name, missing in zip(STRUCTURAL, lost, strict=True) if missing)
    return (
        f"it hardly shows the rotor's {names}, and it deviates from the theory by {text} standard errors, the limit "
        f"for evaluation is then {limit}"
    )
