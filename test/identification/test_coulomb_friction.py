"""Coulomb friction, given or learned, is no input of the model: a linear model has no such friction."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from flexmanip_ros import pipeline
from flexmanip_ros.arm.equations_of_motion import STICTION_RATE
from flexmanip_ros.arm.linearization import frequencies, vibration_model
from flexmanip_ros.arm.manipulator import chords
from flexmanip_ros.parameters import ArmParameters, ExcitationParameters, IdentifierParameters, PlantParameters
from flexmanip_ros.samples import sampling
from flexmanip_ros.samples.sample_log import log_of
from flexmanip_ros.samples.signals import without_friction
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, Estimate, EventKind, JointBlock, Status

FRICTION = (1.0, 0.5)
PLANT = PlantParameters(arm=ArmParameters(joint_coulomb_friction=FRICTION), seed=1)
CONFIG = IdentifierParameters(  # other names than the default: the angles are read without a payload
    payload_method='none', inputs=('shoulder/effort', 'elbow/effort'),
    angles=('shoulder/position', 'elbow/position'),
    outputs=('link1_bend/position', 'link2_bend/position', 'link1_bend/velocity', 'link2_bend/velocity'))
LEARNING = replace(  # friction alone: with everything learned a run takes three times as long
    CONFIG, payload_method='structured', payload=replace(CONFIG.payload, learn=('coulomb_friction',)))
EVENT = CaptureEvent(2_000_000_000, EventKind.RELEASE)
"""An event that changes nothing: the arm is empty before and after it. The models begin again."""
TOLD = replace(CONFIG, arm=replace(CONFIG.arm, joint_coulomb_friction=FRICTION))


@cache
def run() -> simulator.Trajectory:
    return simulator.simulate(PLANT, excitation.sequence(ExcitationParameters(), 9_000), ())


def messages(size: int) -> list[JointBlock]:
    """The messages of the run in blocks of this size."""
    made = run()
    names = ('shoulder', 'elbow', 'link1_bend', 'link2_bend')
    effort = np.hstack([made.effort[:, :2], np.zeros((len(made.effort), 2))])
    return [JointBlock(names, made.stamp_ns[k:k + size], made.position[k:k + size], made.velocity[k:k + size],
                       effort[k:k + size]) for k in range(0, len(made.stamp_ns), size)]


@cache
def readings(config: IdentifierParameters, size: int = 5000) -> list[Estimate]:
    """The models of the last 5 of 9 s."""
    return [estimate for _, estimate in pipeline.replay(config, messages(size))
            if estimate is not None and estimate.model_is_new and estimate.stamp_ns > 4_000_000_000]


@cache
def learned(size: int, end_s: int = 9, late: int = 0) -> tuple[pipeline.State, list[Estimate]]:
    """The last state, and the models from 3 s on, where the event comes this number of blocks after its stamp."""
    items: list[pipeline.Item] = list(messages(size)[:1000 * end_s // size])
    items.insert(EVENT.stamp_ns // (size * 1_000_000) + late if late else 0, EVENT)
    found = list(pipeline.replay(LEARNING, items))
    return found[-1][0], [estimate for _, estimate in found if estimate is not None and estimate.model_is_new
                          and estimate.stamp_ns > 3_000_000_000]


def errors(estimates: list[Estimate]) -> np.ndarray:
    """Relative errors (N, 2) of the two lowest frequencies, at the angles of the half second before."""
    made, found = run(), []
    for estimate in estimates:
        row = int(np.searchsorted(made.stamp_ns, estimate.stamp_ns))
        angles = chords(PLANT.arm, made.position[row - 500:row, :2].mean(axis=0))
        true = frequencies(vibration_model(PLANT.arm, angles)[0])[:2]
        found.append(np.array([mode.frequency_hz for mode in estimate.modes[:2]]) / true - 1.0)
    return np.array(found)


def test_told_its_friction_the_model_is_right_to_a_third_of_a_percent_and_trusted() -> None:
    told = readings(TOLD)
    assert len(told) > 20
    assert np.mean([estimate.model_status is Status.TRACKING for estimate in told]) > 0.9
    assert np.max(np.abs(errors(told))) < 0.003


def test_untold_it_is_further_off() -> None:
    assert np.median(np.abs(errors(readings(CONFIG))), axis=0)[0] > 3.0 * np.median(np.abs(errors(readings(TOLD))))


def test_untold_it_is_as_right_from_an_event_on_as_the_arm_taught_its_friction_before() -> None:
    state, found = learned(500)
    (since,) = state.log.friction
    assert since.stamp_ns == EVENT.stamp_ns
    np.testing.assert_allclose(since.torques, FRICTION, rtol=0.02)
    late = [estimate for estimate in found if estimate.stamp_ns > EVENT.stamp_ns + 5_000_000_000]
    assert np.mean([estimate.model_status is Status.TRACKING for estimate in late]) > 0.9
    assert np.max(np.abs(errors(late))) < 0.003


def test_what_was_learned_before_an_event_holds_at_a_later_one_at_which_the_payload_is_not_known() -> None:
    capture = CaptureEvent(EVENT.stamp_ns + 20_000_000, EventKind.CAPTURE)
    release = CaptureEvent(capture.stamp_ns + 10_000_000, EventKind.RELEASE)
    *_, state = pipeline.absorb(LEARNING, [EVENT, capture, release, *messages(500)[:5]])
    assert {since.stamp_ns for since in state.log.friction} <= {EVENT.stamp_ns, capture.stamp_ns}
    assert state.friction is not None
    np.testing.assert_allclose(state.friction, FRICTION, rtol=0.02)


def test_learned_friction_gives_the_same_bits_where_the_event_comes_late_and_where_no_estimate_is_made() -> None:
    state, late = learned(50, end_s=5, late=3)
    for one, other in zip(learned(500)[1], late, strict=False):
        assert one.model is not None
        assert other.model is not None
        np.testing.assert_array_equal(np.hstack([one.model.A, one.model.B]), np.hstack([other.model.A, other.model.B]))
    assert len(late) > 8
    *_, last = pipeline.absorb(LEARNING, [EVENT, *messages(500)[:10]])
    assert last.log.friction == state.log.friction
    ends = [pipeline.current(one) for one in (state, last)]
    assert all(end is not None and end.model is not None for end in ends)
    np.testing.assert_array_equal(*(end.model.A for end in ends if end is not None and end.model is not None))


def test_blocks_of_any_size_give_the_same_bits() -> None:
    for one, other in zip(readings(TOLD), readings(TOLD, 700), strict=True):
        assert one.model is not None
        assert other.model is not None
        np.testing.assert_array_equal(np.hstack([one.model.A, one.model.B]), np.hstack([other.model.A, other.model.B]))


@pytest.mark.parametrize('gain', [1.0, 1.25])
def test_inputs_are_the_efforts_less_the_friction_of_the_joint_of_that_name(gain: float) -> None:
    u, rates = np.array([[3.0, 7.0], [4.0, 8.0]]), np.array([[1e-3, -5.0], [np.nan, 2e-3]])
    log = log_of(u, np.zeros((2, 4)), np.zeros((2, 2)), rates=rates)
    swapped = replace(TOLD, inputs=TOLD.inputs[::-1], arm=replace(TOLD.arm, torque_gain=(gain, gain)))
    opposing = np.nan_to_num(np.tanh(rates / STICTION_RATE)) * FRICTION / gain
    rows = without_friction(swapped, log.rows(0, 2))
    np.testing.assert_allclose(rows.u, u - opposing[:, ::-1])
    np.testing.assert_array_equal(rows.since(1).u_y[:, :2], rows.u[1:])
    np.testing.assert_array_equal(without_friction(CONFIG, log.rows(0, 2)).u, u)


def test_scores_have_the_inputs_of_the_model_and_pictures_and_bounds_the_efforts() -> None:
    whole, known = (sampling.collect(config, messages(5000)) for config in (TOLD, CONFIG))
    np.testing.assert_array_equal(whole.efforts, known.u)
    opposing = np.tanh(run().velocity[:, :2] / STICTION_RATE) * FRICTION
    np.testing.assert_allclose(whole.efforts - whole.u, opposing, atol=1e-12)
    twice = sampling.collect(TOLD, messages(5000), (2.0 * FRICTION[0], 2.0 * FRICTION[1]))
    np.testing.assert_allclose(twice.efforts - twice.u, 2.0 * opposing, atol=1e-12)


def test_without_measured_rates_the_inputs_are_the_efforts() -> None:
    log = log_of(np.ones((3, 2)), np.zeros((3, 4)), np.zeros((3, 2)))
    np.testing.assert_array_equal(without_friction(TOLD, log.rows(0, 3)).u, np.ones((3, 2)))
