"""Live and replayed, the same messages give the same bits of payload, model and status."""

from __future__ import annotations

import itertools
from contextlib import closing

import numpy as np
import pytest
from estimates import bits, one_a_stamp
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flexmanip_ros import pipeline
from flexmanip_ros.numerics.background import Threads
from flexmanip_ros.parameters import ExcitationParameters, IdentifierParameters, PlantParameters, configure
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, EventKind, JointBlock, JointRecord

Item = JointRecord | CaptureEvent
MS = 1_000_000
COUNT = 340
CONFIG = configure(IdentifierParameters, {'publish_rate': 40.0, 'rewind_time': 0.1})


def _recording() -> list[JointRecord]:
    plant = configure(PlantParameters, {'payload_mass': 20.0, 'snr_db': 40.0})
    torque = excitation.sequence(ExcitationParameters(), COUNT)
    made = simulator.simulate(plant, torque, (CaptureEvent(200 * MS, EventKind.CAPTURE),), 0)
    return [item for item in simulator.records(made, ()) if isinstance(item, JointRecord)]


RECORDS = _recording()
FAULTS = ('lost', 'twice', 'swap', 'nan', 'short')
faults = st.lists(st.tuples(st.integers(1, COUNT - 1), st.sampled_from(FAULTS)), max_size=6)
announced = st.lists(
    st.tuples(st.integers(0, COUNT), st.integers(-50, 500), st.sampled_from(EventKind)), max_size=3)


def _arrivals(bad: list[tuple[int, str]], events: list[tuple[int, int, EventKind]]) -> list[Item]:
    items: list[list[Item]] = [[record] for record in RECORDS]
    for k, fault in bad:
        record = RECORDS[k]
        if fault == 'lost':
            items[k] = []
        elif fault == 'twice':
            items[k] = [record, record]
        elif fault == 'swap':
            items[k - 1], items[k] = items[k], items[k - 1]
        elif fault == 'nan':
            items[k] = [record._replace(position=np.full(4, np.nan))]
        else:
            items[k] = [record._replace(velocity=np.empty(0))]
    for at, stamp_ms, kind in events:
        items.insert(min(at, len(items)), [CaptureEvent(stamp_ms * MS, kind)])
    return [item for group in items for item in group]


@settings(max_examples=6, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(faults, announced)
def test_message_by_message_is_the_replay_bit_for_bit(bad: list[tuple[int, str]],
                                                      events: list[tuple[int, int, EventKind]]) -> None:
    items = _arrivals(bad, events)
    state, live = pipeline.init(), []
    for item in items:
        state, ready = pipeline.step(CONFIG, state, item)
        live.extend(ready)
    live = one_a_stamp(live)
    replayed, last = [], pipeline.init()
    for now, estimate in pipeline.replay(CONFIG, items):
        last = now
        if estimate is not None:
            replayed.append(estimate)
    assert [bits(e) for e in live] == [bits(e) for e in replayed]
    assert live[-1].payload is not None
    assert last.counters == state.counters
    assert bits(pipeline.current(state)) == bits(pipeline.current(last))


def _in_blocks(items: list[Item], size: int) -> list[Item | JointBlock]:
    """Return the same messages with consecutive records of one layout in blocks."""
    out: list[Item | JointBlock] = []
    run: list[JointRecord] = []

    def shape(record: JointRecord) -> tuple[object, ...]:
        return record.names, record.position.size, record.velocity.size, record.effort.size

    for item in [*items, None]:
        if run and (not isinstance(item, JointRecord) or shape(item) != shape(run[0]) or len(run) == size):
            out.append(JointBlock(run[0].names, np.array([r.stamp_ns for r in run]),
                                  *(np.array([getattr(r, name) for r in run])
                                    for name in ('position', 'velocity', 'effort'))))
            run = []
        if isinstance(item, JointRecord):
            run.append(item)
        elif item is not None:
            out.append(item)
    return out


@settings(max_examples=8, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(faults, announced, st.sampled_from([2, 37, 1000]), st.sampled_from([0, 2]))
def test_blocks_of_messages_give_the_bits_of_single_messages(
        bad: list[tuple[int, str]], events: list[tuple[int, int, EventKind]], size: int, delay: int) -> None:
    items = _arrivals(bad, events)
    config = configure(IdentifierParameters, {'publish_rate': 40.0, 'rewind_time': 0.1, 'arm.effort_delay': delay})
    single = list(pipeline.replay(config, items))
    blocks = list(pipeline.replay(config, _in_blocks(items, size)))
    assert [bits(e) for _, e in single] == [bits(e) for _, e in blocks]
    *_, ended = pipeline.absorb(config, _in_blocks(items, size))  # no estimate is made on the way
    for last in (blocks[-1][0], ended):
        assert single[-1][0].counters == last.counters
        assert bits(pipeline.current(single[-1][0])) == bits(pipeline.current(last))


@pytest.mark.parametrize('again', [False, True], ids=['once', 'and anew: its stamps jump back'])
def test_what_is_read_while_the_payload_takes_its_rows_changes_no_bit(
        monkeypatch: pytest.MonkeyPatch, again: bool) -> None:
    items = _arrivals([(90, 'lost'), (301, 'nan')], [(260, 250, EventKind.CAPTURE)])
    if again:
        later = [item._replace(stamp_ns=item.stamp_ns + 100_000 * MS) for item in items]
        items = [*later, *RECORDS[:150]]
    *_, (last, _) = pipeline.replay(CONFIG, items)
    monkeypatch.setattr(pipeline, 'ABSORB_GROUP', 60)
    monkeypatch.setattr(pipeline, 'REPLAY_GROUP', 50)
    with closing(Threads()) as beside:
        *_, ended = pipeline.absorb(CONFIG, _in_blocks(items, 25), beside)
    assert last.counters == ended.counters
    assert last.counters.resets == again
    assert bits(pipeline.current(last)) == bits(pipeline.current(ended))


def test_an_interrupted_replay_gives_the_bits_of_the_messages_whose_rows_were_taken(
        monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline, 'ABSORB_GROUP', 100)
    *_, state = itertools.islice(pipeline.absorb(CONFIG, _in_blocks(RECORDS, 50)), 7)
    early = pipeline.taken(state)
    count = early.counters.accepted
    assert 0 < count < state.counters.accepted
    *_, ended = pipeline.absorb(CONFIG, RECORDS[:count])
    assert bits(pipeline.current(early)) == bits(pipeline.current(ended))


def test_every_fit_after_a_capture_gives_the_same_bits_live_and_replayed() -> None:
    plant = configure(PlantParameters, {'payload_mass': 20.0, 'snr_db': 40.0})
    event = CaptureEvent(600 * MS, EventKind.CAPTURE)
    made = simulator.simulate(plant, excitation.sequence(ExcitationParameters(), 1800), (event,), 0)
    items = list(simulator.records(made, (event,)))
    for method in ('structured', 'block'):
        config = configure(IdentifierParameters, {'payload_method': method})
        state, live = pipeline.init(), []
        for item in items:
            state, ready = pipeline.step(config, state, item)
            live += ready
        live = one_a_stamp(live)
        ballast = [np.empty(3 * k + 1) for k in range(50)]  # other places in memory, the same numbers
        replayed = list(pipeline.run(config, items))
        assert [bits(one) for one in live] == [bits(one) for one in replayed], len(ballast)
        assert sum(one.model_is_new for one in live) > 30
        with closing(Threads()) as beside:  # payload, models and fits on threads of their own
            threaded = [one for _, one in pipeline.replay(config, _in_blocks(items, 1000), beside) if one is not None]
            *_, ended = pipeline.absorb(config, _in_blocks(items, 1000), beside)
        assert [bits(one) for one in live] == [bits(one) for one in threaded]
        assert bits(pipeline.current(ended)) == bits(pipeline.current(state))
