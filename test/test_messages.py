"""What is published, as plain values."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np

from flexmanip_ros.messages import message, model_matrix, modes_interval, modes_matrix, outgoing
from flexmanip_ros.types import Estimate, Mode, Payload, StateSpace, Status


def _model(n: int = 4, r: int = 2, m: int = 3) -> StateSpace:
    rng = np.random.default_rng(1)
    return StateSpace(rng.normal(size=(n, n)), rng.normal(size=(n, r)), rng.normal(size=(m, n)),
                      rng.normal(size=(m, r)), rng.normal(size=(n, m)), 0.001)


def _payload(mass: float = 20.0, std: float = 0.1) -> Payload:
    return Payload(mass, std, mass - 2 * std, mass + 2 * std, 1.0, Status.TRACKING)


def test_the_model_message_is_laid_out_as_the_contract_says():
    matrix = message(model_matrix(_model()), lambda kind, **fields: SimpleNamespace(**fields))
    rows, columns = matrix.layout.dim
    assert rows.label == 'rows: state=4 output=3 dt=0.001'
    assert columns.label == 'columns: state=4 input=2 innovation=3'
    assert (rows.size, rows.stride, columns.size, columns.stride) == (7, 63, 9, 9)
    block, model = matrix.data.reshape(7, 9), _model()
    np.testing.assert_array_equal(block, np.block([[model.A, model.B, model.K], [model.C, model.D, np.eye(3)]]))


def test_modes_are_sorted_and_always_as_many_rows_as_the_order_allows():
    found = (Mode(7.0, 0.1), Mode(math.nan, 0.1), Mode(5.0, 0.2))
    for modes, expected in ((found, [[5.0, 0.2], [7.0, 0.1], [math.nan] * 2]), ((), [[math.nan] * 2] * 3)):
        matrix = modes_matrix(modes, 6)
        np.testing.assert_array_equal(matrix.data, expected)
    assert modes_matrix((), 1).data.size == 0


def test_the_interval_of_a_mode_is_as_wide_as_its_deviation_says_and_nan_where_that_is_unknown():
    modes = Mode(7.0, 0.1, 0.5, 0.01), Mode(5.0, 0.2), Mode(9.0, 0.3, math.inf, 0.1)
    found = modes_interval(modes, 8).data
    nan, far = math.nan, 1.959963984540054
    np.testing.assert_allclose(found, [
        [nan] * 4, [7.0 - 0.5 * far, 7.0 + 0.5 * far, 0.1 - 0.01 * far, 0.1 + 0.01 * far],
        [nan, nan, 0.3 - 0.1 * far, 0.3 + 0.1 * far], [nan] * 4], rtol=1e-15)


def test_an_interval_that_says_nothing_sets_no_scale():
    found = modes_interval((Mode(7.0, 0.1, 1e10, 0.01), Mode(8.0, 0.1, 0.01, 1e6)), 4).data
    np.testing.assert_array_equal(np.isfinite(found), [[False, False, True, True], [True, True, False, False]])


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
