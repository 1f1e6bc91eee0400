"""What the detector claims, on the plant it models."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from recording import ARM, BENDS, RATES, event, record, rows_of

from flexmanip_ros.parameters import (
    ArmParameters,
    ExcitationParameters,
    PayloadParameters,
    PlantParameters,
    TriggerParameters,
)
from flexmanip_ros.payload import capture_detection
from flexmanip_ros.payload import capture_detection_kernel as kernel
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import EventKind, JointBlock


def settings(outputs=BENDS + RATES, **parameters):
    return TriggerParameters(mode='auto', arm=ARM, outputs=outputs, **parameters)


def detect(config, samples, block=5):
    """Events found, with the stamp at which each was told."""
    state, found = capture_detection.init(config), []
    for start in range(0, len(samples), block):
        part = samples.between(start, min(start + block, len(samples)))
        state, events = capture_detection.advance(config, state, part)
        found.extend((one, part.stamp_ns[-1]) for one in events)
    return found


@pytest.mark.parametrize('outputs', [BENDS, BENDS + RATES], ids=['displacements', 'with rates'])
@pytest.mark.parametrize('seconds', [1.5, 1.723, 2.0])
def test_a_capture_is_told_within_fifty_milliseconds_and_dated(outputs, seconds):
    capture = event(seconds)
    samples = record(seconds + 0.4, (capture,), outputs=outputs)
    ((found, told),) = detect(settings(outputs), samples)
    assert found.kind is EventKind.CAPTURE
    assert told - capture.stamp_ns <= 50e6
    assert abs(found.stamp_ns - capture.stamp_ns) <= 12e6


def test_captures_and_releases_in_a_row_are_told_apart():
    events = (event(1.2), event(2.1, EventKind.RELEASE), event(3.0))
    found = detect(settings(), record(3.6, events))
    assert [one.kind for one, _ in found] == [one.kind for one in events]
    assert all(told - one.stamp_ns <= 60e6 for (_, told), one in zip(found, events, strict=True))


def test_excitation_and_manoeuvres_alone_raise_no_alarm():
    assert detect(settings(), record(8.0, scale=4.0), block=1000) == []
    assert detect(settings(), record(4.0, scale=0.0, noise='std'), block=1000) == []


def test_a_capture_at_rest_by_an_arm_that_is_known_is_told_when_the_torque_resumes():
    still = np.zeros((2000, 2))
    efforts = np.vstack([still, np.tile([10.0, 5.0], (400, 1))])
    noise = (1e-4, 1e-4, 2e-5, 2e-5, 1e-3, 1e-3, 7e-4, 7e-4)
    parameters = PlantParameters(arm=ARM, payload_mass=20.0, noise='std', noise_std=noise)
    trajectory = simulator.simulate(parameters, efforts, (event(1.0),))
    Y = np.hstack([trajectory.position[:, 2:], trajectory.velocity[:, 2:]])
    samples = rows_of(trajectory.effort[:, :2], Y, trajectory.position[:, :2], trajectory.stamp_ns)
    # an arm that rested has taught nothing of its friction and gains: they would explain as much
    ((found, told),) = detect(settings(payload=PayloadParameters(learn=())), samples)
    assert found.kind is EventKind.CAPTURE
    assert 2.0e9 < told <= 2.15e9


@pytest.mark.parametrize('own', [
    {'joint_viscous_friction': (5.0, 3.0)},
    {'joint_viscous_friction': (0.8, 0.8), 'joint_coulomb_friction': (0.15, 0.15), 'rotor_inertia': (0.2, 0.2)},
], ids=['viscous', 'friction and rotor'])
def test_a_capture_by_an_arm_with_friction_is_told_once_the_empty_arm_has_taught_it(own):
    capture = event(3.0)
    samples = record(3.6, (capture,), outputs=BENDS, arm=replace(ARM, **own))
    ((found, told),) = detect(settings(BENDS), samples)
    assert told - capture.stamp_ns <= 100e6
    assert abs(found.stamp_ns - capture.stamp_ns) <= 20e6


def test_steps_of_both_torques_raise_no_alarm_though_the_arm_has_more_modes_than_the_model():
    ideal = ArmParameters(damping_ratio=0.003)
    samples = record(4.2, degrees=(71.0, 85.0), outputs=BENDS, seed=2, arm=replace(ideal, modes=5))
    assert detect(replace(settings(BENDS), arm=ideal), samples, block=1000) == []


def test_the_exponential_of_a_sample_is_that_of_scipy_where_friction_makes_it_stiff():
    samples = record(0.3, arm=replace(ARM, joint_coulomb_friction=(1.0, 0.5)), outputs=BENDS)
    config = replace(settings(BENDS), arm=replace(ARM, joint_coulomb_friction=(1.0, 0.5)))
    state, _ = capture_detection.advance(config, capture_detection.init(config), samples)
    motion, n = state.filter.model.motion, state.filter.model.motion.arm.stiffness.size
    motion.F[0, n] = -5000.0  # a joint that sticks
    flow = np.zeros((2 * n, 2 * n))
    kernel.transition(motion, flow, np.zeros((2, 2 * n, 2)), 1e-3)
    block = np.vstack([np.eye(n, 2 * n, n), motion.F])
    assert flow == pytest.approx(scipy.linalg.expm(1e-3 * block), rel=1e-4, abs=1e-4 * np.abs(flow).max())


@pytest.mark.parametrize('ago', [8, 30, 77])
@pytest.mark.parametrize('strength', [3.0, 300.0], ids=['faint', 'heavy'])
def test_an_onset_is_dated_from_its_trace_whatever_came_of_the_noise_since(ago, strength):
    """The white noise weighs the innovations: the variance that the filter takes them for has grown with the event."""
    rng, (w, m), newest = np.random.default_rng(ago), (100, 3), 17
    lags = np.arange(w)[:, np.newaxis]
    ring = np.cos(0.09 * lags * (1.0 + np.arange(m))) - 1.0  # (w, m) of a force that is held
    trace = np.stack([ring, np.cumsum(ring, axis=0) / 20.0, ring[:, ::-1], -ring, ring * lags / w, 0.1 * ring], axis=2)
    variance = np.array([1e-8, 4e-8, 1e-10])
    trace *= np.sqrt(variance)[:, np.newaxis]
    now = np.sqrt(variance) * rng.standard_normal((w, m))
    now[:ago + 1] += (trace @ (strength * np.array([1.0, 0.2, 0.0, 0.0, 0.5, 0.0])))[ago::-1]
    innovations = np.zeros((w, m))
    innovations[(newest - np.arange(w)) % w] = now
    glr = kernel.UNWATCHED._replace(trace=trace, innovations=innovations, clock=np.array([newest, w, 0, 0, 0, 0]))
    assert capture_detection.onset(glr, variance, w) == pytest.approx(ago, abs=2.0)
    assert capture_detection.onset(glr, variance, ago - 3) <= ago - 3  # not before the last gap


@pytest.mark.parametrize('floating', [{}, {'base_mass': 700.0, 'base_inertia': 180.0}], ids=['pinned', 'floating'])
def test_a_body_which_pushes_with_a_moment_too_is_dated_as_well_as_a_point(floating):
    arm, capture = ArmParameters(damping_ratio=0.003, **floating), event(2.0)
    samples = record(2.4, (capture,), outputs=BENDS, arm=arm, payload_com=(0.1, -0.05), payload_inertia=1.2,
                     object_spin=0.15)
    ((found, _),) = detect(TriggerParameters(mode='auto', arm=arm, outputs=BENDS), samples)
    assert abs(found.stamp_ns - capture.stamp_ns) <= 4e6


def test_a_capture_by_a_linear_plant_is_told():
    """Where the mass matrix stays, no step writes the Jacobian of the tip, by which a force shows in the signals."""
    capture = event(2.0)
    samples = record(2.4, (capture,), outputs=BENDS, model='linear', scale=0.3)
    config = TriggerParameters(mode='auto', arm=ARM, outputs=BENDS, payload=PayloadParameters(dynamics='linear'))
    ((found, told),) = detect(config, samples)
    assert found.kind is EventKind.CAPTURE
    assert told - capture.stamp_ns <= 60e6


def test_single_samples_give_the_events_of_a_block():
    samples = record(1.6, (event(1.3),))
    config = settings()
    state, single = capture_detection.init(config), []
    for row in range(len(samples)):
        state, events = capture_detection.advance(config, state, samples.between(row, row + 1))
        single.extend(events)
    assert single == list(capture_detection.advance(config, capture_detection.init(config), samples)[1])


@pytest.mark.parametrize('rate', [40.0, 50.0])
def test_where_a_sample_takes_longer_than_the_confirmation_a_block_still_gives_the_events_of_single_ones(rate):
    arm = ArmParameters(damping_ratio=0.01, modes=1)
    plant = PlantParameters(arm=arm, rate=rate, payload_mass=20.0)
    torques = excitation.sequence(ExcitationParameters(rate=rate), round(13 * rate))
    trajectory = simulator.simulate(plant, torques, (event(12.0),))
    samples = rows_of(trajectory.effort[:, :2], trajectory.position[:, 2:], trajectory.position[:, :2],
                      trajectory.stamp_ns)
    config = TriggerParameters(mode='auto', arm=arm, outputs=BENDS)
    single = [found for found, _ in detect(config, samples, block=1)]
    assert [found.kind for found in single] == [EventKind.CAPTURE]
    assert single == [found for found, _ in detect(config, samples, block=len(samples))]


def test_fewer_false_alarms_mean_a_higher_threshold():
    often, rarely = (capture_detection.threshold(settings(false_alarms_per_hour=rate), 1e-3)
                     for rate in (1.0, 1e-6))
    assert 30.0 < often < rarely < 100.0


@pytest.mark.parametrize(('scale', 'parameters'), [(1.0, {'angles': ()}), (1e12, {})], ids=['no angles', 'other units'])
def test_samples_in_which_nothing_can_be_found_are_not_kept(scale, parameters):
    """The log of a node grew by 100 kB a second: the detector had never begun, and asked for all rows."""
    rng, names = np.random.default_rng(0), ('joint1', 'joint2', 'link1_bend', 'link2_bend')
    now = capture_detection.watching(TriggerParameters(mode='auto', **parameters))
    for begin in range(0, 512, 64):
        stamps, values = 1_000_000 * (begin + np.arange(64)), scale * rng.normal(0.0, 1e-3, (64, 4))
        now, events = capture_detection.look(now, JointBlock(names, stamps, values, values, rng.normal(size=(64, 4))))
        assert events == ()
    assert now.log.end == 512
    assert now.log.end - now.log.start <= 64


def test_signals_of_no_arm_detect_nothing():
    config = settings(angles=())
    assert capture_detection.advance(config, capture_detection.init(config), record(0.2))[1] == ()
