"""An arm that moves is not linear; its model goes with it, and says how sure it is."""

from __future__ import annotations

import numpy as np
import pytest
from linear_arm import benchmark

from flexmanip_ros import pipeline
from flexmanip_ros.arm.linearization import vibration_model
from flexmanip_ros.parameters import ExcitationParameters, IdentifierParameters, PlantParameters, configure
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, EventKind, JointRecord, Status

CAPTURE_S = 3.0


@pytest.mark.parametrize('seed', [1, 2])
def test_default_settings_follow_both_modes_of_the_moving_nonlinear_arm_through_a_capture(seed: int) -> None:
    plant = configure(PlantParameters, {'seed': seed})
    config = configure(IdentifierParameters, {'payload_method': 'none'})
    torque = excitation.sequence(ExcitationParameters(), 6000)
    event = CaptureEvent(round(CAPTURE_S * 1e9), EventKind.CAPTURE)
    run = simulator.simulate(plant, torque, [event])
    state, seen = pipeline.init(), 0
    for item in simulator.records(run, [event]):
        state, ready = pipeline.step(config, state, item)
        for estimate in ready:
            time = estimate.stamp_ns * 1e-9
            if not estimate.model_is_new or not (1.5 < time < CAPTURE_S or time > CAPTURE_S + 2.0):
                continue
            seen += 1
            assert estimate.model_status is Status.TRACKING
            assert len(estimate.modes) == 2
            found = np.array([mode.frequency_hz for mode in estimate.modes])
            spread = np.array([mode.frequency_std_hz for mode in estimate.modes])
            assert np.all(np.abs(found - true_frequencies(plant, run, time)) < 4.0 * spread + 0.06)
            assert np.all(spread < 0.5)
    assert seen > 8


@pytest.mark.parametrize(('mass', 'degrees'), [(20.0, (-45.0, 45.0)), (100.0, (45.0, 0.0))])
def test_close_modes_after_a_capture_are_told_apart_though_50_hz_rings_on(
    mass: float, degrees: tuple[float, float],
) -> None:
    study = benchmark('identification_moving_arm')
    rows = np.array(study.readings(mass, degrees, 1))
    settled = rows[rows[:, 0] > CAPTURE_S + 2.7]
    assert len(settled) > 5
    assert np.all(np.abs(settled[:, 1:3]) < 0.005)
    assert np.all(settled[:, 5:] < 0.005)


def true_frequencies(plant: PlantParameters, run: simulator.Trajectory, time: float) -> np.ndarray:
    """The two lowest frequencies [Hz] at the configuration of the last half second."""
    last = round(time * plant.rate)
    joints = run.position[last - 500:last, :2].mean(axis=0)
    Ac, _ = vibration_model(plant.arm, np.array([joints[0], joints.sum()]), 20.0 if time > CAPTURE_S else 0.0)
    poles = np.linalg.eigvals(Ac)
    return np.sort(poles.imag[poles.imag > 0.0])[:2] / (2.0 * np.pi)


def test_a_record_is_needed_before_a_model_is_called_tracking() -> None:
    config = configure(IdentifierParameters, {'payload_method': 'none'})
    run = simulator.simulate(PlantParameters(), excitation.sequence(ExcitationParameters(), 900), [])
    records = [item for item in simulator.records(run) if isinstance(item, JointRecord)]
    said = [(e.stamp_ns, e.model_status) for e in pipeline.run(config, records)]
    assert {status for stamp, status in said if stamp < 0.38e9} == {Status.WARMING_UP}
    assert said[-1][1] is Status.TRACKING
