"""Fits and models solved on threads beside the samples give the estimates of a replay to the bit."""

from __future__ import annotations

import gc
import threading
import time
import weakref
from collections.abc import Iterable
from dataclasses import replace
from functools import cache

import pytest
from estimates import one_a_stamp

from flexmanip_ros import pipeline
from flexmanip_ros.identification.recursive_fit import FitRequest
from flexmanip_ros.numerics.background import KEPT, THREADS, Deferred, Request, Threads
from flexmanip_ros.parameters import ExcitationParameters, IdentifierParameters, PlantParameters
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, Estimate, EventKind, JointRecord

CONFIG = IdentifierParameters()
CAPTURE = CaptureEvent(400_000_000, EventKind.CAPTURE)


class Sum:
    """A request that counts how often it was solved; it may be held up."""

    def __init__(self, *terms: int, gate: threading.Event | None = None) -> None:
        self.terms, self.gate, self.solved = terms, gate, 0

    def solve(self) -> int:
        if self.gate is not None:
            assert self.gate.wait(20.0)
        self.solved += 1
        return sum(self.terms)


class Recorded(Threads):
    """Notes what was asked for, and what had to be solved in front of a sample."""

    def __init__(self) -> None:
        super().__init__()
        self.asked: list[Request] = []

    def start(self, request: Request) -> None:
        self.asked.append(request)
        super().start(request)


@cache
def recording(count: int = 900, capture: CaptureEvent = CAPTURE) -> tuple[JointRecord | CaptureEvent, ...]:
    efforts = excitation.sequence(ExcitationParameters(), count)
    made = simulator.simulate(PlantParameters(), efforts, (capture,))
    return tuple(simulator.records(made, (capture,)))


@cache
def recordings() -> tuple[tuple[tuple[JointRecord | CaptureEvent, ...], list[tuple[str, bytes]]], ...]:
    """A recording, and one with another capture that comes late, each with what its replay says."""
    items = recording()
    late = *items[:540], CaptureEvent(CAPTURE.stamp_ns + 50_000_000, CAPTURE.kind), *items[540:]
    return tuple((run, [said(estimate) for estimate in pipeline.run(CONFIG, run)]) for run in (items, late))


def live(items: Iterable[JointRecord | CaptureEvent], pause: float,
         config: IdentifierParameters = CONFIG) -> list[Estimate]:
    """Go on with the samples while threads compute, as the node does; some samples come slowly, some at once."""
    background, state, estimates = Recorded(), pipeline.init(), []
    try:
        for k, item in enumerate(items):
            if k % 3 == 0:
                time.sleep(pause)
            state, found = pipeline.step(config, state, item, background)
            estimates += found
        state, found = pipeline.finish(config, state, background)
        estimates += found
    finally:
        background.close()
    assert len(background.asked) > 20
    assert any(isinstance(request, FitRequest) for request in background.asked)
    return one_a_stamp(estimates)


def said(estimate: Estimate) -> tuple[str, bytes]:
    """Everything an estimate says, to the bit."""
    model = b'' if estimate.model is None else estimate.model.A.tobytes() + estimate.model.K.tobytes()
    return repr((estimate.stamp_ns, estimate.status, estimate.modes, estimate.payload)), model


@pytest.mark.parametrize('pause', [0.0, 0.0005])
def test_estimates_beside_threads_are_those_of_the_replay_bit_for_bit(pause: float) -> None:
    for run, replayed in recordings():
        assert [said(estimate) for estimate in live(run, pause)] == replayed


def test_an_estimate_with_every_sample_is_that_of_the_replay() -> None:
    config = replace(CONFIG, publish_rate=1000.0)
    items = recording(340, CaptureEvent(300_000_000, EventKind.CAPTURE))  # the fit comes before it
    replayed = pipeline.run(config, items)
    assert [said(one) for one in live(items, 0.0, config)] == [said(one) for one in replayed]


def test_a_parameter_changed_meanwhile_counts_from_then_on_wherever_fits_are_solved() -> None:
    config = replace(CONFIG, forgetting='constant')
    factors = []
    for background in (Threads(), None):
        arguments = () if background is None else (background,)
        state = pipeline.init()
        for item in recording()[:702]:
            state, _ = pipeline.step(config, state, item, *arguments)
        state = pipeline.reconfigure(replace(config, forgetting_factor=(0.9, 0.9, 0.9)), state, *arguments)
        assert state.payload is not None
        factors.append(state.identifier.estimator.rpbsid.memory[0].tobytes())
        if background is not None:
            background.close()
    assert factors[0] == factors[1]


def test_a_result_is_solved_once_and_is_there_again_after_a_rewind() -> None:
    background, request = Threads(), Sum(1, 2)
    background.start(request)
    assert [background.result(request) for _ in range(3)] == [3, 3, 3]
    assert request.solved == 1
    background.close()


def test_a_request_that_no_thread_has_begun_is_solved_in_place() -> None:
    background, gate = Threads(), threading.Event()
    busy, waiting, unknown = [Sum(k, gate=gate) for k in range(4)], Sum(5), Sum(6)
    for request in (*busy, waiting):
        background.start(request)
    assert (background.result(waiting), background.result(unknown)) == (5, 6)
    gate.set()
    background.close()
    assert (waiting.solved, unknown.solved) == (1, 1)


def test_requests_whose_result_nobody_takes_do_not_pile_up() -> None:
    background = Threads()
    started = weakref.WeakSet[Sum]()
    for k in range(5 * KEPT):
        request = Sum(k)
        started.add(request)
        background.start(request)
    del request
    gc.collect()
    assert len(started) <= KEPT + THREADS  # the threads may hold one each
    background.close()
    gc.collect()
    assert not started


def test_an_awaited_result_is_kept_however_many_later_ones_were_taken() -> None:
    background, awaited = Threads(), Sum(1, 2)
    background.start(awaited)
    for k in range(5 * KEPT):
        background.start(later := Sum(k))
        assert background.result(later) == k
    assert (background.result(awaited), awaited.solved) == (3, 1)
    background.close()


def test_what_is_asked_for_after_the_end_is_solved_in_place() -> None:
    background, request = Threads(), Sum(1, 2)
    background.close()
    background.start(request)
    assert background.result(request) == 3


def test_deferred_requests_begin_when_told_and_at_the_latest_with_their_result() -> None:
    background, first, second, third = Deferred(), Sum(1), Sum(2), Sum(3)
    background.start(first)
    background.start(second)
    assert (first.solved, second.solved) == (0, 0)
    background.begin()
    background.start(third)
    assert [background.result(request) for request in (first, second, third)] == [1, 2, 3]
    assert [request.solved for request in (first, second, third)] == [1, 1, 1]
    background.close()
