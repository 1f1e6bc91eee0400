"""Models read on a thread while samples go on: the same bits, and none of a time that was forgotten."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import replace

import pytest
from test_worker import CAPTURE, said

from flexmanip_ros import estimator, pipeline, schedule
from flexmanip_ros.estimator import MOST_OWED
from flexmanip_ros.parameters import ExcitationParameters, IdentifierParameters, PlantParameters
from flexmanip_ros.ros.model_reader import ModelReader
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, Estimate, JointRecord

CONFIG = IdentifierParameters()


def recording(count: int = 900) -> list[JointRecord | CaptureEvent]:
    efforts = excitation.sequence(ExcitationParameters(), count)
    made = simulator.simulate(PlantParameters(), efforts, (CAPTURE,))
    return list(simulator.records(made, (CAPTURE,)))


def live(items: Iterable[JointRecord | CaptureEvent], pause: float,
         config: IdentifierParameters = CONFIG) -> list[Estimate]:
    """Go on with the samples while models are read, as the node does; some come slowly, some at once."""
    reader, state, estimates, asked = ModelReader(), pipeline.init(), [], 0
    try:
        for k, item in enumerate(items):
            if k % 3 == 0:
                time.sleep(pause)
            if reader.ready(state, item):
                state, estimate = reader.take(state)
                estimates.append(estimate)
            state, due = pipeline.take(config, state, item)
            assert state.timeline is None or len(state.timeline.core.owed) <= MOST_OWED + pipeline.GROUP
            for one in due:
                if reader.ready(state, None):
                    state, estimate = reader.take(state)
                    estimates.append(estimate)
                if schedule.is_read_anew(state, one):
                    reader.ask(state, one, lambda: None)
                    asked += 1
                else:
                    state, estimate = pipeline.read(state, one)
                    estimates.append(estimate)
        if reader.ready(state, None):
            estimates.append(reader.take(state)[1])
    finally:
        reader.close()
    assert asked > 20
    return estimates


@pytest.mark.parametrize('pause', [0.0, 0.0005])
def test_models_read_meanwhile_are_those_of_the_replay_bit_for_bit(pause: float) -> None:
    items = recording()
    late = [*items[:540], CaptureEvent(CAPTURE.stamp_ns + 50_000_000, CAPTURE.kind), *items[540:]]
    for run in (items, late):
        replayed = list(pipeline.run(CONFIG, run))
        assert [said(estimate) for estimate in live(run, pause)] == [said(one) for one in replayed]


@pytest.mark.parametrize('rate', [1000.0, 500.0])
def test_an_estimate_with_every_sample_is_that_of_the_replay_and_nothing_piles_up(rate: float) -> None:
    config = replace(CONFIG, publish_rate=rate)
    items = recording(700)
    replayed = pipeline.run(config, items)
    assert [said(one) for one in live(items, 0.0, config)] == [said(one) for one in replayed]


def test_a_model_of_before_a_reset_is_not_taken_for_one_of_after_it() -> None:
    items = recording(600)
    state = pipeline.init()
    for item in items[:500]:
        state, due = pipeline.take(CONFIG, state, item)
        for one in due:
            state, _ = pipeline.read(state, one)
    again = [item._replace(stamp_ns=item.stamp_ns - 10**10) for item in items
             if isinstance(item, JointRecord)]
    after = state
    for item in again[:50]:
        after, _ = pipeline.take(CONFIG, after, item)
    assert state.reading is not None
    assert pipeline.adopted(after, state) is after
    assert pipeline.adopted(pipeline.init(), state) == pipeline.init()


def test_a_parameter_changed_meanwhile_counts_from_then_on_whoever_reads_the_models() -> None:
    config = replace(CONFIG, forgetting='constant')
    factors = []
    for elsewhere in (False, True):
        state = pipeline.init()
        for item in recording()[:702]:
            state, due = pipeline.take(config, state, item)
            for one in due:
                read, _ = pipeline.read(state, one)
                state = pipeline.adopted(state, read) if elsewhere else read
        state = pipeline.reconfigure(replace(config, forgetting_factor=(0.9, 0.9, 0.9)), state)
        assert state.timeline is not None
        assert state.config is not None
        factors.append(estimator.settle(state.config, state.timeline.core).rpbsid.memory[0])
    assert factors[0].tobytes() == factors[1].tobytes()


def test_a_model_that_could_not_be_read_is_told_once() -> None:
    state = pipeline.init()
    for item in recording(60):
        state, due = pipeline.take(CONFIG, state, item)
        if due:
            break
    reader = ModelReader()
    reader.ask(pipeline.init(), due[0], lambda: None)
    with pytest.raises(AssertionError):
        reader.take(state)
    assert not reader.ready(state, None)
    reader.close()
