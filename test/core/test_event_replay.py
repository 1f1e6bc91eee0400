"""Stamps rule: whatever the order of arrival, the estimates that follow are those of the order of stamps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from estimates import bits, one_a_stamp
from hypothesis import given, settings
from hypothesis import strategies as st

from flexmanip_ros import pipeline
from flexmanip_ros.event_replay import distinct
from flexmanip_ros.parameters import ExcitationParameters, IdentifierParameters, PlantParameters, configure
from flexmanip_ros.simulation.excitation import sequence
from flexmanip_ros.simulation.simulator import simulate
from flexmanip_ros.types import CaptureEvent, Estimate, EventKind, JointRecord, Status

NAMES = ('joint1', 'joint2', 'link1_bend', 'link2_bend')
MS = 1_000_000
CONFIG = configure(IdentifierParameters, {'payload_method': 'none', 'rewind_time': 0.05})


def records(count: int, missing: Sequence[int] = ()) -> list[JointRecord]:
    rng = np.random.default_rng(3)
    out = []
    for k in range(count):
        values = rng.standard_normal((3, 4)) + np.sin(0.2 * k)
        if k not in missing:
            out.append(JointRecord(k * MS, NAMES, *values))
    return out


def with_event(items: list[JointRecord], stamp_ms: float, arrival: int,
               kind: EventKind = EventKind.CAPTURE) -> list[JointRecord | CaptureEvent]:
    event = CaptureEvent(int(stamp_ms * MS), kind)
    return [*items[:arrival], event, *items[arrival:]]


def step_through(items: Sequence[JointRecord | CaptureEvent], config: IdentifierParameters = CONFIG
                 ) -> tuple[pipeline.State, list[Estimate]]:
    state, out = pipeline.init(), []
    for item in items:
        state, ready = pipeline.step(config, state, item)
        out.extend(ready)
    return state, one_a_stamp(out)


def same(a: Sequence[Estimate], b: Sequence[Estimate]) -> bool:
    return [bits(e) for e in a] == [bits(e) for e in b]


@pytest.mark.parametrize('missing', [(), (100, 101, 230)])
def test_message_by_message_and_replayed_in_blocks_are_the_same_bits(missing: Sequence[int]) -> None:
    items = with_event(records(400, missing), 180.0, 150)
    _, live = step_through(items)
    replayed = list(pipeline.run(CONFIG, items))
    assert same(live, replayed)
    assert len(live) >= 19
    assert live[-1].model is not None


@settings(max_examples=8, deadline=None)
@given(stamp=st.integers(0, 240), delay=st.integers(-60, 45), offset=st.sampled_from([0.0, 0.3]))
def test_from_its_arrival_on_an_event_counts_at_its_stamp_however_late(stamp: int, delay: int, offset: float
                                                                        ) -> None:
    items = records(320)
    arrival = min(max(stamp + delay, 0), 300)
    _, on_time = step_through(with_event(items, stamp + offset, 0))
    state, shifted = step_through(with_event(items, stamp + offset, arrival))
    after = (arrival + 1) * MS
    assert same([e for e in on_time if e.stamp_ns > after], [e for e in shifted if e.stamp_ns > after])
    assert state.stamp_of(EventKind.CAPTURE) == int((stamp + offset) * MS)


def test_two_events_out_of_order_give_the_result_of_their_order() -> None:
    items = records(320)
    capture, release = CaptureEvent(200 * MS, EventKind.CAPTURE), CaptureEvent(215 * MS, EventKind.RELEASE)
    _, ordered = step_through([capture, release, *items])
    _, swapped = step_through([*items[:230], release, *items[230:240], capture, *items[240:]])
    assert same(ordered[-3:], swapped[-3:])


def test_an_event_announced_early_changes_nothing_before_its_stamp() -> None:
    items, first = records(560), CaptureEvent(150 * MS, EventKind.CAPTURE)
    second = CaptureEvent(500 * MS, EventKind.CAPTURE)
    _, on_time = step_through([*items[:150], first, *items[150:500], second, *items[500:]])
    _, early = step_through([*items[:150], first, *items[150:165], second, *items[165:]])
    assert same(on_time, early)


def test_of_two_events_of_one_stamp_the_release_comes_first() -> None:
    items, at = records(320), 200 * MS
    capture, release = CaptureEvent(at, EventKind.CAPTURE), CaptureEvent(at, EventKind.RELEASE)
    config = configure(IdentifierParameters, {'rewind_time': 0.05})
    (_, one), (_, two) = (
        step_through([*items[:150], *pair, *items[150:]], config)
        for pair in ((capture, release), (release, capture)))
    assert same(one, two)


def test_an_event_too_old_to_go_back_for_is_applied_at_once_and_counted() -> None:
    state, _ = step_through(with_event(records(400), 100.0, 350))
    assert state.payload is not None
    assert state.payload.late_events == 1
    assert state.payload.rewinds == 0
    (taken,) = [event for _, event in state.payload.applied]
    assert taken.std_s == pytest.approx((taken.stamp_ns - 100 * MS) * 1e-9)  # it is applied so much too late


def test_an_event_too_old_to_go_back_for_does_not_undo_a_later_one() -> None:
    items = with_event(records(700), 200.0, 200)
    release = CaptureEvent(100 * MS, EventKind.RELEASE)
    state, found = step_through([*items[:600], release, *items[600:]])
    _, without = step_through(items)
    assert state.payload is not None
    assert state.payload.late_events == 1
    assert state.payload.stamp_of(EventKind.RELEASE) is None
    assert [one.payload for one in found] == [one.payload for one in without]


def test_an_event_announced_twice_counts_once() -> None:
    items = with_event(with_event(records(300), 200.0, 150), 200.0, 150)
    state, twice = step_through(items)
    _, once = step_through(with_event(records(300), 200.0, 150))
    assert state.payload is not None
    assert state.payload.repeated_events == 1
    assert same(once, twice)


def test_a_capture_soon_after_a_release_is_no_repetition_of_the_one_before_it() -> None:
    events = [CaptureEvent(stamp_ms * MS, kind) for stamp_ms, kind in (
        (200, EventKind.CAPTURE), (210, EventKind.RELEASE), (220, EventKind.CAPTURE))]
    state, _ = step_through([*events, *records(300)])
    assert state.payload is not None
    assert state.payload.repeated_events == 0
    assert state.payload.estimator.since_ns == state.stamp_of(EventKind.CAPTURE) == 220 * MS


@settings(max_examples=20, deadline=None)
@given(events=st.lists(st.tuples(st.integers(10, 60), st.sampled_from(EventKind)), max_size=6))
def test_a_replay_and_its_report_take_the_same_events_for_one(events: list[tuple[int, EventKind]]) -> None:
    announced = [CaptureEvent(stamp * MS, kind) for stamp, kind in events]
    config = replace(CONFIG, event_merge_time=0.02)
    counted, merged = distinct(config, announced)
    state, _ = step_through([*records(5), *announced], config)
    assert state.payload is not None
    assert len(merged) == state.payload.repeated_events
    assert set(counted) == set(state.payload.pending)


def test_memory_stays_constant() -> None:
    state, _ = step_through(records(4500))
    assert state.payload is not None
    assert state.log.end - state.log.start <= 3000  # a fit sees 2048 rows, and the rewind 50
    assert len(state.payload.snapshots) <= 4


def test_rows_that_wait_for_an_estimate_are_taken_by_the_end_with_the_bits_of_a_replay() -> None:
    items = records(206)
    state, some = step_through(items)
    assert state.identifier is not None
    assert state.log.end - state.identifier.cursor == 5  # row 200 was due at 50 Hz
    assert state.counters.accepted == 206
    state, rest = pipeline.finish(CONFIG, state)
    assert state.identifier is not None
    assert state.identifier.cursor == state.log.end
    assert same([*some, *rest], list(pipeline.run(CONFIG, items)))


@pytest.fixture(scope='module')
def undisturbed() -> set[int]:
    """The stamps at which there is a new model where no parameter changes."""
    return {estimate.stamp_ns for estimate in step_through(records(400))[1] if estimate.model_is_new}


@pytest.mark.parametrize('changed', range(204, 221, 4))  # a model is asked for at row 200
def test_a_change_of_parameters_loses_no_model_that_is_under_way(undisturbed: set[int], changed: int) -> None:
    state, found = pipeline.init(), []
    for k, item in enumerate(records(400)):
        if k == changed:
            state = pipeline.reconfigure(CONFIG, state)
        state, ready = pipeline.step(CONFIG, state, item)
        found.extend(ready)
    assert undisturbed
    assert undisturbed <= {estimate.stamp_ns for estimate in found if estimate.model_is_new}


def test_a_replay_drops_the_rows_that_nobody_reads_again() -> None:
    kept = [state.log.end - state.log.start for state, _ in pipeline.replay(CONFIG, records(5500))]
    assert max(kept) <= 4000  # a fit sees 2048 rows, and some wait for the next estimate


def test_a_looped_recording_gives_the_same_estimates_again() -> None:
    config = configure(IdentifierParameters, {'payload_method': 'none', 'max_time_jump': 0.1})
    items = with_event(records(300), 200.0, 150)
    _, twice = step_through([*items, *items], config)
    _, once = step_through(items, config)
    assert same(once, twice[len(once):])


def test_a_capture_from_before_the_first_sample_counts_all_along_however_late_it_is_heard() -> None:
    """An identifier that starts on a loaded arm may find the latched event after many samples."""
    plant = PlantParameters(seed=2)
    capture = CaptureEvent(100 * MS, EventKind.CAPTURE)
    run = simulate(plant, sequence(ExcitationParameters(), 1500), [capture])
    items = [JointRecord(int(run.stamp_ns[k]), run.names, run.position[k], run.velocity[k],
                         np.append(run.effort[k], [0.0, 0.0])) for k in range(200, 1500)]
    config = IdentifierParameters()
    late: list[JointRecord | CaptureEvent] = [*items[:600], capture, *items[600:]]
    state, live = step_through(late, config)
    payload = live[-1].payload
    assert state.payload is not None
    assert payload is not None
    assert state.payload.late_events == 1
    assert live[-1].status is Status.TRACKING
    assert payload.lower < plant.payload_mass < payload.upper
    assert same(live, list(pipeline.run(config, late)))


@pytest.mark.parametrize('position', [[np.nan] * 4, [0.0] * 3], ids=['not finite', 'of another size'])
@pytest.mark.parametrize('stamp_ns', [0, 10**15])
def test_a_first_message_that_cannot_be_used_sets_no_clock(position: list[float], stamp_ns: int) -> None:
    good = [record._replace(stamp_ns=record.stamp_ns + 10**12) for record in records(300)]
    unusable = good[0]._replace(stamp_ns=stamp_ns, position=np.array(position))
    assert same(step_through([unusable, *good])[1], step_through(good)[1])


@pytest.mark.parametrize('wrong', [1, 5])
def test_stamps_of_another_clock_before_the_first_far_jump_are_left_out(wrong: int) -> None:
    """A driver may publish its first messages before it has the time."""
    good = [record._replace(stamp_ns=record.stamp_ns + 10**12) for record in records(300)]
    bad = [record._replace(stamp_ns=record.stamp_ns - 10**12) for record in good[:wrong]]
    items = with_event([*bad, *good[wrong:]], 900e3, 250)  # latched, heard late
    state, live = step_through(items)
    assert state.first_ns == good[wrong].stamp_ns
    assert state.counters.resets == 1
    assert same(live, step_through(with_event(good[wrong:], 900e3, 250 - wrong))[1])


@pytest.mark.parametrize('is_announced', [False, True], ids=['taken', 'announced'])
def test_a_change_of_the_sample_time_loses_no_event(is_announced: bool) -> None:
    every = records(900)
    items = with_event([*every[:300], *every[300::2]], 600.0 if is_announced else 100.0, 100)
    state, live = step_through(items)
    assert state.counters.resets == 1
    assert state.payload is not None
    assert state.payload.estimator.since_ns == state.stamp_of(EventKind.CAPTURE) == items[100].stamp_ns
    assert same(live, list(pipeline.run(CONFIG, items)))


def test_a_wrong_stamp_before_the_sample_time_is_known_loses_no_event() -> None:
    items = with_event(records(300), 200.0, 0)
    items[4] = items[4]._replace(stamp_ns=10**13)
    state, _ = step_through(items)
    assert state.counters.resets == 1
    assert state.payload is not None
    assert state.payload.estimator.since_ns == 200 * MS
