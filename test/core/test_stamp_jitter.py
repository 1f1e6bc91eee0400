from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recording import payloads_of

from flexmanip_ros.parameters import ArmParameters, ExcitationParameters, IdentifierParameters, PlantParameters
from flexmanip_ros.samples import sampling
from flexmanip_ros.samples.sample_log import Rows
from flexmanip_ros.samples.stamp_jitter import LEAST_GAIN, LOSS, Jitter
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, EventKind, JointBlock, Status

CONFIG = IdentifierParameters(payload_method='none')
NAMES = ('joint1', 'joint2', 'link1_bend', 'link2_bend')
START, T = 1_000_000_000, 1_000_000
COUNT = 3000


def _block(stamps: np.ndarray, sampled: np.ndarray) -> JointBlock:
    """Messages with these stamps [ns] of a motion that was sampled at instants [ns] beyond START."""
    t, rng = (sampled - START)[:, None] * 1e-9, np.random.default_rng(5)
    omega, phase = 2 * np.pi * np.array([1.1, 2.3, 5.6, 12.0]), np.arange(4)
    position = np.sin(omega * t + phase) + 1e-3 * rng.standard_normal((len(t), 4))
    velocity = omega * np.cos(omega * t + phase) + 1e-2 * rng.standard_normal((len(t), 4))
    return JointBlock(NAMES, stamps, position, velocity, np.sign(np.sin(2 * np.pi * t * np.ones(4))))


def _rows(block: JointBlock, config: IdentifierParameters = CONFIG) -> tuple[sampling.Clock, Rows]:
    clock, log, _ = sampling.push_whole(config, sampling.Clock(), sampling.EMPTY, block)
    clock, log, _ = sampling.flush(config, clock, log)
    return clock, log.rows(0, log.end)


def _jittered(std_ms: float, seed: int = 1, count: int = COUNT) -> tuple[np.ndarray, np.ndarray]:
    """Regular instants [ns], and stamps that are off by white noise."""
    regular = START + T * np.arange(count)
    noise = np.random.default_rng(seed).normal(0.0, std_ms * 1e6, count)
    return regular, np.maximum.accumulate(regular + noise.astype(np.int64) + np.arange(count))


def _off_us(times: np.ndarray, truth: np.ndarray) -> float:
    """Deviation of the intervals between samples [us], once the clock has learned."""
    return float(np.std(np.diff(times)[1000:] - np.diff(truth)[1000:])) * 1e-3


@pytest.mark.parametrize('std_ms', [0.05, 0.1, 0.15])
def test_jitter_of_the_stamps_alone_is_taken_from_the_instants_of_the_samples(std_ms: float) -> None:
    regular, stamps = _jittered(std_ms)
    clock, rows = _rows(_block(stamps, regular))
    assert clock.counters.gaps == 0
    assert not rows.missing.any()
    assert (rows.stamp_ns == stamps).all()
    assert _off_us(rows.time_ns, regular) < 0.25 * _off_us(stamps, regular)


def test_the_clock_is_a_line_fitted_to_all_stamps_at_first() -> None:
    count, off, fitted = 400, [], []
    for seed in range(40):
        regular, stamps = _jittered(0.1, seed, count)
        clock = sampling.Clock(last_ns=int(stamps[0]), interval_count=1, interval_sum_ns=T)
        for interval in np.diff(stamps).tolist():
            clock = clock.after(interval)
        off.append(stamps[-1] - clock.jitter.late_ns - regular[-1])
        k = np.arange(count)
        fitted.append(np.polyval(np.polyfit(k, stamps - regular, 1), count - 1))
    assert np.sqrt(np.mean(np.square(off))) < 1.1 * np.sqrt(np.mean(np.square(fitted)))
    assert np.mean(np.abs(np.array(off) - fitted)) < 0.2 * np.mean(np.abs(fitted))


def test_where_samples_jitter_with_their_stamps_the_stamps_are_the_instants() -> None:
    regular, stamps = _jittered(0.1)
    _, rows = _rows(_block(stamps, stamps))
    assert _off_us(rows.time_ns, stamps) < 0.25 * _off_us(regular, stamps)


def test_the_stamps_of_a_loop_that_sleeps_for_a_sample_time_are_the_instants() -> None:
    intervals = np.random.default_rng(2).normal(T, 0.1 * T, COUNT).astype(np.int64)
    stamps = START + np.cumsum(intervals)
    clock, rows = _rows(_block(stamps, stamps))
    assert clock.jitter.gain > 0.8
    assert _off_us(rows.time_ns, stamps) < 10.0


def test_without_jitter_the_instants_are_the_stamps_to_the_bit() -> None:
    for stamps in (START + T * np.arange(COUNT), START + np.arange(COUNT) * 1_000_000_000 // 300):
        _, rows = _rows(_block(stamps, stamps))
        assert (rows.time_ns == stamps).all()


def test_a_lost_message_is_seen_through_the_jitter() -> None:
    regular, stamps = _jittered(0.15)
    lost = np.arange(500, COUNT - 50, 97)
    left = np.delete(np.arange(COUNT), lost)
    _, rows = _rows(_block(stamps[left], regular[left]))
    assert abs(int((rows.missing > 0).sum()) - len(lost)) <= 0.05 * len(lost)
    assert np.median(np.abs(rows.time_ns[-1000:] - regular[-1000:])) < 0.25 * 0.15e6


def test_a_loss_is_assumed_where_both_explanations_are_as_likely() -> None:
    jitter = Jitter(square=2.0 * (0.2 * T) ** 2, product=-(0.2 * T) ** 2, intervals=10_000,
                    variance=(LEAST_GAIN, 0.0, 0.0))
    most, s = jitter.most_ns(T), jitter.std_ns
    assert s == pytest.approx(0.2 * T, rel=0.02)
    assert -0.5 * (most / s) ** 2 == pytest.approx(np.log(LOSS) - 0.5 * ((most - T) / s) ** 2)


@settings(max_examples=15, deadline=None)
@given(std_ms=st.sampled_from([0.0, 0.1, 0.3]), loss=st.sampled_from([0.0, 0.02]), seed=st.integers(0, 1000),
       delay=st.integers(0, 2), pieces=st.lists(st.integers(1, 90), min_size=1, max_size=8))
def test_blocks_of_any_size_give_the_instants_of_single_messages_to_the_bit(
    std_ms: float, loss: float, seed: int, delay: int, pieces: list[int],
) -> None:
    config = replace(CONFIG, arm=ArmParameters(effort_delay=delay))
    regular, stamps = _jittered(std_ms, seed, 400)
    came = np.random.default_rng(seed).random(400) >= loss
    whole = _block(stamps[came], regular[came])
    clock, log = sampling.Clock(), sampling.EMPTY
    for k in range(len(whole.stamp_ns)):
        clock, log, _ = sampling.push(config, clock, log, whole.record(k))
    grouped, rows, k = sampling.Clock(), sampling.EMPTY, 0
    while k < len(whole.stamp_ns):
        for size in pieces:
            part = JointBlock(whole.names, whole.stamp_ns[k:k + size], whole.position[k:k + size],
                              whole.velocity[k:k + size], whole.effort[k:k + size])
            if len(part.stamp_ns):
                grouped, rows, _ = sampling.push_whole(config, grouped, rows, part)
            k += size
    assert grouped.jitter == clock.jitter
    assert grouped.counters == clock.counters
    one, many = log.rows(0, log.end), rows.rows(0, rows.end)
    assert (one.time_ns == many.time_ns).all()
    assert (one.stamp_ns == many.stamp_ns).all()
    assert (one.gap == many.gap).all()


def test_a_payload_is_tracked_at_stamps_that_jitter_by_a_tenth_of_the_sample_time() -> None:
    plant = PlantParameters(payload_mass=20.0, seed=3)
    event = CaptureEvent(2_000_000_000, EventKind.CAPTURE)
    run = simulator.simulate(plant, excitation.sequence(ExcitationParameters(), 5000), (event,))
    stamps = run.stamp_ns + np.round(np.random.default_rng(4).normal(0.0, 1e5, 5000)).astype(np.int64)
    effort = np.hstack([run.effort, np.zeros_like(run.effort)])
    config = IdentifierParameters()
    _, rows = _rows(JointBlock(run.names, stamps, run.position, run.velocity, effort), config)
    late = payloads_of(config, rows, (event,), 3000)
    assert np.mean([payload.status is Status.TRACKING for payload in late]) > 0.95
    assert max(abs(payload.mass - 20.0) / payload.std for payload in late) < 3.5
    assert late[-1].mass == pytest.approx(20.0, rel=0.001)
