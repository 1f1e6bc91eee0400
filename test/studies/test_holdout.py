"""Scores on the part of a recording that was not identified on."""

from __future__ import annotations

import numpy as np
import pytest

from flexmanip_ros.errors import ModelError, ParameterError
from flexmanip_ros.samples.sample_log import Signals
from flexmanip_ros.studies.holdout import score
from flexmanip_ros.types import StateSpace

DT = 0.01


def _system() -> StateSpace:
    A = np.array([[0.9, 0.3], [-0.3, 0.9]])
    B, C = np.array([[0.5], [1.0]]), np.array([[1.0, 0.2]])
    return StateSpace(A, B, C, np.zeros((1, 1)), np.zeros((2, 1)), DT)


def _signals(noise: float = 0.0, gap_at: int | None = None, count: int = 800) -> Signals:
    rng = np.random.default_rng(2)
    model, x = _system(), np.zeros(2)
    u, y = rng.normal(size=(count, 1)), np.empty((count, 1))
    for k in range(count):
        y[k] = model.C @ x + noise * rng.normal()
        x = model.A @ x + model.B @ u[k]
    gap = np.zeros(count, dtype=np.bool_)
    if gap_at is not None:
        gap[gap_at] = True
    stamps = np.arange(count, dtype=np.int64) * 10_000_000
    return Signals(stamps, u, y, np.empty((count, 0)), gap, np.zeros(count, int), ('a/effort',), ('a/position',))


def test_the_true_model_scores_a_hundred_percent():
    found = score(_system(), _signals(), 4.0)
    assert found.simulation == pytest.approx([100.0])
    assert found.prediction == pytest.approx([100.0])
    assert found.time[0] == pytest.approx(4.0)
    assert not found.until_gap


def test_noise_costs_what_its_variance_is():
    signals = _signals(noise=0.3)
    expected = 100.0 * (1.0 - 0.09 / np.var(signals.y[400:]))
    assert score(_system(), signals, 4.0).simulation == pytest.approx([expected], abs=2.0)


def test_the_score_ends_at_a_gap_and_says_so():
    found = score(_system(), _signals(gap_at=600), 4.0)
    assert found.time.size == 200
    assert found.until_gap


def test_an_unstable_model_scores_zero():
    model = _system()
    wild = StateSpace(2.0 * model.A, model.B, model.C, model.D, model.K, DT)
    assert score(wild, _signals(), 4.0).simulation == pytest.approx([0.0])


@pytest.mark.parametrize('start', [0.0, 8.0, -1.0, 1e9, float('nan')])
def test_nothing_to_score_is_said(start):
    with pytest.raises(ParameterError, match='leaves no samples'):
        score(_system(), _signals(), start)


def test_a_missing_model_is_said():
    with pytest.raises(ModelError, match='no model'):
        score(None, _signals(), 4.0)
