"""Imperfect sensors and drives: each does what its parameter says, live and at once alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flexmanip_ros.errors import ParameterError
from flexmanip_ros.parameters import (
    ActuatorParameters,
    ArmParameters,
    ExcitationParameters,
    PlantParameters,
    SensorParameters,
)
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import JointRecord

CLEAN = PlantParameters(noise='none', arm=ArmParameters(modes=1))
WAVES = excitation.sequence(ExcitationParameters(), 3000)
REFERENCE = simulator.simulate(CLEAN, WAVES)
FAULTY = replace(
    CLEAN, noise='std',
    arm=ArmParameters(modes=1, effort_delay=1, torque_delay=1.5e-3, torque_lag=(2e-3, 5e-3), bend_delay=1.3e-3),
    sensors=SensorParameters(encoder_resolution=1e-3, bend_resolution=1e-4, bias=(0.1,) * 8,
                             strain_cutoff=30.0, stamp_jitter=1e-4, drop_probability=0.1),
    actuators=ActuatorParameters(torque_limit=(8.0, 0.0), command_delay=2))


def test_faults_are_the_same_live_and_at_once() -> None:
    run = simulator.simulate(FAULTY, WAVES[:1200])
    state = simulator.init(FAULTY)
    live: list[JointRecord] = []
    for torque in WAVES[:1200]:
        state, record = simulator.step(FAULTY, state, torque)
        if record is not None:
            live.append(record)
    assert [record.stamp_ns for record in live] == run.stamp_ns.tolist()
    for name in ('position', 'velocity'):
        assert np.array_equal([getattr(record, name) for record in live], getattr(run, name))
    assert np.array_equal([record.effort[:2] for record in live], run.effort)


def test_everything_is_off_by_default() -> None:
    assert np.array_equal(REFERENCE.effort, WAVES)
    assert np.array_equal(REFERENCE.stamp_ns, np.arange(3000) * 1_000_000)


def test_encoders_are_rounded() -> None:
    run = simulator.simulate(replace(CLEAN, sensors=SensorParameters(encoder_resolution=1e-3)), WAVES)
    ticks = run.position[:, :2] / 1e-3
    assert np.abs(ticks - np.round(ticks)).max() < 1e-6
    assert np.abs(run.position - REFERENCE.position)[:, :2].max() <= 0.5e-3 + 1e-12
    assert np.array_equal(run.position[:, 2:], REFERENCE.position[:, 2:])


def test_bias_is_added() -> None:
    bias = np.arange(8) / 10
    run = simulator.simulate(replace(CLEAN, sensors=SensorParameters(bias=tuple(bias))), WAVES)
    assert run.position - REFERENCE.position == pytest.approx(np.tile(bias[:4], (3000, 1)))
    assert run.velocity - REFERENCE.velocity == pytest.approx(np.tile(bias[4:], (3000, 1)))


def test_strain_gauges_lag_and_leave_the_encoders_alone() -> None:
    run = simulator.simulate(replace(CLEAN, sensors=SensorParameters(strain_cutoff=6.0)), WAVES)
    assert np.array_equal(run.position[:, :2], REFERENCE.position[:, :2])
    share = 1 - np.exp(-2 * np.pi * 6.0 * 1e-3)
    level, expected = 0.0, []
    for value in REFERENCE.velocity[:, 2]:
        level += share * (value - level)
        expected.append(level)
    assert run.velocity[:, 2] == pytest.approx(expected, abs=1e-12)


def test_stamps_jitter_in_order() -> None:
    run = simulator.simulate(replace(CLEAN, sensors=SensorParameters(stamp_jitter=1e-4)), WAVES)
    errors = run.stamp_ns - REFERENCE.stamp_ns
    assert errors.std() == pytest.approx(1e5, rel=0.05)
    assert np.all(np.diff(run.stamp_ns) > 0)
    with pytest.raises(ParameterError, match='stamp_jitter'):
        replace(CLEAN, sensors=SensorParameters(stamp_jitter=1e-3))


def test_samples_are_lost_at_the_rate_asked_for() -> None:
    run = simulator.simulate(replace(CLEAN, sensors=SensorParameters(drop_probability=0.2)), WAVES)
    assert len(run.stamp_ns) == pytest.approx(2400, abs=80)
    kept = np.isin(REFERENCE.stamp_ns, run.stamp_ns)
    assert np.array_equal(run.position, REFERENCE.position[kept])


def test_torques_saturate_and_the_record_says_so() -> None:
    config = replace(CLEAN, actuators=ActuatorParameters(torque_limit=(4.0, 0.0)))
    run = simulator.simulate(config, WAVES)
    limited = np.column_stack([np.clip(WAVES[:, 0], -4.0, 4.0), WAVES[:, 1]])
    assert np.array_equal(run.effort, limited)
    assert np.array_equal(run.position, simulator.simulate(CLEAN, limited).position)


def test_delayed_commands_act_later() -> None:
    config = replace(CLEAN, actuators=ActuatorParameters(command_delay=3))
    late = np.vstack([np.zeros((3, 2)), WAVES[:-3]])
    run = simulator.simulate(config, WAVES)
    assert np.array_equal(run.effort, late)
    assert np.array_equal(run.position, simulator.simulate(CLEAN, late).position)


def test_effort_delay_reports_the_interval_before() -> None:
    run = simulator.simulate(replace(CLEAN, arm=ArmParameters(modes=1, effort_delay=1)), WAVES)
    assert np.array_equal(run.effort[1:], WAVES[:-1])
    assert np.array_equal(run.position, REFERENCE.position)
