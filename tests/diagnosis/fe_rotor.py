"""A rotor of finite elements, for tests of what must not depend on the six-degree-of-freedom model.

Euler-Bernoulli beam elements in two planes, discs with gyroscopic terms, bearings with springs and dampers, some
damping of the shaft itself. Forces are coloured noise, held over a sample; the discretisation is exact for them.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm
from scipy.signal import lfilter

from models.diagnosis.moments import Plan
from models.diagnosis.window import SlidingWindow, WindowStatistics
from models.signals.block import FloatArray

RATE_HZ = 2000.0
STATES = ("y1", "y2", "z1", "z2", "y1_dot", "y2_dot", "z1_dot", "z2_dot")
ACCELERATIONS = ("y1_ddot", "y2_ddot", "z1_ddot", "z2_ddot")
COLUMNS = (*STATES, *ACCELERATIONS)


@dataclass(frozen=True)
class Rotor:
    """Nodes are equally spaced; bearing and disc that are measured come first in their tuples."""

    length_m: float = 0.5
    elements: int = 5
    diameter_m: float = 0.014
    bearings: tuple[int, ...] = (3, 0)
    k_y: tuple[float, ...] = (2.0e5, 6.0e5)
    k_z: tuple[float, ...] = (2.6e5, 6.0e5)
    c_y: tuple[float, ...] = (150.0, 100.0)
    c_z: tuple[float, ...] = (150.0, 100.0)
    housing_kg: float = 0.4
    discs: tuple[int, ...] = (5, 1)
    disc_kg: tuple[float, ...] = (1.5, 0.8)
    disc_radius_m: tuple[float, ...] = (0.06, 0.05)
    shaft_damping_s: float = 2.0e-5
    unbalance_kg_m: float = 1.5e-5
    speed_rad_s: float = 2 * np.pi * 24.0


@dataclass(frozen=True)
class Excitation:
    cutoff_hz: float = 80.0
    sources: tuple[tuple[float, float, float, float], ...] = ((0.6, 0.5, 0.4, -0.5),)
    """Force of each source at bearing y, disc y, bearing z, disc z."""
    level_N: float = 4.0


INDEPENDENT = ((0.7, 0, 0, 0), (0, 0.5, 0, 0), (0, 0, 0.6, 0), (0, 0, 0, 0.8))


def _element(length: float, EI: float, mass_per_m: float) -> tuple[FloatArray, FloatArray]:
    L = length
    stiffness = [
        [12, 6 * L, -12, 6 * L],
        [6 * L, 4 * L**2, -6 * L, 2 * L**2],
        [-12, -6 * L, 12, -6 * L],
        [6 * L, 2 * L**2, -6 * L, 4 * L**2],
    ]
    mass = [
        [156, 22 * L, 54, -13 * L],
        [22 * L, 4 * L**2, 13 * L, -3 * L**2],
        [54, 13 * L, 156, -22 * L],
        [-13 * L, -3 * L**2, -22 * L, 4 * L**2],
    ]
    return mass_per_m * L / 420 * np.array(mass), EI / L**3 * np.array(stiffness)


def matrices(rotor: Rotor) -> tuple[FloatArray, FloatArray, FloatArray]:
    """M, damping with gyroscopic terms, K; coordinates (v, v') of all nodes in y, then in z."""
    nodes = rotor.elements + 1
    n = 2 * nodes
    EI = 2.1e11 * np.pi * rotor.diameter_m**4 / 64
    m_e, k_e = _element(rotor.length_m / rotor.elements, EI, 7850 * np.pi * rotor.diameter_m**2 / 4)
    M1, K1 = np.zeros((n, n)), np.zeros((n, n))
    for e in range(rotor.elements):
        at = slice(2 * e, 2 * e + 4)
        M1[at, at] += m_e
        K1[at, at] += k_e
    M1[2 * rotor.bearings[0], 2 * rotor.bearings[0]] += rotor.housing_kg
    C1 = rotor.shaft_damping_s * K1
    M = np.asarray(np.kron(np.eye(2), M1), dtype=np.float64)
    C = np.asarray(np.kron(np.eye(2), C1), dtype=np.float64)
    K = np.asarray(np.kron(np.eye(2), K1), dtype=np.float64)
    for node, mass, radius in zip(rotor.discs, rotor.disc_kg, rotor.disc_radius_m, strict=True):
        for plane in (0, n):
            M[plane + 2 * node, plane + 2 * node] += mass
            M[plane + 2 * node + 1, plane + 2 * node + 1] += mass * radius**2 / 4
        gyro = rotor.speed_rad_s * mass * radius**2 / 2
        C[2 * node + 1, n + 2 * node + 1] += gyro
        C[n + 2 * node + 1, 2 * node + 1] -= gyro
    for number, node in enumerate(rotor.bearings):
        for plane, k, c in ((0, rotor.k_y, rotor.c_y), (n, rotor.k_z, rotor.c_z)):
            K[plane + 2 * node, plane + 2 * node] += k[number]
            C[plane + 2 * node, plane + 2 * node] += c[number]
    return M, C, K


def _rows(rotor: Rotor) -> list[int]:
    n = 2 * (rotor.elements + 1)
    one, two = 2 * rotor.bearings[0], 2 * rotor.discs[0]
    return [one, two, n + one, n + two]


def modes(rotor: Rotor) -> list[tuple[float, float]]:
    """Frequency, Hz, and damping ratio of each mode."""
    M, C, K = matrices(rotor)
    n = M.shape[0]
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(M, K), -np.linalg.solve(M, C)]])
    roots = np.linalg.eigvals(A)
    return sorted((abs(s) / 2 / np.pi, -s.real / abs(s)) for s in roots if s.imag > 0)


def simulate(
    rotor: Rotor,
    excitation: Excitation,
    duration_s: float,
    seed: int,
    *,
    noise: float = 0.01,
    noise_memory_s: float = 0.0,
) -> FloatArray:
    """Samples of `COLUMNS` and the shaft angle, shape (n_samples, 13); noise is relative to each channel's rms."""
    M, C, K = matrices(rotor)
    n, rows = M.shape[0], _rows(rotor)
    rng = np.random.default_rng(seed)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(M, K), -np.linalg.solve(M, C)]])
    S = np.zeros((n, 4))
    S[rows, range(4)] = 1
    B = np.vstack([np.zeros((n, 4)), np.linalg.solve(M, S)])
    step = expm(np.block([[A, B], [np.zeros((4, 2 * n + 4))]]) / RATE_HZ)
    values, V = np.linalg.eig(step[: 2 * n, : 2 * n])
    b = np.linalg.solve(V, step[: 2 * n, 2 * n :])
    count, warm = round(duration_s * RATE_HZ), round(5 * RATE_HZ)
    white = rng.standard_normal((count + warm, len(excitation.sources)))
    pole = np.exp(-2 * np.pi * excitation.cutoff_hz / RATE_HZ)
    coloured = lfilter([1.0], [1, -2 * pole, pole**2], white, axis=0)
    coloured *= excitation.level_N / coloured.std()
    force = coloured @ np.array(excitation.sources)
    rates = [n + row for row in rows]
    output = np.concatenate([V[rows], V[rates], (A @ V)[rates]])
    x = np.zeros((count + warm, len(COLUMNS)))
    # a force that is held over samples jumps at each of them: the acceleration there is the mean of both sides
    x[:, len(STATES) :] = (force + np.vstack([force[:1], force[:-1]])) / 2 @ B[rates].T
    upper = np.flatnonzero(values.imag >= 0)
    motion = np.empty((2 * upper.size, count + warm))
    shapes = np.empty((2 * upper.size, len(COLUMNS)))
    for place, mode in enumerate(upper):
        state = lfilter([0, 1.0], [1, -values[mode]], force @ b[mode])
        pair = 1 if values[mode].imag == 0 else 2
        motion[2 * place : 2 * place + 2] = state.real, state.imag
        shapes[2 * place : 2 * place + 2] = pair * output[:, mode].real, -pair * output[:, mode].imag
    x += motion.T @ shapes
    x = x[warm:]
    W = rotor.speed_rad_s
    pull = np.zeros(n, dtype=complex)
    pull[[rows[1], rows[3]]] = rotor.unbalance_kg_m * W**2 * np.array([1, -1j])
    whirl = np.linalg.solve(K - W**2 * M + 1j * W * C, pull)[rows]
    theta = 0.3 + W * np.arange(count) / RATE_HZ
    x += np.real(np.exp(1j * theta)[:, None] * np.concatenate([whirl, 1j * W * whirl, -(W**2) * whirl]))
    error = rng.standard_normal(x.shape)
    if noise_memory_s:
        decay = np.exp(-1 / (noise_memory_s * RATE_HZ))
        error = lfilter([np.sqrt(1 - decay**2)], [1, -decay], error, axis=0)
    x += noise * x.std(axis=0) * error
    return np.column_stack([x, np.mod(theta, 2 * np.pi)])


def plan(
    hops: int = 12, hop_s: float = 5.0, states: tuple[str, ...] = STATES, speed_rad_s: float | None = None
) -> Plan:
    """A plan as a machine file would give it, of the given columns; with a speed to look for there is no angle."""
    lags: npt.NDArray[np.intp] = np.arange(0, round(0.125 * RATE_HZ) + 1, round(0.001 * RATE_HZ))
    segment = round(hop_s * RATE_HZ)
    return Plan(
        rate_hz=RATE_HZ,
        states=states,
        columns=np.array([COLUMNS.index(name) for name in states]),
        scales=np.ones(len(states)),
        angle_column=len(COLUMNS) if speed_rad_s is None else None,
        speed_rad_s=speed_rad_s,
        hop=segment,
        stride=segment,
        preamble=max(int(lags[-1]), segment // 2),
        segment=segment,
        lags=lags,
        bins=np.arange(round(3 * hop_s), round(150 * hop_s) + 1),
        hops=hops,
        max_span_ns=10**15,
    )


def windows(samples: FloatArray, sizes: Plan) -> list[WindowStatistics]:
    """Windows of a recording that do not overlap."""
    sliding, found = SlidingWindow(sizes), []
    for _ in sliding.feed(sizes.to_si(samples), 0):
        statistics = sliding.statistics()
        if statistics is not None:
            found.append(statistics)
            sliding._hops.clear()
    return found


def with_bearing(rotor: Rotor, *, k_y: float = 0.0, c_y: float = 0.0, k_z: float = 0.0, c_z: float = 0.0) -> Rotor:
    """The rotor with relative changes of its first bearing."""

    def first(values: tuple[float, ...], change: float) -> tuple[float, ...]:
        return (values[0] * (1 + change), *values[1:])

    return replace(
        rotor,
        k_y=first(rotor.k_y, k_y),
        k_z=first(rotor.k_z, k_z),
        c_y=first(rotor.c_y, c_y),
        c_z=first(rotor.c_z, c_z),
    )
