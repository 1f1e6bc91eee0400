"""Scenarios: the same seed gives the same run, and faults fall as asked."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexmanip_ros.errors import ParameterError
from flexmanip_ros.studies import trial
from flexmanip_ros.studies.scenario import Faults, scenario
from flexmanip_ros.studies.trial import inject
from flexmanip_ros.types import CaptureEvent, EventKind, JointRecord

VARIED = {
    'duration': 0.2, 'capture_time': 0.1, 'window': [0.15, 0.2], 'identifier': {'payload_method': 'none'},
    'vary': {'plant.payload_mass': {'uniform': [12.0, 100.0]}, 'capture_time': {'uniform': [0.05, 0.15]},
             'arm.tip_mass': {'normal': [10.0, 0.1]},
             'plant.initial_angles': {'choice': [[0.0, 0.5], [1.0, 0.2]]}}}


def _records(count: int) -> list[JointRecord]:
    return [JointRecord(k * 1_000_000, ('a',), np.array([float(k)]), np.empty(0), np.empty(0))
            for k in range(count)]


def _positions(items: list[object]) -> list[float]:
    return [float(item.position[0]) for item in items if isinstance(item, JointRecord)]


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31))
def test_a_seed_makes_one_run_within_its_distributions(seed):
    made = scenario(VARIED)
    run, again = made.configuration(seed, 'default'), made.configuration(seed, 'default')
    assert run == again
    assert 12.0 <= run.plant.payload_mass <= 100.0
    assert 50_000_000 <= run.events[0].stamp_ns <= 150_000_000
    assert run.plant.initial_angles in ((0.0, 0.5), (1.0, 0.2))
    assert run.plant.arm.tip_mass == run.identifier.arm.tip_mass != 10.0
    assert run.plant.seed == seed


def test_the_torques_are_those_of_the_plant_s_arm_with_one_link_as_well():
    arm = {'link_length': [0.41], 'linear_density': [0.5], 'bending_stiffness': [5.0]}
    run = scenario({'plant': {'arm': arm, 'initial_angles': [1.0]}, 'identifier': {'arm': arm},
                    'excitation': {'amplitude': [0.3]}}).configuration(0, 'default')
    assert run.excitation.arm == run.plant.arm
    assert run.excitation.amplitude == (0.3,)


def test_what_is_varied_does_not_depend_on_what_else_is():
    alone = scenario({'vary': {'plant.payload_mass': {'uniform': [0.0, 1.0]}}}).configuration(3, 'default')
    other = scenario({'vary': {'plant.payload_mass': {'uniform': [0.0, 1.0]},
                               'capture_time': {'uniform': [2.0, 4.0]}}}).configuration(3, 'default')
    assert alone.plant.payload_mass == other.plant.payload_mass


def test_every_estimator_sees_the_same_samples_and_a_broken_one_stops_nobody():
    made = scenario({**VARIED, 'estimators': {
        'good': {}, 'bad': {'inputs': ['nobody/effort']}, 'twin': {}}})
    rows = {row['estimator']: row for row in trial.trial(pickle.loads(pickle.dumps(made)), 1)}
    assert 'nobody/effort' in rows['bad']['error']
    assert rows['good']['error'] == ''
    assert rows['good']['frequencies_1'] == rows['twin']['frequencies_1']


def test_faults_fall_as_often_as_asked():
    items = inject(_records(4000), Faults(drop=0.1, duplicate=0.05, nan=0.02), np.random.default_rng(1))
    values = _positions(items)
    finite = [value for value in values if np.isfinite(value)]
    assert len(set(finite)) + sum(np.isnan(values)) > 3500
    assert 3500 < len(set(finite)) < 3650
    assert len(finite) - len(set(finite)) == pytest.approx(0.05 * 3600, rel=0.2)
    assert sum(np.isnan(values)) == pytest.approx(0.02 * 3700, rel=0.5)


def test_without_faults_nothing_changes_and_the_event_comes_before_its_sample():
    records = _records(10)
    event = CaptureEvent(5_000_000, EventKind.CAPTURE)
    items = inject([*records, event], Faults(), np.random.default_rng(1))
    assert items == [*records[:5], event, *records[5:]]


def test_a_late_event_a_gap_and_swapped_neighbours():
    records = _records(100)
    event = CaptureEvent(50_000_000, EventKind.CAPTURE)
    items = inject([*records, event], Faults(event_delay=0.01), np.random.default_rng(1))
    assert items[items.index(event) - 1].stamp_ns == 60_000_000
    items = inject(records, Faults(gap=(0.02, 0.03)), np.random.default_rng(1))
    assert _positions(items) == [*range(20), *range(30, 100)]
    items = inject(records, Faults(swap=0.2), np.random.default_rng(1))
    assert sorted(_positions(items)) == list(range(100)) != _positions(items)


@pytest.mark.parametrize('tree', [
    None, 3, {'duration': 'long'}, {'window': 4}, {'vary': 3},
    {'vary': {'plant.nothing': {'uniform': [0, 1]}}},
    {'vary': {'plant.seed': {'uniform': [0]}}}, {'faults': {'loss': 0.1}}, {'plant': {'arm': 3}},
    {'identifier': {'order': -1}}, {'estimators': {'a': 3}}])
def test_a_scenario_that_makes_no_sense_is_rejected(tree):
    with pytest.raises(ParameterError):
        scenario(tree)
