"""A prepared kernel is the kernel, called without a look at its arguments; other first ones are looked at."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from numba import njit
from numba.core.errors import TypingError
from numpy.typing import NDArray

from flexmanip_ros.numerics.compiled import Prepared
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload import structured
from flexmanip_ros.samples.sample_log import log_of


class Table(NamedTuple):
    values: NDArray[np.float64]


@njit
def weigh(table: Table, by: NDArray[np.float64]) -> float:
    total = 0.0
    for i in range(table.values.shape[0]):
        for j in range(table.values.shape[1]):
            total += by[i] * table.values[i, j]
    return total


def test_it_gives_what_the_kernel_gives_whatever_the_memory_order_of_the_first_arguments() -> None:
    prepared = Prepared(weigh, 1)
    values, by = np.arange(12.0).reshape(3, 4), np.array([1.0, 10.0, 100.0])
    expected = float(by @ values.sum(axis=1))
    strided = np.repeat(values, 2, axis=1)[:, ::2]
    for table in (Table(values), Table(np.asfortranarray(values)), Table(strided)):
        for _ in range(2):
            assert prepared(table, by) == weigh(table, by) == pytest.approx(expected)


def test_an_error_of_types_is_told_as_ever() -> None:
    with pytest.raises(TypingError):
        Prepared(weigh, 1)(Table(np.zeros((2, 2))), 'text')


def test_no_samples_are_a_table_without_rows() -> None:
    model = structured.init(IdentifierParameters()).model
    assert model is not None
    rows = log_of(np.zeros((0, 2)), np.zeros((0, 4)), np.zeros((0, 2))).rows(0, 0)
    assert structured.measurements(model, rows).shape == (0, len(model.roles))
