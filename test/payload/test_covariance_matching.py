"""Covariance matching: the moves of what the filter estimates against the fall of their variances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from recording import event, record, run

from flexmanip_ros.parameters import ArmParameters, IdentifierParameters
from flexmanip_ros.payload import filter_state as mem
from flexmanip_ros.payload import structured
from flexmanip_ros.payload.arm_parameters import taught
from flexmanip_ros.payload.interval import moves
from flexmanip_ros.payload.measurement_update import LEAST_FALL

ARM = ArmParameters(damping_ratio=0.003)
CONFIG = IdentifierParameters(arm=ARM)
CAUGHT = event(2.0)


def test_the_factor_is_the_mean_square_of_the_moves_over_the_falls_of_the_variances() -> None:
    """Taken sample by sample, means and variances written down where a batch begins. The arm has modes beyond those
    of the model, and Coulomb friction."""
    without_noise = replace(CONFIG, payload=replace(CONFIG.payload, memory_time=1e6))
    samples = record(2.6, arm=replace(ARM, modes=4, joint_coulomb_friction=(1.0, 0.5)), seed=2)
    state, ratios, begun = structured.init(without_noise), [], None
    for k in range(len(samples)):
        state = structured.advance(without_noise, state, samples.between(k, k + 1))
        m = state.memory
        if m is None or m.counts[mem.STORED] < mem.HORIZON:
            ratios, begun = [], None  # what is learned was opened, and the fit begins anew
        elif m.counts[mem.IN_BATCH] == 1:
            assert state.model is not None
            x, P = m.x[state.model.payload:].copy(), np.sum(m.S[state.model.payload:] ** 2, axis=1)
            if begun is not None:
                fall = begun[1] - P
                told = fall > LEAST_FALL * begun[1]
                ratios += list((x - begun[0])[told] ** 2 / fall[told])
                x, P = np.where(told, x, begun[0]), np.where(told, P, begun[1])
            begun = x, P
    assert len(ratios) > 50
    assert moves(state.memory) == pytest.approx(np.mean(ratios), rel=1e-3)
    assert moves(state.memory) > 1.2


def test_the_factor_is_about_one_on_an_arm_that_is_the_model() -> None:
    found = [moves(run(CONFIG, record(4.0, (CAUGHT,), arm=ARM, seed=seed), (CAUGHT,)).memory) for seed in (1, 2, 3)]
    assert np.mean(found) < 1.3


def test_deviations_of_payload_and_arm_parameters_grow_with_its_root() -> None:
    state = run(CONFIG, record(4.0, (CAUGHT,), arm=ARM), (CAUGHT,))
    other = state._replace(memory=mem.copy(state.memory))
    other.memory.score[mem.MOVES] = 4.0 * moves(state.memory)
    known = {one.name: one.std for one in taught(CONFIG, state)}
    for one in taught(CONFIG, other):
        if 'stiffness' in one.name or 'damping' in one.name:  # the rest is taken as known: this arm has none of it
            assert one.std == pytest.approx(2.0 * known[one.name]), one.name
    assert structured.estimate(CONFIG, other).std == pytest.approx(2.0 * structured.estimate(CONFIG, state).std)
