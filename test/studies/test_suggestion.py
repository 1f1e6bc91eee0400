"""What --suggest chooses and says: refined models are scored as they are, each reason is that of the value written."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from flexmanip_ros.identification.validation import simulate
from flexmanip_ros.samples.sample_log import Signals
from flexmanip_ros.studies import shape_search
from flexmanip_ros.studies.suggestion import suggest
from flexmanip_ros.types import StateSpace

DT, COUNT = 0.004, 2000
GIVEN = {'inputs': ('a/effort',), 'outputs': ('a/position', 'b/position'), 'angles': (), 'payload_method': 'none',
         'decimation': 1, 'past_window': 10}


@cache
def machine() -> tuple[StateSpace, Signals]:
    """Two modes of 1.5 and 9 Hz with a damping ratio of 0.01, driven by steps, noise of 1 %."""
    rng = np.random.default_rng(8)
    A = np.zeros((4, 4))
    for k, hertz in enumerate((1.5, 9.0)):
        pole = np.exp((-0.01 + 1j) * 2.0 * np.pi * hertz * DT)
        A[2 * k:2 * k + 2, 2 * k:2 * k + 2] = [[pole.real, -pole.imag], [pole.imag, pole.real]]
    B, C = np.array([[0.3], [1.0], [0.5], [-1.0]]), np.array([[1.0, 0.0, 0.5, 0.2], [-0.5, 0.3, 1.0, 0.0]])
    model = StateSpace(A, B, C, np.zeros((2, 1)), np.zeros((4, 2)), DT)
    u = np.repeat(rng.choice([-1.0, 1.0], size=COUNT // 12 + 1), 12)[:COUNT, None]
    y = simulate(model, u)
    y += 0.01 * y.std(axis=0) * rng.standard_normal(y.shape)
    stamps = np.round(np.arange(COUNT) * DT * 1e9).astype(np.int64)
    return model, Signals(stamps, u, y, np.empty((COUNT, 0)), np.zeros(COUNT, dtype=np.bool_),
                          np.zeros(COUNT, dtype=np.int64), GIVEN['inputs'], GIVEN['outputs'])


@cache
def chosen(*more: tuple[str, Any]) -> tuple[dict[str, Any], dict[str, str]]:
    values, reasons = suggest({**GIVEN, **dict(more)}, machine()[1], DT, 0.25, lambda done, total: None)
    return values, dict(reasons)


def test_a_model_without_a_gain_is_scored_from_the_state_that_fits_the_samples_before() -> None:
    model, signals = machine()
    search = shape_search.Search({}, [shape_search.Stretch(np.hstack([signals.u, signals.y]), 0)], 1, 2, DT, 0.25)
    error, power = shape_search.powers(search, model, search.kept(1), 1, 10, np.arange(COUNT) >= COUNT // 2)
    assert np.all(error < 2e-4 * power)


def test_a_refined_model_that_predicts_better_is_taken_and_each_reason_is_that_of_its_value() -> None:
    values, reasons = chosen()
    assert values['refinement'] == 'output_error'
    for name in ('decimation', 'past_window', 'future_window', 'order', 'direct_feedthrough', 'weighted_observability'):
        if name not in GIVEN:
            assert reasons[name].startswith(f'{values[name]}: ')


def test_a_refinement_that_is_set_stays_in_use() -> None:
    values, _ = chosen(('refinement', 'output_error'), ('order', 4))
    assert (values['refinement'], values['forgetting']) == ('output_error', 'innovation')


def test_a_forgetting_that_is_set_is_not_called_none() -> None:
    values, reasons = chosen(('forgetting', 'constant'), ('forgetting_factor', (0.995,) * 3), ('order', 4))
    assert values['forgetting_factor'] == (0.995,) * 3
    assert 'no forgetting' not in reasons['forgetting, refinement']


def test_a_clean_resonance_gets_the_order_of_a_resonance_and_no_mode_that_is_not_there() -> None:
    """20 s at 50 Hz, damping ratio 0.02, noise of 1 %. Order 14 predicts 8 % worse than a refined model of 2 or 3."""
    rng, dt, count = np.random.default_rng(0), 0.02, 1000
    pole = np.exp((-0.02 + 1j) * 2.0 * np.pi * 3.0 * dt)
    model = StateSpace(np.array([[pole.real, -pole.imag], [pole.imag, pole.real]]), np.array([[0.1], [0.3]]),
                       np.array([[1.0, 0.0]]), np.zeros((1, 1)), np.zeros((2, 1)), dt)
    u = np.repeat(rng.choice([-1.0, 1.0], size=count // 5), 5)[:, None]
    y = simulate(model, u)
    y += 0.01 * y.std() * rng.standard_normal(y.shape)
    given = {**GIVEN, 'outputs': ('a/position',), 'past_window': 20, 'future_window': 16}
    values, _ = suggest(given, Signals(
        np.arange(count) * 20_000_000, u, y, np.empty((count, 0)), np.zeros(count, dtype=np.bool_),
        np.zeros(count, dtype=np.int64), given['inputs'], given['outputs']), dt, 0.25, lambda done, total: None)
    assert values['order'] <= 3
    assert values['refinement'] != 'none'
