from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from flexmanip_ros.parameters import IdentifierParameters, configure
from flexmanip_ros.samples import sampling
from flexmanip_ros.types import JointBlock, JointRecord


class Seen(NamedTuple):
    """A sample that was measured, and whether a gap is before it."""

    stamp_ns: int
    u: np.ndarray
    y: np.ndarray
    angles: np.ndarray
    rates: np.ndarray
    gap: bool


NAMES = ('joint1', 'joint2', 'link1_bend', 'link2_bend')
DT = 1_000_000


def record(k: float, names: tuple[str, ...] = NAMES, **arrays: object) -> JointRecord:
    size = len(names)
    fields = {field: np.arange(size) + k * 0.5 + offset for offset, field in
              ((0, 'position'), (10, 'velocity'), (20, 'effort'))}
    fields.update({name: np.asarray(value, dtype=float) for name, value in arrays.items()})
    return JointRecord(int(1_000_000_000 + k * DT), names, **fields)


def drive(records: list[JointRecord], config: IdentifierParameters | None = None
          ) -> tuple[sampling.Clock, list[Seen], int]:
    config = config or IdentifierParameters()
    clock, log, resets = sampling.Clock(), sampling.EMPTY, 0
    for item in records:
        clock, log, reset = sampling.push(config, clock, log, item)
        resets += reset
    clock, log, reset = sampling.flush(config, clock, log)
    rows = log.rows(0, log.end)
    samples = [Seen(int(rows.stamp_ns[k]), rows.u[k], rows.y[k], rows.angles[k], rows.rates[k],
                    bool(rows.gap[k]))
               for k in np.flatnonzero(rows.missing == 0)]
    return clock, samples, resets + reset


def test_every_regular_message_becomes_one_sample_and_the_mean_interval_is_the_sample_time() -> None:
    state, samples, _ = drive([record(k) for k in range(100)])
    assert len(samples) == 100
    assert state.dt == 1e-3
    assert not any(s.gap for s in samples)
    assert state.counters.accepted == 100 == state.counters.received


def test_joints_are_matched_by_name_in_any_order_and_extra_joints_are_ignored() -> None:
    shuffled = ('link2_bend', 'gripper', 'joint2', 'joint1', 'link1_bend')
    plain, mixed = [], []
    for k in range(30):
        first = record(k)
        order = [NAMES.index(n) if n in NAMES else 0 for n in shuffled]
        plain.append(first)
        mixed.append(JointRecord(first.stamp_ns, shuffled, first.position[order], first.velocity[order],
                                 first.effort[order]))
    for a, b in zip(drive(plain)[1], drive(mixed)[1], strict=True):
        assert (a.u == b.u).all()
        assert (a.y == b.y).all()
        assert (a.angles == b.angles).all()


def test_one_stamp_from_far_ahead_costs_one_message() -> None:
    wrong = record(50)._replace(stamp_ns=record(50).stamp_ns + 10**11)
    for after in ([], [record(49)]):  # the next may be one that was there before
        state, samples, resets = drive([*map(record, range(50)), wrong, *after, *map(record, range(51, 100))])
        assert (resets, state.counters.resets, len(samples)) == (0, 0, 99)
        assert (state.counters.late_stamp, state.counters.repeated_stamp) == (1, len(after))
        assert state.dt == 1e-3


def test_a_clock_that_was_set_ahead_is_followed_after_one_sample() -> None:
    state, samples, resets = drive([*map(record, range(50)), *(record(k + 10**6) for k in range(50))])
    assert (resets, state.counters.accepted, state.counters.gaps, len(samples)) == (0, 100, 1, 100)
    assert [sample.stamp_ns for sample in samples] == sorted(sample.stamp_ns for sample in samples)


def test_a_bag_without_velocities_uses_displacements_only() -> None:
    state, samples, _ = drive([record(k, velocity=[]) for k in range(30)])
    assert state.channels.outputs == ('link1_bend/position', 'link2_bend/position')
    assert samples[0].y.shape == (2,)
    assert np.isnan(samples[0].rates).all()


def test_a_velocity_that_is_nan_beside_a_position_is_not_among_the_default_outputs() -> None:
    """``joint_state_broadcaster`` fills the fields that a joint does not have with NaN."""
    state, samples, _ = drive([record(k, velocity=[1.0, 2.0, np.nan, 0.5]) for k in range(30)])
    assert state.channels.outputs == ('link1_bend/position', 'link2_bend/position', 'link2_bend/velocity')
    assert (len(samples), state.counters.dropped) == (30, 0)


def test_a_message_without_any_finite_value_takes_no_output_away() -> None:
    empty = record(0, position=[np.nan] * 4, velocity=[np.nan] * 4)
    state, samples, _ = drive([empty, *(record(k) for k in range(1, 30))])
    assert state.channels.outputs == IdentifierParameters.outputs
    assert (len(samples), state.counters.not_finite) == (29, 1)


@pytest.mark.parametrize(('given', 'count'), [
    ({}, 2), ({'angles': ()}, 0), ({'inputs': ('joint2/effort',)}, 0),
    ({'inputs': ('joint2/effort',), 'angles': ('joint2/position', 'joint1/position')}, 2)])
def test_without_a_payload_angles_are_read_where_they_are_named_or_belong_to_the_default_inputs(
        given: dict[str, tuple[str, ...]], count: int) -> None:
    _, samples, _ = drive([record(k) for k in range(30)],
                          replace(IdentifierParameters(), payload_method='none', **given))
    assert samples[0].angles.shape == (count,)


def test_rates_of_the_joints_come_along_and_a_message_without_them_is_taken_too() -> None:
    """A rate of zero is unknown as well: drivers that measure no rates report it."""
    odd = {25: [np.nan, 1.0, 0.0, 0.0], 26: [2.0, 0.0, 0.0, 0.0], 27: [2.0, np.inf, 0.0, 0.0]}
    _, samples, _ = drive([record(k, velocity=odd.get(k, [2.0, 3.0, 0.0, 0.0])) for k in range(30)])
    found = [sample.rates for sample in samples[24:29]]
    np.testing.assert_equal(found, [[2.0, 3.0], [np.nan, 1.0], [2.0, np.nan], [2.0, np.nan], [2.0, 3.0]])


@pytest.mark.parametrize('given', [
    {'payload.use_joint_rates': False}, {'arm.angle_convention': 'chord'}, {'payload_method': 'none'}])
def test_rates_are_not_read_where_they_are_not_those_of_the_joints_or_unused(given: dict[str, object]) -> None:
    _, samples, _ = drive([record(k) for k in range(30)], configure(IdentifierParameters, given))
    assert samples[0].rates.shape == (0,)


def test_outputs_set_by_the_user_never_shrink() -> None:
    config = configure(IdentifierParameters, {'outputs': ['link1_bend/velocity', 'link1_bend/position'],
                                              'order': 2})
    state, samples, _ = drive([record(k, velocity=[]) for k in range(30)], config)
    assert samples == []
    assert state.rejection is not None
    assert 'link1_bend/velocity' in state.rejection.problem


@pytest.mark.parametrize(('bad', 'counter'), [
    (record(40, position=[0.0, np.nan, 0.0, 0.0]), 'not_finite'),
    (record(40, position=[0.0, 1.0]), 'unequal_sizes'),
    (record(40, names=('a', 'b', 'c', 'd')), 'missing_signal'),
    (record(39), 'repeated_stamp'),
    (record(35), 'late_stamp'),
    (record(40, effort=[]), 'missing_signal'),
])
def test_a_bad_message_is_dropped_and_counted_and_moves_no_clock(bad: JointRecord, counter: str) -> None:
    good = [record(k) for k in range(60)]
    state, samples, resets = drive([*good[:40], bad, *good[40:]])
    assert getattr(state.counters, counter) == 1 == state.counters.dropped
    assert resets == 0
    assert len(samples) == 60
    assert not any(s.gap for s in samples)


def test_nan_matters_only_in_configured_fields() -> None:
    fine = [record(k, velocity=[np.nan, np.nan, 0.0, 0.0]) for k in range(30)]
    assert drive(fine)[0].counters.dropped == 0


@pytest.mark.parametrize(('bad', 'problem', 'remedy'), [
    ({'velocity': [1.0, 1.0, np.nan, 1.0]}, "'link1_bend/velocity' is NaN",
     'leave it out of outputs, or check the publisher of the joint states'),
    ({'position': [1.0, 1.0, 1.0, -np.inf]}, "'link2_bend/position' is infinite",
     'check the publisher of the joint states'),
    ({'position': [np.nan, 1.0, 1.0, 1.0]}, "'joint1/position' is NaN", 'check the publisher of the joint states'),
    ({'effort': [1.0, np.inf, 1.0, 1.0]}, "'joint2/effort' is infinite", 'check the publisher of the joint states'),
])
def test_a_signal_that_is_not_finite_is_named_alone_and_in_a_block(
        bad: dict[str, object], problem: str, remedy: str) -> None:
    records = [record(k) for k in range(60)]
    records[40] = record(40, **bad)
    alone = drive(records)[0]
    block = JointBlock(NAMES, np.array([one.stamp_ns for one in records]),
                       *(np.stack([getattr(one, name) for one in records])
                         for name in ('position', 'velocity', 'effort')))
    together = sampling.push_whole(IdentifierParameters(), sampling.Clock(), sampling.EMPTY, block).clock
    for clock in (alone, together):
        assert clock.rejection is not None
        assert (clock.rejection.problem, clock.rejection.remedy) == (problem, remedy)


@pytest.mark.parametrize('missing', [5, 45])
def test_beyond_max_gap_a_missing_message_marks_a_gap_before_and_after_the_sample_time_is_known(missing: int) -> None:
    none = configure(IdentifierParameters, {'max_gap': 0.0})
    state, samples, _ = drive([record(k) for k in range(80) if k != missing], none)
    assert [s.gap for s in samples].index(True) == missing
    assert sum(s.gap for s in samples) == 1 == state.counters.gaps
    assert state.dt == 1e-3


def test_a_jump_back_of_more_than_the_limit_starts_a_new_clock() -> None:
    config = configure(IdentifierParameters, {'max_time_jump': 0.02})
    state, samples, resets = drive([record(k) for k in range(60)] + [record(k) for k in range(50)], config)
    assert resets == 1
    assert len(samples) == 50
    assert state.counters.resets == 1


def test_a_lasting_change_of_rate_is_learned_anew() -> None:
    slower = [record(59 + 2 * k) for k in range(1, 90)]
    state, samples, resets = drive([record(k) for k in range(60)] + slower)
    assert resets == 1
    assert state.dt == pytest.approx(2e-3)
    assert not any(s.gap for s in samples)


@pytest.mark.parametrize('delay', [1, 3])
def test_effort_delay_gives_each_sample_the_torque_reported_later(delay: int) -> None:
    config = configure(IdentifierParameters, {'arm.effort_delay': delay})
    records = [record(k) for k in range(60)]
    _, samples, _ = drive(records, config)
    assert len(samples) == 60 - delay
    for k, sample in enumerate(samples):
        assert sample.stamp_ns == records[k].stamp_ns
        assert (sample.u == records[k + delay].effort[:2]).all()


def test_effort_delay_never_takes_a_torque_from_across_a_gap() -> None:
    config = configure(IdentifierParameters, {'arm.effort_delay': 1, 'max_gap': 0.003})
    records = [record(k) for k in range(80) if not 40 <= k < 45]
    _, samples, _ = drive(records, config)
    stamps = [s.stamp_ns for s in samples]
    assert records[39].stamp_ns not in stamps
    assert samples[stamps.index(records[40].stamp_ns)].gap


def test_jittered_stamps_are_no_gaps_and_average_to_the_sample_time() -> None:
    rng = np.random.default_rng(1)
    state, samples, _ = drive([record(k + 0.2 * rng.uniform(-1, 1)) for k in range(2000)])
    assert not any(s.gap for s in samples)
    assert state.dt == pytest.approx(1e-3, rel=1e-3)


def test_a_recording_shorter_than_the_learning_is_not_lost() -> None:
    _, samples, _ = drive([record(k) for k in range(7)])
    assert len(samples) == 7


def test_stamps_of_zero_are_explained() -> None:
    state, _, _ = drive([record(k)._replace(stamp_ns=0) for k in range(10)])
    assert state.rejection is not None
    assert 'stamps do not advance' in state.rejection.problem


@pytest.mark.parametrize('first', [0, 1, 30, 99])
def test_messages_without_a_stamp_between_others_cost_nothing_but_themselves(first: int) -> None:
    """Each of them was a jump back and the next message one ahead: all was forgotten at every second message."""
    start_ns = 1_700_000_000 * 10**9
    mixed = [record(k)._replace(stamp_ns=stamp_ns) for k in range(100)
             for stamp_ns in (start_ns + k * DT, 0)[:1 + (k >= first)]]
    state, samples, resets = drive(mixed)
    assert (len(samples), resets, state.counters.late_stamp) == (100, 0, 100 - first)
    assert state.rejection is not None
    assert state.rejection.problem.startswith('a header stamp is 0')


def test_a_simulated_clock_may_start_at_zero_and_start_again() -> None:
    run = [record(k)._replace(stamp_ns=k * DT) for k in range(2000)]
    for items, restarts in ((run, 0), ([*run, *run], 1)):
        _, samples, resets = drive(items)
        assert (samples[0].stamp_ns, len(samples), resets) == (0, 2000, restarts)


def test_a_single_sample_before_a_pause_teaches_no_sample_time() -> None:
    config = IdentifierParameters()
    first, *later = [record(k) for k in (0, *range(1000, 1100))]
    clock, log, _ = sampling.flush(config, *sampling.push(config, sampling.Clock(), sampling.EMPTY, first)[:2])
    for item in later:
        clock, log, _ = sampling.push(config, clock, log, item)
    assert clock.dt == 1e-3
    assert clock.counters.received == 101


def test_the_default_signals_of_one_link_shrink_to_those_that_come() -> None:
    config = configure(IdentifierParameters, {
        'arm.link_length': [1.0], 'inputs': ['joint1/effort'], 'payload_method': 'none', 'order': 2})
    clock, samples, _ = drive([record(k, ('joint1', 'link1_bend'), velocity=[]) for k in range(30)], config)
    assert clock.channels.outputs == ('link1_bend/position',)
    assert len(samples) == 30


def test_blocks_drop_repeated_and_late_stamps_whatever_gap_factor_is() -> None:
    config = IdentifierParameters(payload_method='none', gap_factor=2.5)
    stamps = 1_000_000_000 + 1_000_000 * np.arange(200)
    stamps[100], stamps[150] = stamps[99], stamps[149] - 300_000
    values = np.random.default_rng(0).standard_normal((3, 200, 4))
    block = JointBlock(('joint1', 'joint2', 'link1_bend', 'link2_bend'), stamps, *values)
    clock, log = sampling.Clock(), sampling.EMPTY
    for k in range(200):
        clock, log, _ = sampling.push(config, clock, log, block.record(k))
    at_once, rows, _ = sampling.push_whole(config, sampling.Clock(), sampling.EMPTY, block)
    assert at_once.counters == clock.counters
    assert at_once.counters.accepted == 198
    assert (rows.rows(0, rows.end).stamp_ns == log.rows(0, log.end).stamp_ns).all()


@pytest.mark.parametrize(('names', 'size'), [(('a', 'b', 'c', 'd'), 4), (NAMES, 3)])
def test_a_block_whose_layout_cannot_be_used_is_counted_as_its_single_messages(names: tuple[str, ...], size: int
                                                                               ) -> None:
    block = JointBlock(names, 1_000_000 * np.arange(50), *np.zeros((3, 50, size)))
    start = drive([record(k) for k in range(30)])[0]
    clock = start
    for k in range(50):
        clock, _, _ = sampling.push(IdentifierParameters(), clock, sampling.EMPTY, block.record(k))
    sampled, taken = sampling.push_block(IdentifierParameters(), start, sampling.EMPTY, block)
    assert taken == 50
    assert (sampled.clock.counters, sampled.clock.rejection) == (clock.counters, clock.rejection)
