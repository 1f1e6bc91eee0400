"""Batch means: what the residuals of the empty arm's fit say of the variances of what it learned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from recording import noise_of_rows, record, run

from flexmanip_ros.parameters import ArmParameters, IdentifierParameters
from flexmanip_ros.payload import filter_state as mem
from flexmanip_ros.payload import structured
from flexmanip_ros.payload.arm_parameters import taught
from flexmanip_ros.payload.gauss_newton import widen_by_empty_arm
from flexmanip_ros.payload.measurement_update import BATCH, observe
from flexmanip_ros.payload.process_model import predict
from flexmanip_ros.samples.sample_log import Rows

ARM = ArmParameters(damping_ratio=0.003)
CONFIG = IdentifierParameters(arm=ARM)


def scores(before: structured.StructuredState, state: structured.StructuredState, samples: Rows) -> np.ndarray:
    """Return f e / r of each sample of the horizon that has just closed, (N, nx), at its last accepted step."""
    m, sensors, motion = state.memory, state.sensors, state.model.motion
    table, _ = structured.input_table(before, samples.between(before.cursor, state.cursor))
    used, first = int(m.counts[mem.USED]), 1 + 3 * motion.effort.size
    x, S = m.x0 + m.S0 @ m.accepted, m.S0.copy()
    r = noise_of_rows(state, table[sensors.reach - 1:, 1:1 + motion.effort.size])
    found, f = np.zeros((int(m.counts[mem.BEFORE]), m.x.size)), np.zeros(used)
    for k in range(len(found)):
        row = k + sensors.reach - 1
        assert predict(motion, x, S, used, table[row + 1 - sensors.reach:row + 1], sensors.period, table[row, 0])
        for i in range(len(m.noise)):
            e = table[row, first + i] - observe(sensors, i, sensors.H.shape[1], x, S, f, motion.k[0])
            found[k, :used] += f * e / r[k, i]
    return found


def closing(samples: Rows) -> tuple[structured.StructuredState, structured.StructuredState]:
    """Return the states before and after the sample at which the horizon of the empty arm closes with a fit."""
    state = structured.init(CONFIG)
    for k in range(len(samples)):
        before, state = state, structured.advance(CONFIG, state, samples.between(k, k + 1))
        if before.memory is None or state.memory is None:  # it begins, or begins again
            continue
        stored = before.memory.counts[mem.STORED]
        if stored < mem.HORIZON <= state.memory.counts[mem.STORED] and state.memory.counts[mem.BEFORE] == stored + 1:
            return before, state
    raise AssertionError('the horizon did not close')


def factor_of(found: np.ndarray, state: structured.StructuredState) -> float:
    """Return the variance by batch means over that of the fit, from all scores at once."""
    m = state.memory
    N = np.tril(m.normal) + np.tril(m.normal, -1).T
    W = np.linalg.inv(np.eye(len(N)) + N)
    rows = m.S0[state.model.payload:]
    rows = rows[np.abs(rows).max(axis=1) > 0.0] @ W
    length = BATCH * state.sensors.block
    batches = len(found) // length
    b = found[:batches * length].reshape(batches, length, -1).sum(axis=1)
    ratios = np.sum((b @ rows.T) ** 2, axis=0) / np.sum(rows @ N * rows, axis=1)
    return float(np.mean(ratios)) * len(found) / len(b) / length


def test_the_factor_is_the_variance_by_batch_means_over_that_of_the_fit() -> None:
    """Computed from all samples at once. The arm has more modes than the model, and a third of the damping."""
    arm = replace(ARM, modes=5, damping_ratio=0.001)
    before, state = closing(samples := record(3.2, arm=arm))
    m = state.memory
    factor = factor_of(scores(before, state, samples), state)
    assert m.score[mem.SANDWICH] == pytest.approx(factor, rel=1e-6)
    assert factor > 1.5
    known = {one.name: one.std for one in taught(CONFIG, state)}
    m.score[mem.SANDWICH] = 100.0 * factor
    assert known['link1_bending_stiffness'] * 10.0 == pytest.approx(
        next(one.std for one in taught(CONFIG, state) if one.name == 'link1_bending_stiffness'))


def test_an_arm_that_is_the_model_is_as_sure_as_its_fit() -> None:
    """The fit of an empty arm assumes more than the white noise, so chance hardly brings the factor above one."""
    for seed in (1, 2):
        assert run(CONFIG, record(2.0, arm=ARM, seed=seed)).memory.score[mem.SANDWICH] == 1.0


def test_with_an_object_the_variance_is_that_of_a_prior_that_is_too_small_by_the_factor() -> None:
    """W + (g - 1) W W, the same as W (g I + N) W: xi has the variance g I before the samples and is fitted as if I."""
    state = run(CONFIG, record(1.5, arm=ARM))
    sensors, m = state.sensors, mem.copy(state.memory)
    nx, factor = m.x.size, 7.0
    rng = np.random.default_rng(4)
    half, now = rng.normal(size=(2, nx, nx))
    W = np.linalg.inv(np.eye(nx) + half @ half.T)
    m.N[:] = np.linalg.cholesky(np.eye(nx) + half @ half.T)
    m.Sr[:, :nx] = np.linalg.solve(m.N, now.T).T
    m.S[:], m.counts[mem.USED] = m.Sr[:, :nx], nx
    m.score[mem.SANDWICH] = factor
    widen_by_empty_arm(sensors, m)
    expected = now @ W @ (factor * np.eye(nx) + half @ half.T) @ W @ now.T
    np.testing.assert_allclose(m.S @ m.S.T, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
