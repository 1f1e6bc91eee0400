"""The modes beyond kappa: seen where the arm has them, not where it has none, and their momentum kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from recording import ARM, config, event, record
from scipy.linalg import expm

from flexmanip_ros.arm import linearization, manipulator
from flexmanip_ros.payload import filter_state as mem
from flexmanip_ros.payload import structured, structured_model
from flexmanip_ros.payload.interval import RESIDUAL_SHARE, misjudged
from flexmanip_ros.payload.residual_modes import (
    MODES,
    excite_residual,
    propagate_residual,
    residual_amplitude,
    residual_modes,
    residual_output,
    residual_probability,
)
from flexmanip_ros.payload.structured_model import motion
from flexmanip_ros.types import Status

THETA = np.array([0.4, 1.1])
ROWS = np.arange(4)


def beyond(rate=False):
    return residual_modes(ARM, THETA, 3, ROWS, np.full(4, rate))


def remembered(modes):
    """What an estimator of three modes a link remembers of 2 s of an empty arm of ``modes`` at 30 dB."""
    samples = record(2.0, arm=replace(ARM, modes=modes), snr_db=30.0)
    settings = config(replace(ARM, modes=3))
    return structured.advance(settings, structured.init(settings), samples).memory


@pytest.fixture(scope='module')
def of_three():
    return remembered(3)


@pytest.fixture(scope='module')
def of_six():
    return remembered(6)


def test_an_arm_of_more_modes_is_told_from_one_of_just_these_though_neither_misfits(of_three, of_six):
    assert residual_probability(of_six.score) > 0.999
    assert residual_amplitude(of_six.score) > 0.5
    assert residual_probability(of_three.score) < 0.2
    assert residual_amplitude(of_three.score) < 0.05


def test_the_interval_reckons_with_an_error_only_where_modes_beyond_kappa_are_seen(of_three, of_six):
    assert misjudged(of_three.noise, of_three.score, of_three.counts) < 0.1 * RESIDUAL_SHARE
    assert misjudged(of_six.noise, of_six.score, of_six.counts) >= 0.999 * RESIDUAL_SHARE


def test_nothing_told_is_an_even_chance_and_nothing_seen_speaks_against():
    score = np.zeros(9)
    assert residual_probability(score) == pytest.approx(0.5)
    score[mem.INFORMATION] = 1e6  # much could have been seen, and nothing was
    assert residual_probability(score) < 0.01


def test_ringing_is_the_exact_motion_under_held_torques():
    more = beyond()
    m = mem.memory(1, 4, 2 * MODES)
    effort = np.array([3.0, -2.0])
    propagate_residual(more, m, 0.7e-3, effort)
    m.torque[:] = effort
    propagate_residual(more, m, 0.5e-3, effort)
    for i, (square, damping) in enumerate(zip(more.square, more.damping, strict=True)):
        held = more.load[i] @ effort / square
        flow = expm(1.2e-3 * np.array([[0.0, 1.0], [-square, -damping]]))
        assert m.residual[:, i] == pytest.approx(flow @ [-held, 0.0], rel=1e-9, abs=1e-18)


def test_sensors_read_the_departure_or_its_rate():
    m = mem.memory(1, 4, 2 * MODES)
    m.residual[0], m.residual[1] = 1.0, 2.0
    for row in range(4):
        slow, fast = residual_output(beyond(), m, row), residual_output(beyond(rate=True), m, row)
        assert fast == pytest.approx(2.0 * slow)


def test_a_step_of_the_torque_leaves_the_momentum_of_all_modes():
    """Against the full arm: M_rr dq_r + M_rt K_t^-1 B_t dtau = 0, summed over as many modes as converge."""
    moving = motion(config(replace(ARM, modes=3)))
    x = np.zeros(moving.X.shape[1])
    x[:2] = THETA
    effort = np.array([10.0, -5.0])
    b = linearization.blocks(ARM, THETA, 0.0, 200)
    M = np.block([[b.Ma, b.Mb], [b.Mb.T, b.Mc]])
    chosen = np.r_[5:202, 205:402]
    kept = np.setdiff1d(np.arange(402), chosen)
    stiffness, load = manipulator.stiffness(ARM, 200), manipulator.torque_matrix(ARM, 200)
    held = load[chosen] @ effort / stiffness[chosen - 2]
    expected = -np.linalg.solve(M[np.ix_(kept, kept)], M[np.ix_(kept, chosen)] @ held)
    moving.work.M[:] = np.linalg.cholesky(M[np.ix_(kept, kept)])
    np.fill_diagonal(moving.work.M, 1.0 / np.diag(moving.work.M))  # as ``factor`` leaves it
    excite_residual(moving, beyond(), x, np.zeros(2), effort, 1.0)
    assert x[:8] - np.r_[THETA, np.zeros(6)] == pytest.approx(expected, rel=2e-3, abs=1e-12)


def test_an_arm_whose_torques_do_not_bend_pushes_nothing():
    paper = replace(ARM, torque_convention='paper', angle_convention='chord')
    assert not residual_modes(paper, THETA, 3, ROWS, np.zeros(4, bool)).push.any()


def test_an_event_shakes_the_rates_of_an_arm_of_more_modes(of_three, of_six):
    model = structured.init(config(replace(ARM, modes=3))).model
    for memory, least, most in ((of_three, 0.8, 2.5), (of_six, 8.0, 12.0)):
        shaken = mem.copy(memory)
        structured_model.shake(model, shaken)
        ratio = shaken.noise[2:4, mem.EFFECTIVE] / shaken.noise[2:4, mem.WHITE]
        assert np.all((ratio > least) & (ratio < most))


@pytest.mark.parametrize('seed', [1, 2, 3])
def test_an_arm_of_more_modes_than_the_estimator_is_weighed_within_the_interval(seed):
    capture = event(1.0)
    samples = record(2.0, (capture,), arm=replace(ARM, modes=6), snr_db=30.0, seed=seed)
    settings = config(replace(ARM, modes=3))
    state = structured.advance(settings, structured.init(settings), samples.between(0, 1000))
    state = structured.event(settings, state, capture)
    for begin, stop in ((1000, 1060), (1060, 1250), (1250, 2000)):
        state = structured.advance(settings, state, samples.between(begin, stop))
        found = structured.estimate(settings, state)
        assert found.lower < 20.0 < found.upper
    assert found.status is Status.TRACKING
