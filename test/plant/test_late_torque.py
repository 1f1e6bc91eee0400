"""Torques that follow the effort late, and bends that are measured late, against a fine integration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flexmanip_ros.arm.late_torque import efforts_needed, late_torques
from flexmanip_ros.errors import ParameterError
from flexmanip_ros.parameters import ArmParameters, ExcitationParameters, PlantParameters
from flexmanip_ros.simulation import excitation, simulator

PERIOD = 1e-3
EFFORTS = np.random.default_rng(0).normal(size=(200, 1))
CLEAN = PlantParameters(noise='none', arm=ArmParameters(modes=1))
WAVES = excitation.sequence(ExcitationParameters(), 1500)
REFERENCE = simulator.simulate(CLEAN, WAVES)


def torques(efforts: np.ndarray, delay: float, lag: float, count: int) -> np.ndarray:
    """The mean torques over the last samples."""
    found = np.empty((count, efforts.shape[1]))
    first = len(efforts) - count + 1 - efforts_needed(delay, lag, PERIOD)
    late_torques(efforts[first:].copy(), delay, np.full(efforts.shape[1], lag), PERIOD, np.zeros(2), found)
    return found


def finely(efforts: np.ndarray, delay: float, lag: float, parts: int = 200) -> np.ndarray:
    """The same by a fine integration of the lag."""
    step = PERIOD / parts
    late = np.repeat(efforts, parts, axis=0)
    shift = round(delay / step)
    late = np.concatenate([np.repeat(efforts[:1], shift, axis=0), late[:len(late) - shift]])
    torque, found = late[0].copy(), np.empty_like(late)
    for k, effort in enumerate(late):
        after = effort + (torque - effort) * np.exp(-step / lag) if lag else effort
        found[k] = 0.5 * (torque + after) if lag else effort
        torque = after
    return found.reshape(len(efforts), parts, -1).mean(axis=1)


@pytest.mark.parametrize(('delay', 'lag'), [(0.0, 0.0), (2e-3, 0.0), (0.4e-3, 0.0), (0.0, 5e-3), (1.3e-3, 0.7e-3)])
def test_the_mean_torque_of_a_sample_is_that_of_a_fine_integration(delay: float, lag: float) -> None:
    assert torques(EFFORTS, delay, lag, 50) == pytest.approx(finely(EFFORTS, delay, lag)[-50:], abs=1e-3)


def test_an_effort_that_is_not_late_is_the_torque_to_the_bit() -> None:
    assert np.array_equal(torques(EFFORTS, 0.0, 0.0, 50), EFFORTS[-50:])


@pytest.mark.parametrize(('delay', 'lag'), [(1.3e-3, 2e-3), (2.2e-3, -0.8e-3), (-0.4e-3, 0.9e-3), (-0.3e-3, 1e-9)])
def test_the_slopes_are_the_derivatives_also_below_zero(delay: float, lag: float) -> None:
    found, slope, other = np.empty((1, 1)), np.zeros(2), np.zeros(2)
    late_torques(EFFORTS, delay, np.array([lag]), PERIOD, slope, found)
    small = 1e-8
    for which in range(2):
        ends = []
        for sign in (1.0, -1.0):
            moved = np.array([delay, lag])
            moved[which] += sign * small
            late_torques(EFFORTS, moved[0], moved[1:], PERIOD, other, found)
            ends.append(float(found[0, 0]))
        assert slope[which] == pytest.approx((ends[0] - ends[1]) / (2.0 * small), rel=1e-4, abs=1e-3)


def test_a_dead_time_of_two_samples_is_a_torque_two_samples_later() -> None:
    later = np.vstack([np.zeros((2, 2)), WAVES[:-2]])
    run = simulator.simulate(replace(CLEAN, arm=replace(CLEAN.arm, torque_delay=2e-3)), WAVES)
    assert run.position == pytest.approx(simulator.simulate(CLEAN, later).position, abs=1e-12)
    assert np.array_equal(run.effort, WAVES)


@pytest.mark.parametrize('delay', [2e-3, 1.5e-3])
def test_late_bends_are_those_of_before_and_angles_are_in_time(delay: float) -> None:
    run = simulator.simulate(replace(CLEAN, arm=replace(CLEAN.arm, bend_delay=delay)), WAVES)
    assert np.array_equal(run.position[:, :2], REFERENCE.position[:, :2])
    fine = simulator.simulate(replace(CLEAN, rate=2000.0), np.repeat(WAVES, 2, axis=0))
    shift = round(delay * 2000.0)
    for name, scale in (('position', 1e-6), ('velocity', 3e-3)):
        before = np.vstack([np.zeros((shift, 2)), getattr(fine, name)[:-shift, 2:]])[::2]
        assert getattr(run, name)[:, 2:] == pytest.approx(before, abs=scale)


def test_a_simulated_arm_cannot_show_bends_before_they_happen() -> None:
    with pytest.raises(ParameterError, match='bend_delay'):
        PlantParameters(arm=ArmParameters(bend_delay=-1e-3))
