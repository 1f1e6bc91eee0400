"""A process stays on the cores it is given, its later threads too; cores that are not there are told."""

import os

import pytest
from identifier_harness import Live
from ros_harness import Ros
from thread_program import said

from flexmanip_ros.ros import affinity


def test_threads_of_now_and_later_ones_stay_on_the_core() -> None:
    core = max(os.sched_getaffinity(0))
    assert said('affinity', [core]).split() == [str(core)] * 3


def test_no_cores_leave_everything_as_it_is() -> None:
    before = os.sched_getaffinity(0)
    assert affinity.take([]) == ''
    assert os.sched_getaffinity(0) == before


@pytest.mark.parametrize('cores', [[100_000], [-1], [2 ** 62]])
def test_cores_that_are_not_there_are_told_and_change_nothing(cores: list[int]) -> None:
    before = os.sched_getaffinity(0)
    assert affinity.take(cores) != ''
    assert os.sched_getaffinity(0) == before


def test_a_core_that_is_not_there_among_others_is_told() -> None:
    there = sorted(os.sched_getaffinity(0))
    assert '100000' in affinity.take([*there, 100_000])
    assert sorted(os.sched_getaffinity(0)) == there


def test_a_node_says_what_it_has(ros: Ros) -> None:
    live = Live(ros, cpu_affinity=[100_000], thread_priority=0)
    live.node.real_time.take()
    ros.wait(lambda: live.values().get('cpu_affinity') == affinity.current(), what='the cores it has')
