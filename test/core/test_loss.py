"""Messages that never came: rows without a measurement, and estimates as good as without loss."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy

import numpy as np
import pytest
from estimates import one_a_stamp
from recording import payloads_of

from flexmanip_ros import pipeline
from flexmanip_ros.arm.linearization import frequencies, vibration_model
from flexmanip_ros.parameters import ExcitationParameters, IdentifierParameters, PlantParameters, configure
from flexmanip_ros.payload import structured
from flexmanip_ros.samples import sampling
from flexmanip_ros.samples.sample_log import Rows
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, Estimate, EventKind, JointRecord, Payload, Status

COUNT, CAPTURE, BEGIN = 6000, 2000, 2900
PLANT = PlantParameters()


@pytest.fixture(scope='module')
def messages() -> list[JointRecord | CaptureEvent]:
    """6 s at 1 kHz, 20 kg caught at 2 s."""
    events = (CaptureEvent(CAPTURE * 1_000_000, EventKind.CAPTURE),)
    torque = excitation.sequence(ExcitationParameters(), COUNT)
    return list(simulator.records(simulator.simulate(PLANT, torque, events), events))


def surviving(messages: Sequence[JointRecord | CaptureEvent], lost: np.ndarray) -> list[JointRecord | CaptureEvent]:
    return [item for item in messages if isinstance(item, CaptureEvent) or not lost[round(item.stamp_ns * 1e-6)]]


def at_random(share: float) -> np.ndarray:
    return np.random.default_rng(3).random(COUNT) < share


def in_bursts(length: int) -> np.ndarray:
    """One burst a second, at any time in it."""
    lost = np.zeros(COUNT, dtype=bool)
    for first in range(0, COUNT, 1000):
        begin = first + int(np.random.default_rng(first).integers(50, 1000 - length))
        lost[begin:begin + length] = True
    return lost


def later(items: Sequence[JointRecord | CaptureEvent], method: str = 'structured') -> list[Estimate]:
    """Estimates from 1 s after the capture on."""
    return [one for one in pipeline.run(configure(IdentifierParameters, {'payload_method': method}), items)
            if one.stamp_ns >= (CAPTURE + 1000) * 1_000_000]


def begun(items: Sequence[JointRecord | CaptureEvent], samples: int = BEGIN) -> structured.StructuredState:
    """The estimator after so many samples, the capture among them."""
    config, rows = IdentifierParameters(), rows_of(items)
    state = structured.advance(config, structured.init(config), rows.between(0, CAPTURE))
    state = structured.event(config, state, CaptureEvent(CAPTURE * 1_000_000, EventKind.CAPTURE))
    return structured.advance(config, state, rows.between(CAPTURE, samples))


def held(state: structured.StructuredState, items: Sequence[JointRecord | CaptureEvent], samples: int = COUNT
         ) -> Payload:
    """What is known of the payload after so many samples, of which the estimator has taken BEGIN."""
    config, rows = IdentifierParameters(), rows_of(items)
    return structured.estimate(config, structured.advance(config, deepcopy(state), rows.between(BEGIN, samples)))


@pytest.fixture(scope='module')
def before(messages: list[JointRecord | CaptureEvent]) -> structured.StructuredState:
    """The estimator after BEGIN samples, where the tests that take it lose later ones alone."""
    return begun(messages)


def payloads_later(items: Sequence[JointRecord | CaptureEvent]) -> list[Payload]:
    """What is known of the payload from 1 s after the capture on, at the publishing rate, and no model."""
    capture = CaptureEvent(CAPTURE * 1_000_000, EventKind.CAPTURE)
    return payloads_of(IdentifierParameters(), rows_of(items), (capture,), CAPTURE + 1000)


@pytest.fixture(scope='module')
def whole(messages: list[JointRecord | CaptureEvent]) -> list[Payload]:
    return payloads_later(messages)


def length(lost: np.ndarray) -> int:
    """Most samples that are lost in a row."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], lost, [False]]).astype(int)))
    return int(np.max(edges[1::2] - edges[::2]))


def tracked(found: Sequence[Estimate]) -> float:
    return float(np.mean([one.model_status is Status.TRACKING for one in found]))


@pytest.mark.parametrize(('lost', 'wider'), [
    (at_random(0.05), 1.5), (in_bursts(30), 1.5), (in_bursts(100), 3.0)],
    ids=['5 %', '30 ms a second', '100 ms a second'])
def test_payload_and_modes_are_tracked_with_loss(
        messages: list[JointRecord | CaptureEvent], whole: list[Payload], lost: np.ndarray, wider: float) -> None:
    every_block_holds_one = length(lost) > 50  # of the model, which is not asked for then
    found = [] if every_block_holds_one else later(surviving(messages, lost))
    payloads = (payloads_later(surviving(messages, lost)) if every_block_holds_one else
                [one.payload for one in found if one.payload is not None])
    assert np.mean([one.status is Status.TRACKING for one in payloads]) >= 0.95
    assert max(abs(one.mass - 20.0) / one.std for one in payloads) < 4.0
    known = np.median([one.std for one in whole])
    assert np.median([one.std for one in payloads]) < wider * known  # a torque that changed in a burst is unknown
    if every_block_holds_one:
        return
    assert tracked(found[-50:]) >= 0.9
    true = frequencies(vibration_model(PLANT.arm, np.array(PLANT.initial_angles), 20.0)[0])[0]
    mode = found[-1].modes[0]
    assert abs(mode.frequency_hz - true) < max(3e-3 * true, 4.0 * mode.frequency_std_hz)


def rows_of(items: Sequence[JointRecord | CaptureEvent], **parameters: float) -> Rows:
    config = configure(IdentifierParameters, parameters)
    clock, log = sampling.Clock(), sampling.EMPTY
    for item in items:
        if isinstance(item, JointRecord):
            clock, log, _ = sampling.push(config, clock, log, item)
    return log.rows(0, log.end)


@pytest.mark.parametrize('first', [2999, 3000, 3001])
@pytest.mark.parametrize('count', [1, 3])
def test_messages_lost_at_a_step_of_the_torque_do_not_bias_the_payload(
        messages: list[JointRecord | CaptureEvent], before: structured.StructuredState, first: int, count: int
        ) -> None:
    """Both torques change at 3 s, a second after the capture; nobody knows at which sample."""
    lost = np.zeros(COUNT, dtype=bool)
    lost[first:first + count] = True
    found = held(before, surviving(messages, lost), 4000)
    assert found.status is Status.TRACKING
    assert found.mass == pytest.approx(20.0, rel=1.5e-3)
    assert abs(found.mass - 20.0) < 3.5 * found.std < 0.1


@pytest.mark.parametrize('first', [4455, 4480])
def test_a_burst_in_which_both_torques_change_does_not_widen_the_interval_for_good(
        messages: list[JointRecord | CaptureEvent], whole: list[Payload], before: structured.StructuredState,
        first: int) -> None:
    """45 ms, with both steps at 4.5 s, hide the motion: then it is learned again, with the payload as it was known."""
    lost = np.zeros(COUNT, dtype=bool)
    lost[first:first + 46] = True
    found, known = held(before, surviving(messages, lost)), whole[-1]
    assert found.status is Status.TRACKING
    assert abs(found.mass - 20.0) < 3.0 * found.std
    assert found.std < 2.0 * known.std


def test_a_gap_soon_after_a_capture_does_not_leave_a_poor_model_for_good(
        messages: list[JointRecord | CaptureEvent]) -> None:
    """Bursts hide steps of the torque 0.25 s after the start and 0.5 s after the capture, when fits are young."""
    lost = np.zeros(COUNT, dtype=bool)
    lost[237:291] = lost[2455:2540] = True
    found = later(surviving(messages, lost), 'none')
    assert tracked([one for one in found if one.stamp_ns >= (CAPTURE + 1600) * 1_000_000]) >= 0.95
    true = frequencies(vibration_model(PLANT.arm, np.array(PLANT.initial_angles), 20.0)[0])
    assert [mode.frequency_hz for mode in found[-1].modes] == pytest.approx(true[:2].tolist(), rel=0.03)  # it turns


def test_a_torque_without_steps_is_interpolated_over_lost_messages() -> None:
    events = (CaptureEvent(CAPTURE * 1_000_000, EventKind.CAPTURE),)
    torque = excitation.sequence(configure(ExcitationParameters, {'shape': 'multisine'}), COUNT)
    items = list(simulator.records(simulator.simulate(PLANT, torque, events), events))
    whole, found = (held(begun(some), some) for some in (items, surviving(items, at_random(0.05))))
    assert found.status is Status.TRACKING
    assert abs(found.mass - 20.0) < 3.0 * found.std
    assert found.std < 1.2 * whole.std


def test_a_message_that_never_came_is_a_row_that_is_marked(messages: list[JointRecord | CaptureEvent]) -> None:
    lost = np.zeros(COUNT, dtype=bool)
    lost[[100, 200, 201, 202]] = True
    every, rows = rows_of(messages), rows_of(surviving(messages, lost))
    assert len(rows) == len(every)
    assert (rows.stamp_ns == every.stamp_ns).all()
    assert np.flatnonzero(rows.missing).tolist() == [100, 200, 201, 202]
    assert rows.missing[199:204].tolist() == [0, 1, 2, 3, 0]
    assert not rows.gap.any()
    assert rows.y[201] == pytest.approx(0.5 * (every.y[199] + every.y[203]))


def test_beyond_max_gap_or_where_the_torque_changed_the_window_begins_anew(
        messages: list[JointRecord | CaptureEvent]) -> None:
    lost = np.zeros(COUNT, dtype=bool)
    lost[100:180] = lost[495:505] = True  # the torque changes at 0.5 s
    rows = rows_of(surviving(messages, lost), max_gap=0.05)
    first = int(np.flatnonzero(rows.gap)[0])
    assert rows.stamp_ns[first] - rows.stamp_ns[first - 1] == 81_000_000
    assert len(rows) == COUNT - 80
    assert np.flatnonzero(rows.gap).tolist() == [100, 505 - 80]
    assert np.count_nonzero(rows.missing) == 10


def test_blocks_give_the_bits_of_single_messages_with_loss(messages: list[JointRecord | CaptureEvent]) -> None:
    items = [item for item in surviving(messages, at_random(0.05) | in_bursts(30))  # from 1 s before the capture on
             if isinstance(item, CaptureEvent) or 1000 <= item.stamp_ns // 1_000_000 < 2500]
    alone = list(pipeline.run(IdentifierParameters(), items))
    for seconds in (1.9, 2.5):  # with a model and a payload on both sides of the capture
        last = [e for e in alone if e.stamp_ns < seconds * 1e9][-1]
        assert last.modes
        assert last.payload is not None
    state, found = pipeline.init(), []
    for item in items:
        state, some = pipeline.step(IdentifierParameters(), state, item, group=1)
        found += some
    state, some = pipeline.finish(IdentifierParameters(), state)
    one = one_a_stamp([*found, *some])
    assert [(e.stamp_ns, repr(e.payload), repr(e.modes)) for e in alone] == [
        (e.stamp_ns, repr(e.payload), repr(e.modes)) for e in one]


@pytest.mark.parametrize('delay', [0, 2])
def test_bursts_of_loss_under_a_torque_that_always_changes_give_the_same_bits_in_groups_of_any_size(
        delay: int) -> None:
    """How a torque changed before a gap is known by the last sample that came, wherever a group of rows ends."""
    config = configure(IdentifierParameters, {'model_rate': 0.1, 'arm.effort_delay': delay})
    torque = excitation.sequence(configure(ExcitationParameters, {'shape': 'multisine'}), 700)
    lost = np.zeros(COUNT, dtype=bool)
    for k, first in enumerate(range(25, 700, 25)):
        lost[first:first + 1 + k % 4] = True
    items = surviving(list(simulator.records(simulator.simulate(PLANT, torque, ()))), lost)
    found = []
    for group in (1, 8, 2000):
        state = pipeline.init()
        for item in items:
            state, _ = pipeline.step(config, state, item, group=group)
        state, _ = pipeline.finish(config, state)
        assert state.payload is not None
        assert state.payload.estimator.structured is not None
        memory = state.payload.estimator.structured.memory
        assert memory is not None
        found.append((memory.x.tobytes(), memory.S.tobytes()))
    assert found[0] == found[1] == found[2]
