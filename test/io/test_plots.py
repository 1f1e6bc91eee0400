"""What a stranger must be able to see in a picture."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip('matplotlib')

from flexmanip_ros.io import plots
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.samples import sampling
from flexmanip_ros.types import Estimate, JointRecord, Mode, Payload, Status
from flexmanip_ros.view import screen

BEFORE, AFTER = (5.76, 6.89), (5.63, 6.55)


def _estimates(extra: float | None = None) -> list[Estimate]:
    rows = []
    for k in range(200):
        found = [*(BEFORE if k < 100 else AFTER), *([] if extra is None else [extra])]
        rows.append(Estimate(k * 10_000_000, Status.TRACKING, None, tuple(Mode(f, 0.01, 0.01) for f in found),
                             None))
    return rows


def _drawn(estimates, truth=()):
    _, (ax,) = plots.figure([2.0])
    plots.frequencies(ax, estimates, 0, truth)
    return ax, [text.get_text() for text in ax.texts]


@pytest.mark.parametrize('truth', [(), [(0.0, 1.0, BEFORE), (1.0, 2.0, AFTER)]])
def test_a_mode_of_the_noise_does_not_hide_what_a_capture_changes(truth):
    ax, said = _drawn(_estimates(extra=50.0), truth)
    low, high = ax.get_ylim()
    assert low < min(AFTER)
    assert max(BEFORE) < high
    assert high - low < 5.0
    assert said == ['outside: 50.0 Hz']


def test_the_mode_of_an_empty_arm_is_seen_where_the_object_takes_it_to_a_tenth():
    estimates = [Estimate(k * 10_000_000, Status.TRACKING, None, (Mode(10.0 if k < 40 else 1.0, 0.01, 0.01),), None)
                 for k in range(200)]
    ax, said = _drawn(estimates)
    assert ax.get_ylim()[1] > 10.0
    assert ax.get_ylim()[0] < 1.0
    assert said == []


def test_nothing_is_said_of_modes_outside_when_there_are_none():
    assert _drawn(_estimates())[1] == []


def test_estimates_without_modes_can_be_drawn():
    nothing = [Estimate(k, Status.WARMING_UP, None, (), None) for k in range(3)]
    assert _drawn(nothing)[1] == []
    _drawn([Estimate(0, Status.TRACKING, None, (Mode(np.nan, np.nan),), None)])


@pytest.mark.parametrize(('lower', 'upper', 'words'), [
    (19.991, 20.017, '20.004 kg, 95 %: 19.991 to 20.017 kg'), (12.0, 31.0, '20 kg, 95 %: 12 to 31 kg'),
    (0.0, 755.9, '20 kg, 95 %: 0 to 756 kg')])
def test_an_interval_keeps_the_digits_that_tell_its_ends_apart(lower, upper, words):
    held = Payload(20.004, 0.006, lower, upper, 1.0, Status.TRACKING)
    _, (ax,) = plots.figure([2.0])
    plots.payload(ax, [Estimate(k, Status.TRACKING, None, (), held) for k in range(3)], 0)
    assert [text.get_text() for text in ax.texts] == [words]


def test_every_status_has_a_colour_and_a_pattern_of_its_own():
    looks = [screen.STATUS_LOOKS[status] for status in Status]
    assert len({hatch for _, hatch in looks}) == len(looks)


def test_the_torques_drawn_are_the_efforts_in_the_joint_states():
    names = ('joint1', 'joint2', 'link1_bend', 'link2_bend')
    records = [JointRecord(k * 1_000_000, names, np.full(4, 0.1), np.zeros(4), np.array([k, -k, 0.0, 0.0]))
               for k in range(50)]
    made = plots.run(IdentifierParameters(), sampling.collect(IdentifierParameters(), records), (), ())
    (drawn, labels, title, unit), *_ = plots.signal_groups(made)
    assert (labels, title, unit) == (['joint1', 'joint2'], 'torque', 'N m')
    assert drawn.tolist() == [[k, -k] for k in range(50)]
