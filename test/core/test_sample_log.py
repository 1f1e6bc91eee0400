"""The sample log is a value: what was appended stays readable, and no log sees the rows of another."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexmanip_ros.samples.sample_log import SMALLEST, SampleLog, Width


def appended(log: SampleLog, values: list[float], delay: int = 0) -> SampleLog:
    column = np.array(values)[:, None]
    stamps = np.array(values, dtype=np.int64)
    return log.append(stamps, column, 10.0 * column, np.zeros((len(values), 0)), np.zeros(len(values), bool), delay)


EMPTY = SampleLog(Width(1, 1, 0))


@settings(max_examples=50)
@given(st.lists(st.integers(0, 700), max_size=8), st.integers(0, 500))
def test_rows_read_the_same_however_they_were_appended(sizes: list[int], trimmed: int) -> None:
    log, total = EMPTY, 0
    for size in sizes:
        log = appended(log, [float(k) for k in range(total, total + size)])
        total += size
        log = log.from_row(min(trimmed, log.end))
    rows = log.rows(log.start, log.end)
    assert rows.stamp_ns.tolist() == list(range(min(trimmed, total), total))
    assert (rows.y == 10.0 * rows.u).all()


def test_two_continuations_of_one_log_do_not_see_each_other() -> None:
    common = appended(EMPTY, [0.0, 1.0])
    one, other = appended(common, [2.0]), appended(common, [7.0])
    assert one.rows(0, 3).stamp_ns.tolist() == [0, 1, 2]
    assert other.rows(0, 3).stamp_ns.tolist() == [0, 1, 7]
    assert common.end == 2


def test_a_row_is_shown_once_its_inputs_are_there() -> None:
    log = appended(EMPTY, [0.0], delay=2)
    assert log.end == 0
    log = appended(log, [1.0, 2.0, 3.0], delay=2)
    assert log.rows(0, log.end).u[:, 0].tolist() == [2.0, 3.0]
    assert log.rows(0, log.end).y[:, 0].tolist() == [0.0, 10.0]
    one, other = appended(log, [4.0], delay=2), appended(log, [9.0], delay=2)
    assert one.rows(0, 3).u[2, 0] == 4.0
    assert other.rows(0, 3).u[2, 0] == 9.0


def test_a_row_that_was_dropped_is_an_error_not_another_row() -> None:
    log = appended(EMPTY, [float(k) for k in range(10)]).from_row(4)
    with pytest.raises(IndexError, match='4 to 10'):
        log.rows(3, 5)
    with pytest.raises(IndexError):
        log.rows(4, 10).since(2)


def test_memory_stays_constant_when_old_rows_are_dropped() -> None:
    log = EMPTY
    for first in range(0, 100 * SMALLEST, 64):
        log = appended(log, [float(k) for k in range(first, first + 64)]).from_row(first)
    assert log._buffer is not None
    assert len(log._buffer.stamp_ns) == SMALLEST


def test_the_first_row_at_a_stamp() -> None:
    log = appended(EMPTY, [0.0, 10.0, 20.0])
    assert [log.row_at(stamp, 0) for stamp in (-5, 0, 1, 20, 21)] == [0, 0, 1, 2, 3]
    assert log.row_at(0, 2) == 2
