"""What is published, as plain values."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flexmanip_ros.errors import SignalError
from flexmanip_ros.messages import LabelledArray, model_matrix, modes_matrix, outgoing, read_model
from flexmanip_ros.types import Estimate, Mode, Payload, StateSpace, Status


def _model(n: int = 4, r: int = 2, m: int = 3) -> StateSpace:
    rng = np.random.default_rng(1)
    return StateSpace(rng.normal(size=(n, n)), rng.normal(size=(n, r)), rng.normal(size=(m, n)),
                      rng.normal(size=(m, r)), rng.normal(size=(n, m)), 0.001)


def _payload(mass: float = 20.0, std: float = 0.1) -> Payload:
    return Payload(mass, std, mass - 2 * std, mass + 2 * std, 1.0, Status.TRACKING)


def test_the_model_message_is_laid_out_as_the_contract_says():
    matrix = model_matrix(_model())
    rows, columns = matrix.dimensions
    assert rows.label == 'rows: state=4 output=3 dt=0.001'
    assert columns.label == 'columns: state=4 input=2 innovation=3'
    assert (rows.size, rows.stride, columns.size, columns.stride) == (7, 63, 9, 9)
    block = matrix.data.reshape(7, 9)
    np.testing.assert_array_equal(block[:4, 6:], _model().K)
    np.testing.assert_array_equal(block[4:, 6:], np.eye(3))


def test_a_model_survives_the_message_bit_for_bit():
    model = _model(3, 1, 1)
    back = read_model(model_matrix(model))
    for name in 'ABCDK':
        np.testing.assert_array_equal(getattr(back, name), getattr(model, name))
    assert back.dt == model.dt


def test_a_model_message_of_the_wrong_size_is_refused():
    matrix = model_matrix(_model())
    with pytest.raises(SignalError, match='values'):
        read_model(LabelledArray(matrix.dimensions, matrix.data[:-1]))
    with pytest.raises(SignalError, match='labelled'):
        read_model(LabelledArray((), matrix.data))


def test_modes_are_sorted_and_finite():
    matrix = modes_matrix((Mode(7.0, 0.1), Mode(math.nan, 0.1), Mode(5.0, 0.2)))
    np.testing.assert_array_equal(matrix.data.reshape(-1, 2), [[5.0, 0.2], [7.0, 0.1]])


def test_nothing_that_is_not_a_number_is_published():
    broken = _model()
    broken.A[0, 0] = math.nan
    estimate = Estimate(0, Status.TRACKING, broken, (), _payload(math.nan))
    assert list(outgoing(estimate, 'tip')) == []
    assert list(outgoing(Estimate(0, Status.WARMING_UP, None, (), None), 'tip')) == []


def _names(payload: Payload) -> list[str]:
    return [name for name, _ in outgoing(Estimate(0, Status.TRACKING, None, (), payload), 'tip')]


def test_a_driver_is_told_no_payload_of_unbounded_uncertainty():
    assert _names(_payload(0.0, math.inf)) == ['payload_estimate', 'status']
    assert _names(_payload()) == ['payload', 'payload_estimate', 'payload_mass', 'status']
