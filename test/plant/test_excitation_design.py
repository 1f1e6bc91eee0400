"""Torques fitted to an allowed motion, and the accuracy they promise."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flexmanip_ros.errors import ParameterError
from flexmanip_ros.parameters import ArmParameters, ExcitationParameters
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, EventKind

CONFIG = ExcitationParameters(design_time=2.0, arm=ArmParameters(modes=1, damping_ratio=0.003))


@pytest.mark.parametrize('shape', ['square', 'multisine', 'prbs', 'chirp'])
@pytest.mark.parametrize('angle', [0.002, 0.1])
def test_the_arm_turns_just_less_than_allowed(shape: str, angle: float) -> None:
    config = replace(CONFIG, shape=shape, allowed_angle=angle)
    peak = excitation.amplitude(config)
    assert peak[0] / peak[1] == pytest.approx(2.0)
    fitted = replace(config, allowed_angle=0.0, amplitude=peak)
    turned = excitation.motion(fitted, excitation.plant_of(config))
    assert 0.96 * angle < turned <= angle
    assert np.array_equal(excitation.sequence(config, 100), excitation.sequence(fitted, 100))
    assert np.array_equal(excitation.torque(config, 7), excitation.sequence(config, 8)[7])


@pytest.mark.parametrize('own', [
    {'joint_coulomb_friction': (0.2, 0.05)}, {'base_mass': 200.0, 'base_inertia': 50.0},
    {'link_length': (1.0,), 'linear_density': (2.0,), 'bending_stiffness': (400.0,)}])
def test_arms_with_friction_a_base_or_one_link_turn_just_less_than_allowed(own: dict[str, Any]) -> None:
    arm = replace(CONFIG.arm, **own)
    links = len(arm.link_length)
    config = replace(CONFIG, allowed_angle=0.1, arm=arm, amplitude=CONFIG.amplitude[:links],
                     offset=CONFIG.offset[:links], initial_angles=CONFIG.initial_angles[:links])
    fitted = replace(config, allowed_angle=0.0, amplitude=excitation.amplitude(config))
    turned = excitation.motion(fitted, replace(excitation.plant_of(config), substeps=0))
    assert 0.95 * 0.1 < turned <= 1.005 * 0.1


def test_an_arm_that_falls_is_refused_by_name() -> None:
    with pytest.raises(ParameterError, match='gravity'):
        excitation.amplitude(replace(CONFIG, allowed_angle=0.1, arm=replace(CONFIG.arm, gravity=(0.0, -9.81))))


def test_an_allowed_angle_needs_a_torque() -> None:
    with pytest.raises(ParameterError, match='allowed_angle'):
        excitation.amplitude(replace(CONFIG, shape='zero', allowed_angle=0.1))
    with pytest.raises(ParameterError, match='offset'):
        excitation.amplitude(replace(CONFIG, offset=(50.0, 0.0), allowed_angle=0.01))


def test_promised_accuracy_shrinks_with_time_and_grows_with_noise() -> None:
    std = excitation.expected_std(CONFIG)
    assert std[0.25] > std[1.0] > 0
    assert 3.0 not in std
    louder = excitation.expected_std(replace(CONFIG, snr_db=20.0))
    assert louder[1.0] == pytest.approx(10 * std[1.0], rel=1e-9)


def test_promised_accuracy_follows_the_sensitivity_to_the_payload() -> None:
    """With the state known the bound is the inverse norm of the sensitivity; unknown state can only cost."""
    plant = replace(excitation.plant_of(CONFIG), arm=CONFIG.arm)
    efforts = excitation.sequence(CONFIG, 2000)
    event = (CaptureEvent(1_000_000_000, EventKind.CAPTURE),)
    quiet = replace(plant, capture_impact='continuous')
    runs = [simulator.simulate(replace(quiet, payload_mass=20.0 + h), efforts, event)
            for h in (-0.01, 0.0, 0.01)]
    signals = [np.hstack([run.position, run.velocity]) for run in runs]
    std = signals[1].std(axis=0) * 0.01
    slope = (signals[2] - signals[0]) / 0.02 / std
    known_state = 1 / np.sqrt(np.sum(slope**2))
    expected = excitation.expected_std(CONFIG)[1.0]
    assert known_state < expected < 100 * known_state


def test_the_announcement_names_motion_and_accuracy() -> None:
    words = excitation.describe(replace(CONFIG, shape='chirp', allowed_angle=0.02))
    assert 'chirp' in words
    assert '1.1 deg' in words
    assert 'kg in 1 s' in words


def test_a_torque_that_tells_nothing_promises_nothing() -> None:
    std = excitation.expected_std(replace(CONFIG, shape='zero'))
    assert all(np.isinf(value) for value in std.values())
