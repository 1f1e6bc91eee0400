"""Process noise of the torques, by Coulomb friction and noisy efforts, and the filter that carries it along a fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from recording import altered, event, noise_of_rows, record, run

from flexmanip_ros.arm.equations_of_motion import STICTION_RATE
from flexmanip_ros.parameters import ArmParameters, IdentifierParameters
from flexmanip_ros.payload import filter_state as mem
from flexmanip_ros.payload import structured
from flexmanip_ros.payload.measurement_update import observe
from flexmanip_ros.payload.moving_horizon import MODELLED_SHARE, WAVES, choose_rates
from flexmanip_ros.payload.process_model import Kind, predict
from flexmanip_ros.samples.sample_log import Rows
from flexmanip_ros.types import Status

ARM = ArmParameters(damping_ratio=0.003)
RUBBING = replace(ARM, joint_coulomb_friction=(1.0, 0.5))
CONFIG = IdentifierParameters(arm=ARM)
EFFORT_STD = 0.3
"""Deviation of the noise of reported efforts [N m], of torques of 10 and 5 N m."""


def noisily_reported(rows: Rows, seed: int = 1) -> Rows:
    """Return the same motion with white noise in the efforts, which does not act on the arm."""
    return altered(rows, u=rows.u + np.random.default_rng(seed).normal(0.0, EFFORT_STD, rows.u.shape))


def handed_over(samples: Rows) -> tuple[structured.StructuredState, structured.StructuredState]:
    """Return the states before and after a sample at which the filter goes on from a fit with noise of the torques."""
    state = structured.init(CONFIG)
    for k in range(len(samples)):
        before, state = state, structured.advance(CONFIG, state, samples.between(k, k + 1))
        if before.memory is None or state.memory is None or state.memory.counts[mem.STORED] < 150:
            continue
        m, newest = state.memory, int(before.memory.counts[mem.STORED]) + 1
        if m.counts[mem.LINEARIZED] and not m.counts[mem.ITERATING] and m.counts[mem.BEFORE] == newest:
            return before, state
    raise AssertionError('no fit reached the newest sample')


def kalman(before: structured.StructuredState, state: structured.StructuredState, samples: Rows
           ) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and covariance of a textbook Kalman filter, linearized about the trajectory of the last iteration."""
    m, sensors, motion = state.memory, state.sensors, state.model.motion
    table, _ = structured.input_table(before, samples.between(before.cursor, state.cursor))
    n, nx, links = sensors.H.shape[1], m.x.size, motion.effort.size
    known = ~m.S0.any(axis=1)
    x, P = m.x0 + m.S0 @ m.accepted, m.S0 @ m.S0.T
    d = m.x0 - x
    variance, f = np.zeros(links), np.zeros(nx)
    r = noise_of_rows(state, table[sensors.reach - 1:, 1:1 + links])
    for k in range(int(m.counts[mem.BEFORE])):
        row = k + sensors.reach - 1
        F = np.diag(np.where(known, 0.0, 1.0))
        rows = table[row + 1 - sensors.reach:row + 1]
        assert predict(motion, x, F, nx, rows, sensors.period, table[row, 0])
        d, P = F @ d, F @ P @ F.T
        for i in range(len(m.noise)):
            e = table[row, 1 + 3 * links + i] - observe(sensors, i, n, x, np.eye(nx), f, motion.k[0])
            v = f @ P @ f + r[k, i]
            d, P = d + P @ f * (e - f @ d) / v, P - np.outer(P @ f, f @ P) / v
        variance += (motion.coulomb * MODELLED_SHARE / np.cosh(motion.work.net[1] / (WAVES * STICTION_RATE))) ** 2
        variance += m.effort_noise
        if (k + 1) % sensors.kicks_every == 0:
            L = np.tril(motion.work.M)
            np.fill_diagonal(L, 1.0 / np.diag(L))
            kicks = np.linalg.solve(L @ L.T, motion.work.B) * sensors.period
            P[n:2 * n, n:2 * n] += kicks @ np.diag(variance) @ kicks.T
            variance[:] = 0.0
    return x + d, P


@pytest.mark.parametrize('samples', [record(2.5, arm=RUBBING), noisily_reported(record(1.0, arm=ARM))],
                         ids=['friction', 'noisy efforts'])
def test_the_filter_goes_on_from_a_kalman_filter_linearized_about_the_trajectory_of_the_fit(samples: Rows) -> None:
    before, state = handed_over(samples)
    m = state.memory
    mean, covariance = kalman(before, state, samples)
    std = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    found = m.S @ m.S.T
    np.testing.assert_allclose((m.x - mean) / std, 0.0, atol=1e-5)
    np.testing.assert_allclose(found / np.outer(std, std), covariance / np.outer(std, std), atol=1e-5)


def test_steps_of_the_torque_are_no_noise_so_an_arm_without_friction_carries_no_linearized_filter() -> None:
    state = structured.advance(CONFIG, structured.init(CONFIG), record(1.0, arm=ARM))
    assert not state.memory.effort_noise.any()
    assert state.memory.counts[mem.LINEARIZED] == 0


def test_the_noise_of_the_reported_efforts_is_found_and_stays_noise_when_it_does_not_act_on_the_arm() -> None:
    memory = run(CONFIG, noisily_reported(record(2.5, arm=ARM))).memory
    assert np.sqrt(memory.effort_noise) == pytest.approx(EFFORT_STD, rel=0.15)
    assert memory.counts[mem.EFFORTS] == mem.CONFIRMED


def test_a_white_part_that_acts_on_the_arm_is_no_noise() -> None:
    torque = np.random.default_rng(1).normal(0.0, 1.0, (2500, 2))
    memory = run(CONFIG, record(2.5, arm=ARM, peaks=(10.0, 5.0), added=torque)).memory
    assert np.all(memory.effort_noise > 0.0)
    assert memory.counts[mem.EFFORTS] == mem.EXACT


@pytest.mark.parametrize('seed', [1, 2])
def test_with_noisy_efforts_the_mass_is_inside_its_interval_and_trusted(seed: int) -> None:
    """When these efforts were taken for true, 13 % of the trusted estimates were outside."""
    samples = noisily_reported(record(4.5, (event(2.5),), arm=ARM, seed=seed), seed)
    found = structured.estimate(CONFIG, run(CONFIG, samples, (event(2.5),)))
    assert found.status is Status.TRACKING
    assert found.lower < 20.0 < found.upper
    assert found.mass == pytest.approx(20.0, rel=0.02)


def test_with_a_friction_of_a_tenth_of_the_torque_masses_are_trusted_and_as_far_off_as_they_say() -> None:
    """The rates of the joints are not measured. Without this noise a third of such estimates were outside."""
    errors = []
    for seed in (1, 2, 3):
        state = run(CONFIG, record(3.5, (event(2.0),), arm=RUBBING, seed=seed), (event(2.0),))
        found = structured.estimate(CONFIG, state)
        assert found.status is Status.TRACKING
        assert found.mass == pytest.approx(20.0, rel=0.01)
        errors.append((found.mass - 20.0) / found.std)
    assert np.sqrt(np.mean(np.square(errors))) < 1.6  # the root of chi-square over 3 exceeds it 1 time in 20


def test_friction_follows_measured_rates_where_a_step_of_the_torque_adds_more_to_them_than_their_noise() -> None:
    """Where torques are smooth it follows the model's. By noisy rates an arm at rest seemed to hold 10 kg for 16."""
    state = structured.init(CONFIG)
    state = structured.advance(CONFIG, state, record(0.1, arm=RUBBING))
    m, sensors, motion = state.memory, state.sensors, state.model.motion
    m.rate_noise[:] = [0.25, np.inf]
    for step, measured in ((0.0, False), (20.0, True)):
        m.ringing[0, :2] = 0.0
        m.ringing[0, 0] = step
        choose_rates(motion, sensors, m, m.ringing[0])
        assert motion.modelled.tolist() == [not measured, True]


@pytest.mark.parametrize(('failed', 'deviations'), [(0, 0.0), (1, 1.0), (2, 1.0), (3, 1.0)])
def test_a_fit_that_failed_begins_again_with_other_rotors_and_friction(failed, deviations):
    samples = record(0.024)
    state = structured.advance(CONFIG, structured.init(CONFIG)._replace(refits=failed), samples)
    motion, begun = state.model.motion, state.memory.x0[-state.model.motion.kind.size:]
    for kind in (Kind.VISCOUS, Kind.COULOMB, Kind.ROTOR):
        some = motion.kind == kind
        assert np.all(motion.prior[some] > 0.0)
        assert begun[some] == pytest.approx(motion.given[some] + deviations * motion.prior[some], rel=1e-9, abs=1e-15)
