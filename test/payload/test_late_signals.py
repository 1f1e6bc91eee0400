"""Signals that come late: learned where the empty arm shows it, and then the payload is read as without."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from recording import BENDS, config, event, record
from scipy.stats import multivariate_normal

from flexmanip_ros.parameters import ArmParameters, IdentifierParameters
from flexmanip_ros.payload import filter_state as mem
from flexmanip_ros.payload import structured
from flexmanip_ros.payload.arm_parameters import taught
from flexmanip_ros.payload.gauss_newton import condition, evidence_against_delays
from flexmanip_ros.payload.process_model import Kind
from flexmanip_ros.samples.sample_log import Rows
from flexmanip_ros.types import Payload, Status

IDEAL = ArmParameters(damping_ratio=0.003)
GIVEN = config(IDEAL, outputs=BENDS)
DELAY, LAG = replace(IDEAL, torque_delay=2e-3), replace(IDEAL, torque_lag=(5e-3, 5e-3))


def read(given: IdentifierParameters, rows: Rows, piece: int = 3000) -> tuple[structured.StructuredState, Payload]:
    """State before the capture, payload at the end."""
    state = structured.init(given)
    for first in range(0, 3000, piece):
        state = structured.advance(given, state, rows.between(first, first + piece))
    empty, state = state, structured.event(given, state, event(3.0))
    for first in range(3000, 6000, piece):
        state = structured.advance(given, state, rows.between(first, first + piece))
    return empty, structured.estimate(given, state)


@cache
def known(arm: ArmParameters, seed: int) -> tuple[structured.StructuredState, Payload]:
    """The same of a recording of an arm, taken in two pieces."""
    return read(GIVEN, record(6.0, (event(3.0),), outputs=BENDS, arm=arm, seed=seed))


@pytest.mark.parametrize(('arm', 'seed'), [(DELAY, 0), (LAG, 3)])
def test_a_delay_or_lag_that_was_learned_costs_less_than_one_percent_of_the_payload(
        arm: ArmParameters, seed: int) -> None:
    empty, found = known(arm, seed)
    assert found.status is Status.TRACKING
    assert found.mass == pytest.approx(20.0, rel=0.01)
    assert found.lower < 20.0 < found.upper
    learned = {one.name: one.value for one in taught(GIVEN, empty)}
    late = learned['torque_delay'] + learned['joint1_torque_lag']
    assert late == pytest.approx(arm.torque_delay + arm.torque_lag[0], abs=3e-4)


def test_a_delay_that_may_not_be_learned_is_not_trusted() -> None:
    others = tuple(name for name in GIVEN.payload.learn if 'delay' not in name and 'lag' not in name)
    given = replace(GIVEN, payload=replace(GIVEN.payload, learn=others))
    _, found = read(given, record(6.0, (event(3.0),), outputs=BENDS, arm=DELAY, seed=3))
    assert found.status is not Status.TRACKING


def test_pieces_of_a_recording_give_the_same_bits() -> None:
    rows = record(6.0, (event(3.0),), outputs=BENDS, arm=DELAY, seed=0)
    one, other = known(DELAY, 0), read(GIVEN, rows, 250)
    assert np.array_equal(one[0].memory.x, other[0].memory.x)
    assert one[1] == other[1]


LATE = (Kind.TORQUE_DELAY, Kind.TORQUE_LAG, Kind.BEND_DELAY)
FAULTY = replace(IDEAL, torque_gain=(1.04, 1.04), bend_gain=(0.98, 0.98), bend_offset=(5e-4, 5e-4))


def test_delays_that_the_empty_arm_does_not_show_are_not_learned() -> None:
    """The arm has modes that the model lacks, which look like a delay of 0.1 ms."""
    rows = record(6.0, (event(3.0),), outputs=BENDS, arm=replace(FAULTY, modes=5), seed=0)
    empty, found = read(GIVEN, rows)
    assert {one.name: one.value for one in taught(GIVEN, empty)}['torque_delay'] == 0.0
    late = np.isin(empty.model.motion.kind, LATE)
    assert not empty.memory.S[empty.model.payload:][late].any()
    assert empty.memory.S[empty.model.payload:][empty.model.motion.kind == Kind.TORQUE_GAIN].any()
    assert found.mass == pytest.approx(20.0, rel=3e-3)
    assert found.lower < 20.0 < found.upper


def test_the_evidence_against_delays_is_the_density_of_none_after_the_samples_over_that_before() -> None:
    state = structured.advance(GIVEN, structured.init(GIVEN), record(1.0, outputs=BENDS, arm=DELAY, seed=0))
    motion, m = state.model.motion, mem.copy(state.memory)
    late = np.flatnonzero(np.isin(motion.kind, LATE))
    rng = np.random.default_rng(2)
    m.S[:] = np.tril(rng.normal(size=m.S.shape)) * 1e-4
    m.x[state.model.payload:] = rng.normal(size=motion.kind.size) * 1e-4
    m.score[mem.SANDWICH] = 3.0
    rows = state.model.payload + late
    after = multivariate_normal(m.x[rows], 3.0 * m.S[rows] @ m.S[rows].T)
    before = multivariate_normal(motion.given[late], np.diag(motion.prior[late] ** 2))
    expected = after.logpdf(motion.given[late]) - before.logpdf(motion.given[late])
    assert evidence_against_delays(motion, state.sensors, m) == pytest.approx(expected, rel=1e-9)


def test_a_state_given_one_of_its_entries_is_that_of_a_gaussian() -> None:
    rng = np.random.default_rng(3)
    x, S = rng.normal(size=6), np.tril(rng.normal(size=(6, 6)))
    P, rest = S @ S.T, [0, 1, 2, 4, 5]
    mean = x[rest] + P[rest, 3] / P[3, 3] * (0.5 - x[3])
    covariance = P[np.ix_(rest, rest)] - np.outer(P[rest, 3], P[rest, 3]) / P[3, 3]
    condition(x, S, 3, 0.5, np.zeros(6))
    assert x[3] == 0.5
    assert not S[3].any()
    np.testing.assert_allclose(x[rest], mean, rtol=1e-12)
    np.testing.assert_allclose((S @ S.T)[np.ix_(rest, rest)], covariance, atol=1e-12)
