from __future__ import annotations

import math
from dataclasses import replace

import pytest

from flexmanip_ros.control import handover
from flexmanip_ros.control.handover import PayloadEstimate
from flexmanip_ros.errors import ParameterError
from flexmanip_ros.parameters import AdapterParameters, leaves

CONFIG = AdapterParameters(target_node='driver', settle_time=0.5, min_period=1.0)
GOOD = PayloadEstimate(20.0, 0.1, 19.8, 20.2, 1.0)


def told_times(estimates: list[tuple[float, PayloadEstimate]]) -> list[float]:
    state, times = handover.HandoverState(), []
    for now, found in estimates:
        state, due = handover.step(CONFIG, state, found, now)
        if due:
            times.append(now)
            state = state._replace(sent=found, sent_at=now)  # the driver took it
    return times


def test_a_payload_is_told_once_after_it_was_trusted_for_a_while() -> None:
    assert told_times([(0.1 * k, GOOD) for k in range(50)]) == [0.5]


def test_doubt_in_between_starts_the_wait_again() -> None:
    doubt = GOOD._replace(std=5.0)
    assert told_times([(0.1 * k, doubt if k == 4 else GOOD) for k in range(20)]) == pytest.approx([1.0])


def test_another_payload_is_told_again_but_not_too_soon() -> None:
    heavier = GOOD._replace(mass=30.0)
    found = told_times([(0.1 * k, GOOD if k < 8 else heavier) for k in range(40)])
    assert found == pytest.approx([0.5, 1.5])


def test_another_place_of_its_centre_of_mass_or_another_inertia_is_told_again() -> None:
    for changed in (GOOD._replace(com=(0.03, 0.0)), GOOD._replace(inertia=0.05)):
        assert told_times([(0.1 * k, GOOD if k < 8 else changed) for k in range(40)]) == pytest.approx([0.5, 1.5])
    assert told_times([(0.1 * k, GOOD if k < 8 else GOOD._replace(com=(0.01, 0.0))) for k in range(40)]) == [0.5]


def test_another_mass_is_told_again_where_it_differs_by_min_change_and_by_max_std() -> None:
    words = next(leaf.words for leaf in leaves(AdapterParameters) if leaf.name == 'min_change')
    assert 'by more than this fraction of it, and by more than max_std' in words
    unsure = replace(CONFIG, max_std=2.0)
    for mass, config, told in ((20.9, CONFIG, False), (21.1, CONFIG, True), (21.1, unsure, False)):
        assert handover.changed(config, GOOD, GOOD._replace(mass=mass)) is told


@pytest.mark.parametrize('bad', [
    {'mass': math.nan}, {'std': math.inf}, {'mass': -1.0}, {'mass': 1000.0}, {'consistency': 50.0},
    {'consistency': math.nan}, {'std': 3.0},
    {'mass': 0.0, 'inertia': 1e6},
])
def test_what_cannot_be_trusted_is_never_told(bad: dict[str, float]) -> None:
    assert told_times([(0.1 * k, GOOD._replace(**bad)) for k in range(50)]) == []


def arrived(times: list[float]) -> handover.Arrivals:
    arrivals = handover.Arrivals()
    for time in times:
        arrivals = arrivals.with_latest(time)
    return arrivals


def test_estimates_have_ceased_after_five_seconds_and_two_of_their_periods() -> None:
    assert not arrived([]).have_ceased(1e9)
    assert math.isnan(arrived([]).age(1e9))
    for times, limit in (([0.0], 5.0), ([0.0, 0.02, 0.04], 5.0), ([0.0, 4.0, 8.0], 8.0), ([0.0, 10.0], 20.0),
                         ([0.0, 10.0, 20.0], 20.0), ([0.0, 10.0, 11.0], 20.0), ([0.0, 60.0, 60.1, 60.2], 5.0)):
        arrivals = arrived(times)
        assert not arrivals.have_ceased(times[-1] + 0.99 * limit)
        assert arrivals.have_ceased(times[-1] + 1.01 * limit)
        assert arrivals.age(times[-1] + 3.0) == pytest.approx(3.0)


def test_somebody_must_be_told() -> None:
    with pytest.raises(ParameterError, match="'service' and 'target_node' are both empty"):
        AdapterParameters(service='')
    with pytest.raises(ParameterError, match='PACKAGE/srv/TYPE'):
        AdapterParameters(service='set_payload', service_type='os.system')
