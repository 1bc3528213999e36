"""Causes outside the model: as which changes of parameters they are read."""

import numpy as np
import pytest

from models.diagnosis.likelihood.motions import Motions, group_bins
from models.diagnosis.likelihood.rivals import rivals_at
from models.diagnosis.likelihood.scoring import FisherScoring, gradient_of
from models.diagnosis.likelihood.spectral_model import IDENTITY, STRUCTURAL, SpectralModel, packed
from models.diagnosis.likelihood.unbalance import estimate_unbalance
from models.diagnosis.misfit import Rival
from models.diagnosis.window.moments import plan_for
from models.machine import load_machine
from models.physics.rotor import PARAMETERS
from models.signals.block import FloatArray

LAB = load_machine("lab")
STATES = ("y1", "y2", "z1", "z2")
SPEED = LAB.operation.speed_rad_s
SMALL = 1e-4


def spectra(rotor: dict[str, float]) -> SpectralModel:
    machine = LAB.model_copy(update={"rotor": LAB.rotor.model_copy(update=rotor)})
    frequencies_hz = plan_for(LAB).frequencies_hz
    groups = group_bins(frequencies_hz, LAB, np.abs(frequencies_hz - 22) < 1.6, 4.0)
    return SpectralModel(machine, Motions(STATES, np.full(len(STATES), 2e-4)), groups, 2.0, shapes=0)


@pytest.mark.parametrize(
    ("name", "number", "heavier"),
    [
        ("the disc's mass", 0, ("m2_kg",)),
        ("the disc's mass", 1, ("m2_kg", "I2_kg_m2", "I2p_kg_m2")),
        ("the disc's inertia", 0, ("I2_kg_m2", "I2p_kg_m2")),
        ("the disc's inertia", 1, ("I2p_kg_m2",)),
    ],
)
def test_a_small_cause_is_read_as_the_changes_stated(name: str, number: int, heavier: tuple[str, ...]) -> None:
    model = spectra({})
    theta = np.zeros(model.size)
    theta[model.cutoff_at], theta[model.order_at] = np.log(80), np.log(2)
    theta[model.noise_at] = -6
    theta[model.level_at] = IDENTITY

    def read(other: SpectralModel) -> tuple[FloatArray, Rival]:
        """Readings, and the cause, of the exact spectra and the exact unbalance response of a machine: one step."""
        search = FisherScoring(model, other.at(theta, SPEED).S, 10**5, SPEED, 80.0)
        found = search.maximise(theta, 0, 1e-4, 1e-9)
        covariance: FloatArray = np.asarray(np.linalg.inv(found.information), dtype=np.float64)
        gradient = gradient_of(found.derivatives.slopes, packed(found.whitened.excess), search.weights)
        step = (covariance @ gradient)[: len(STRUCTURAL)]
        structural: FloatArray = covariance[: len(STRUCTURAL), : len(STRUCTURAL)]
        at = structural, SPEED, 60.0
        rival = [one for one in rivals_at(model, search.weights, found, *at, None) if one.name == name][number]
        force_N = LAB.rotor.m2_kg * LAB.rotor.e_m * SPEED**2 * np.array([0, 1, 0, 0, -1j, 0])
        moved = other.receptance(theta[: len(STRUCTURAL)], SPEED, np.array([SPEED]))[0] @ force_N
        vector = moved[[0, 1, 3, 4]] * np.exp(1j * LAB.operation.unbalance_phase_rad)
        stepped = theta + np.concatenate([step, np.zeros(model.size - len(STRUCTURAL))])
        point = model.at(stepped, SPEED)
        e = estimate_unbalance(LAB, model, point, structural, vector, SPEED, 60.0).values[0] - 1
        changes = dict(zip(STRUCTURAL, step.tolist(), strict=True)) | {"e": float(e)}
        return np.array([changes[one] for one in PARAMETERS]), rival

    seen, rival = read(spectra({field: getattr(LAB.rotor, field) * (1 + SMALL) for field in heavier}))
    unchanged, at_rest = read(model)  # the weak pulls shift readings and scores a little
    expected = SMALL * rival.taken_for
    np.testing.assert_allclose(seen - unchanged, expected, atol=0.02 * np.abs(expected).max())
    assert (rival.score - at_rest.score) / rival.information == pytest.approx(SMALL, rel=0.05)
