"""Accelerations as velocities, for theory that knows displacements and velocities.

In the spectrum integration is a division by jω, exact at every frequency of the band and nowhere else: the valid band
of the integrator is the band of the window (``band_hz`` of the machine file). Nothing is filtered in time.
"""

from dataclasses import replace

import numpy as np

from models.diagnosis.window import WindowStatistics
from models.signals.channels import ACCELERATIONS

__all__ = ["integrated"]


def integrated(window: WindowStatistics) -> WindowStatistics:
    """Return the window with velocities in place of accelerations; the same where none is measured.

    An acceleration beside a velocity of the same place is left out: it is the same motion with more noise at low
    frequencies. Correlations are kept at lag zero alone, where they follow from the spectra.
    """
    if not any(name in ACCELERATIONS for name in window.states):
        return window
    velocity = {name: name.replace("_ddot", "_dot") for name in window.states}
    kept = [
        column
        for column, name in enumerate(window.states)
        if velocity[name] == name or velocity[name] not in window.states
    ]
    states = tuple(velocity[window.states[column]] for column in kept)
    made = np.array([window.states[column] in ACCELERATIONS for column in kept])
    w = 2 * np.pi * window.frequencies_hz
    turn = np.where(made, 1 / (1j * w[:, None]), 1.0)
    spectrum = window.spectrum[:, kept][:, :, kept] * turn[:, :, None] * turn[:, None, :].conj()
    step_hz = float(window.frequencies_hz[1] - window.frequencies_hz[0])
    correlation = 2 * step_hz * spectrum.real.sum(axis=0)[np.newaxis]
    at_speed = (
        np.where(made, 1 / (1j * window.speed_rad_s), 1.0) if np.isfinite(window.speed_rad_s) else np.ones(made.size)
    )
    synchronous, by_hop = window.synchronous, window.hop_synchronous
    hops = window.hop_correlation.shape[0]
    return replace(
        window,
        states=states,
        lags_s=window.lags_s[:1],
        correlation=correlation,
        hop_correlation=np.repeat(correlation[np.newaxis], hops, axis=0),
        spectrum=spectrum,
        synchronous=None if synchronous is None else synchronous[kept] * at_speed,
        hop_synchronous=None if by_hop is None else by_hop[:, kept] * at_speed,
    )
