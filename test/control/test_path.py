from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexmanip_ros.control import controller

LOADS = np.array([[300.0, 90.0], [80.0, 120.0], [0.02, 0.01]])
LIMITS = np.array([150.0, 75.0, 0.01])
distances = st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)).map(np.array)


def along(way: controller.Path, count: int = 400) -> np.ndarray:
    """Return position, rate, acceleration and jerk (count + 1, 4, 2) from beginning to end."""
    return np.array([way.after(way.duration * k / count).now() for k in range(count + 1)])


@settings(max_examples=40)
@given(distances, st.floats(0.1, 2.0))
def test_a_move_from_rest_keeps_to_its_limits_and_touches_one(distance: np.ndarray, fastest: float) -> None:
    begin = np.array([0.3, -0.2])
    way = controller.plan(controller.rest(begin), begin + distance, controller.duration(
        distance, np.zeros(2), fastest, LOADS, LIMITS))
    rows = along(way)
    rate = np.abs(rows[:, 1]).max() / fastest
    load = (np.abs(rows[:, 2] @ LOADS.T) / LIMITS).max()
    assert max(rate, load) <= 1.0 + 1e-6
    assert max(rate, load) > 0.99 or way.duration == controller.SHORTEST
    assert rows[0, 0] == pytest.approx(begin)
    end = way.after(way.duration).now()
    assert end[0] == pytest.approx(begin + distance, abs=1e-9)
    assert not end[1:].any()


@given(distances, distances, st.floats(0.05, 0.95))
def test_another_goal_on_the_way_changes_neither_rate_nor_acceleration_at_once(
        first: np.ndarray, second: np.ndarray, share: float) -> None:
    way = controller.plan(controller.rest(np.zeros(2)), first, 1.0).after(share)
    new = controller.plan(way, second, controller.duration(second - way.now()[0], way.now()[1], 1.0, LOADS, LIMITS))
    assert new.now()[:3] == pytest.approx(way.now()[:3], rel=1e-9, abs=1e-9)
    assert new.goal == pytest.approx(second, abs=1e-7)


def test_rates_are_the_derivatives_of_positions() -> None:
    way = controller.plan(controller.rest(np.zeros(2)), np.array([0.4, -0.1]), 2.0)
    rows = along(way, 2000)
    for k in range(3):
        slope = np.gradient(rows[:, k], way.duration / 2000, axis=0)
        near = 2e-3 * (1.0 + np.abs(rows[:, k + 1]).max())
        assert slope[2:-2] == pytest.approx(rows[2:-2, k + 1], abs=near)


def test_stopping_where_one_is_takes_the_time_that_braking_takes() -> None:
    moving = controller.plan(controller.rest(np.zeros(2)), np.array([1.0, 0.5]), 2.0).after(1.0)
    position, rate = moving.now()[:2]
    seconds = controller.duration(np.zeros(2), rate, 1.0, LOADS, LIMITS)
    rows = along(controller.plan(moving, position, seconds))
    assert (np.abs(rows[:, 2] @ LOADS.T) / LIMITS).max() < 1.8


def test_a_joint_without_torque_of_its_own_does_not_limit_a_move() -> None:
    distance, rest = np.array([0.4, -0.1]), np.zeros(2)
    for limit in (0.0, 5e-324):
        assert controller.duration(distance, rest, 1.0, LOADS, np.array([limit, 75.0, 0.01])) \
            == controller.duration(distance, rest, 1.0, LOADS[1:], LIMITS[1:])
