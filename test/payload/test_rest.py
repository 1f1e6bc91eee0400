"""Claims: an arm that stands still before its first motion is learned as one that moves at once."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from recording import BENDS, event, payload_at_end, rows_of

from flexmanip_ros import pipeline
from flexmanip_ros.parameters import (
    ArmParameters,
    ExcitationParameters,
    IdentifierParameters,
    PlantParameters,
    TriggerParameters,
)
from flexmanip_ros.payload import capture_detection, structured
from flexmanip_ros.payload import filter_state as mem
from flexmanip_ros.simulation import excitation, sensors, simulator
from flexmanip_ros.types import CaptureEvent, EventKind, JointBlock, Status

ARM = ArmParameters(damping_ratio=0.003)
OWN = {'joint_viscous_friction': (0.8, 0.8), 'joint_coulomb_friction': (0.15, 0.15), 'rotor_inertia': (0.2, 0.2)}
"""Friction and rotors that nobody told the estimator of."""


@cache
def moved(plant, seconds, caught_s=None):
    """The motion of an arm under square waves of its torques, without noise; caught_s: when it catches something."""
    efforts = excitation.sequence(ExcitationParameters(rate=plant.rate), round(seconds * plant.rate))
    return simulator.simulate(plant, efforts, () if caught_s is None else (event(caught_s),))


def after_rest(rest_s, rate, motion_s, caught_s=None, seed=0, **own):
    """An arm that rests, then moves by square waves of its torques: what it does is simulated once for all seeds.

    Without torque it stays where it is, as exactly as if its rest had been simulated: the test below.
    """
    plant = PlantParameters(arm=replace(ARM, modes=5, **own), rate=rate, payload_mass=20.0, seed=seed)
    motion = moved(replace(plant, noise='none', seed=0), max(motion_s, 1.0 / rate), caught_s)
    still = round(rest_s * rate)
    count = still + round(motion_s * rate)
    position, velocity = (np.vstack([np.repeat(part[:1], still, axis=0), part])[:count]
                          for part in (motion.position, motion.velocity))
    sensors.read(plant, position, velocity, sensors.std_for_snr(position, velocity, plant.snr_db),
                 sensors.normal(seed, count))
    effort = np.vstack([np.zeros((still, motion.effort.shape[1])), motion.effort])[:count]
    return simulator.Trajectory(np.round(np.arange(count) * 1e9 / rate).astype(np.int64), position, velocity, effort,
                                motion.names)


def test_an_arm_without_torque_rests_as_exactly_as_if_its_rest_had_been_simulated():
    plant = PlantParameters(arm=replace(ARM, modes=5, **OWN), rate=200.0, payload_mass=20.0, seed=3)
    efforts = excitation.sequence(ExcitationParameters(rate=200.0), 100)
    efforts = np.vstack([np.zeros((60, efforts.shape[1])), efforts])
    whole = simulator.simulate(plant, efforts, (event(0.6),))
    for found, known in zip(after_rest(0.3, 200.0, 0.5, 0.3, 3, **OWN), whole, strict=True):
        np.testing.assert_array_equal(found, known)


def samples_of(trajectory):
    """The displacements of a trajectory."""
    return rows_of(trajectory.effort[:, :2], trajectory.position[:, 2:], trajectory.position[:, :2],
                   trajectory.stamp_ns)


def settings(**parameters):
    return IdentifierParameters(arm=ARM, outputs=BENDS, **parameters)


@pytest.mark.parametrize('seed', [0, 2])  # after 10 s two of eight end in another minimum: docs/lab/payload.md
def test_an_arm_that_rested_learns_its_friction_and_rotors_from_two_hundred_samples_a_second(seed):
    rest_s = 10.0
    capture = CaptureEvent(round((rest_s + 3.0) * 1e9), EventKind.CAPTURE)
    trajectory = after_rest(rest_s, 200.0, 6.0, 3.0, seed, **OWN)
    found = payload_at_end(IdentifierParameters(arm=ARM), simulator.records(trajectory, (capture,)))
    assert found.status is Status.TRACKING
    assert found.mass == pytest.approx(20.0, rel=0.01)
    assert found.lower < 20.0 < found.upper


def test_the_first_motion_of_an_arm_with_friction_and_rotors_is_no_capture():
    rest_s = 5.0
    capture = CaptureEvent(round((rest_s + 3.0) * 1e9), EventKind.CAPTURE)
    made = after_rest(rest_s, 1000.0, 3.4, 3.0, **OWN)
    effort = np.hstack([made.effort, np.zeros_like(made.effort)])
    config, findings = IdentifierParameters(arm=ARM), capture_detection.Findings()
    parts = made.stamp_ns, made.position, made.velocity, effort
    blocks = [JointBlock(made.names, *(part[at:at + 20] for part in parts)) for at in range(0, len(effort), 20)]
    for _ in capture_detection.with_detected(capture_detection.watch(config), blocks, findings):
        pass
    (found,) = findings.events
    assert abs(found.stamp_ns - capture.stamp_ns) <= 20e6


@pytest.mark.parametrize('window', [0.1, 0.5])
def test_a_blow_of_a_moving_object_on_an_arm_that_never_moved_is_found(window):
    plant = PlantParameters(arm=ARM, payload_mass=20.0, object_velocity=(0.0, 0.1))
    efforts = 1e-3 * np.random.default_rng(0).standard_normal((1500, 2))
    trajectory = simulator.simulate(plant, efforts, (event(1.0),))
    config = TriggerParameters(mode='auto', arm=ARM, outputs=BENDS, detection_window=window)
    _, (found,) = capture_detection.advance(config, capture_detection.init(config), samples_of(trajectory))
    assert found.kind is EventKind.CAPTURE
    assert abs(found.stamp_ns - 1_000_000_000) <= 20e6


@pytest.mark.parametrize('block', [1, 7, 400])
def test_an_arm_at_rest_has_the_same_bits_by_blocks(block):
    samples, config = samples_of(after_rest(0.8, 1000.0, 0.2)), settings()
    whole = structured.advance(config, structured.init(config), samples)
    state, came_to_rest = structured.init(config), 0
    for row in range(0, len(samples), block):
        state = structured.advance(config, state, samples.between(row, min(row + block, len(samples))))
        came_to_rest += state.memory is not None and state.memory.counts[mem.RESTS] == mem.RESTING
    assert came_to_rest
    assert state.cursor == whole.cursor
    assert state.horizon is not None
    assert whole.horizon is not None
    assert state.horizon.row == whole.horizon.row > 0  # it slid to just before the motion
    assert state.memory is not None
    assert whole.memory is not None
    for one, other in zip(state.memory, whole.memory, strict=True):
        np.testing.assert_array_equal(one, other)


def test_the_samples_of_an_arm_at_rest_are_not_kept():
    samples, config = samples_of(after_rest(8.0, 200.0, 0.0)), settings()
    state = structured.init(config)
    for row in range(0, len(samples), 100):
        state = structured.advance(config, state, samples.between(row, row + 100))
    assert state.sensors is not None
    assert state.memory is not None
    assert state.memory.counts[mem.RESTS] == mem.RESTING
    assert len(samples) - structured.first_needed(state) <= 2 * 8 * state.sensors.block


def test_an_arm_of_which_nothing_is_learned_need_not_move_first():
    known = settings(payload=replace(IdentifierParameters().payload, learn=()))
    state = structured.advance(known, structured.init(known), samples_of(after_rest(2.0, 200.0, 0.0)))
    assert state.memory is not None
    assert state.memory.counts[mem.RESTS] == mem.MOVES_ABOUT


def test_an_arm_at_rest_is_poorly_excited():
    config = IdentifierParameters(arm=ARM)
    found = [estimate.payload for estimate in pipeline.run(
        config, simulator.records(after_rest(3.0, 200.0, 0.0), ())) if estimate.payload is not None]
    assert {payload.status for payload in found} <= {Status.WARMING_UP, Status.POORLY_EXCITED}
