from __future__ import annotations

import time

from flexmanip_ros import pipeline
from flexmanip_ros.parameters import ExcitationParameters, IdentifierParameters, PlantParameters
from flexmanip_ros.ros.worker import Worker
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, Estimate, EventKind

COUNT = 900
CAPTURE = CaptureEvent(400_000_000, EventKind.CAPTURE)


def said(estimate: Estimate) -> tuple[str, bytes]:
    """Everything an estimate says, to the bit."""
    model = b'' if estimate.model is None else estimate.model.A.tobytes() + estimate.model.K.tobytes()
    return repr((estimate.stamp_ns, estimate.status, estimate.modes, estimate.payload)), model


def test_fits_on_a_thread_beside_the_samples_give_the_bits_of_the_replay():
    config = IdentifierParameters()
    made = simulator.simulate(
        PlantParameters(), excitation.sequence(ExcitationParameters(), COUNT), (CAPTURE,), 0)
    items = list(simulator.records(made, (CAPTURE,)))
    worker, state, live = Worker(), pipeline.init(), []
    helped = 0
    try:
        for item in items:
            state, ready = pipeline.step(config, state, item)
            live += ready
            before = pipeline.job(state)
            if before is not None and before[1] <= 120:  # a while after it was asked for: let it be ready
                limit = time.monotonic() + 20.0
                while pipeline.job(state) is not None and time.monotonic() < limit:
                    state = worker.attend(state, published=True)
                helped += pipeline.job(state) is None
            state = worker.attend(state, published=True)
    finally:
        worker.close()
    assert helped >= 2, 'the thread did fits before the event and after it'
    replayed = list(pipeline.run(config, items))
    assert [said(estimate) for estimate in live] == [said(estimate) for estimate in replayed]
