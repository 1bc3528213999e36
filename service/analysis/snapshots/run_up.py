"""Values of the plots over speed: vectors at an order (Bode, polar), and the shaft's centreline."""

import numpy as np

from models.signals.channels import Channel
from rotorwatch.records.plots import CentrelineSeries, ChannelVectors, PlaceCentreline, VectorSeries
from service.analysis.centreline import read_centreline
from service.analysis.orbit import recorded_pairs
from service.analysis.past import Past
from service.analysis.recorded import Sampled
from service.analysis.runup import read_run_up
from service.analysis.snapshots.channels import figures
from service.analysis.snapshots.samples import whose
from service.analysis.spectrum import steady

_MOST_VECTORS = 1000
_CENTRELINE_S = 1.0


def vector_series(
    data: Sampled | Past, channels: tuple[Channel, ...], order: int, revolutions: int, slow_roll_rpm: float | None
) -> VectorSeries:
    """Vectors of some channels: of the windows of the history, or of every so many revolutions of samples.

    Raises
    ------
    RotorwatchError
        If there are none: without a shaft angle, or if the shaft does not turn.
    """
    found = read_run_up(data, channels, order, revolutions, slow_roll_rpm)
    every = -(-found.time_ns.size // _MOST_VECTORS)
    return VectorSeries(
        **whose(data),
        order=order,
        revolutions=found.revolutions,
        slow_roll_rpm=found.slow_roll_rpm,
        times_ns=tuple(found.time_ns[::every].tolist()),
        speeds_rad_s=figures(found.speed_rad_s[::every]),
        channels=tuple(
            ChannelVectors(
                channel=channel.name,
                unit=unit,
                amplitude=figures(found.amplitude[::every, number]),
                phase_lag_deg=figures(found.lag_deg[::every, number]),
            )
            for number, (channel, unit) in enumerate(zip(found.channels, found.units, strict=True))
        ),
        steady=steady(found.speed_rad_s),
    )


def centreline_series(data: Sampled | Past) -> CentrelineSeries:
    """Mean positions wherever displacements are measured in both directions.

    Raises
    ------
    RotorwatchError
        If there is no such place, or there are not two positions.
    """
    pairs = recorded_pairs(data)
    found = read_centreline(data, pairs, _CENTRELINE_S)
    return CentrelineSeries(
        **whose(data),
        times_ns=tuple(found.time_ns.tolist()),
        speeds_rad_s=figures(np.asarray(found.speed_rad_s, dtype=np.float64)),
        places=tuple(
            PlaceCentreline(
                location=pair[0].location, channels=tuple(one.name for one in pair), y_um=figures(y), z_um=figures(z)
            )
            for pair, y, z in zip(found.pairs, found.y_um.T, found.z_um.T, strict=True)
        ),
    )
