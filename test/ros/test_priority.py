"""The identifier runs at real-time priority where the system permits it, and says so where it does not."""

import errno
import os

import pytest
from thread_program import said

from flexmanip_ros.ros import priority


def test_threads_of_now_get_the_priority_and_later_ones_do_not() -> None:
    what = said('priority', 7)
    if os.strerror(errno.EPERM) in what:
        pytest.skip('this system permits no real-time priority')
    assert what.split() == ['7', '7', '0']


def test_zero_leaves_everything_as_it_is() -> None:
    before = os.sched_getscheduler(0)
    assert priority.take(0) == ''
    assert os.sched_getscheduler(0) == before


@pytest.mark.parametrize(('problem', 'words'), [
    (PermissionError(errno.EPERM, os.strerror(errno.EPERM)), os.strerror(errno.EPERM)),
    (AttributeError('sched_setscheduler'), 'not on this system'),
])
def test_a_refusal_is_told_not_raised(
        monkeypatch: pytest.MonkeyPatch, problem: Exception, words: str) -> None:
    def refuse(*_: object) -> None:
        raise problem

    monkeypatch.setattr(os, 'sched_setscheduler', refuse)
    assert priority.take(7) == words
