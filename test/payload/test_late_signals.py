"""Torques that come late: where the first fit shows it they are learned, and the payload is read as without."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from recording import BENDS, config, event, record

from flexmanip_ros.parameters import ArmParameters, IdentifierParameters
from flexmanip_ros.payload import structured
from flexmanip_ros.payload.arm_parameters import taught
from flexmanip_ros.samples.sample_log import Rows
from flexmanip_ros.types import Payload, Status

IDEAL = ArmParameters(damping_ratio=0.003)
GIVEN = config(IDEAL, outputs=BENDS)
DELAY, LAG = replace(IDEAL, torque_delay=2e-3), replace(IDEAL, torque_lag=(5e-3, 5e-3))


def read(given: IdentifierParameters, rows: Rows, piece: int = 3000) -> tuple[structured.StructuredState, Payload]:
    """State before the capture, payload at the end."""
    state = structured.init(given)
    for first in range(0, 3000, piece):
        state = structured.advance(given, state, rows.between(first, first + piece))
    empty, state = state, structured.event(given, state, event(3.0))
    for first in range(3000, 6000, piece):
        state = structured.advance(given, state, rows.between(first, first + piece))
    return empty, structured.estimate(given, state)


@pytest.mark.parametrize(('arm', 'seed'), [(DELAY, 0), (LAG, 3)])
def test_a_delay_or_lag_that_was_learned_costs_less_than_one_percent_of_the_payload(
        arm: ArmParameters, seed: int) -> None:
    empty, found = read(GIVEN, record(6.0, (event(3.0),), outputs=BENDS, arm=arm, seed=seed))
    assert found.status is Status.TRACKING
    assert found.mass == pytest.approx(20.0, rel=0.01)
    assert found.lower < 20.0 < found.upper
    learned = {one.name: one.value for one in taught(GIVEN, empty)}
    late = learned['torque_delay'] + learned['joint1_torque_lag']
    assert late == pytest.approx(arm.torque_delay + arm.torque_lag[0], abs=3e-4)


def test_a_delay_that_may_not_be_learned_is_not_trusted() -> None:
    others = tuple(name for name in GIVEN.payload.learn if 'delay' not in name and 'lag' not in name)
    given = replace(GIVEN, payload=replace(GIVEN.payload, learn=others))
    _, found = read(given, record(6.0, (event(3.0),), outputs=BENDS, arm=DELAY, seed=3))
    assert found.status is not Status.TRACKING


def test_pieces_of_a_recording_give_the_same_bits() -> None:
    rows = record(6.0, (event(3.0),), outputs=BENDS, arm=DELAY, seed=0)
    one, other = (read(GIVEN, rows, piece) for piece in (3000, 250))
    assert np.array_equal(one[0].memory.x, other[0].memory.x)
    assert one[1] == other[1]
