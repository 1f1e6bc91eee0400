"""Run the identifier once on made-up signals, so that nothing is compiled while the first samples come."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from flexmanip_ros import pipeline
from flexmanip_ros.errors import SignalError
from flexmanip_ros.identification import batch_fit, recursive_fit
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.types import CaptureEvent, EventKind, JointRecord

EVENT = 40
"""Samples before the event; enough to learn the sample time."""
SAMPLES = EVENT + 3 * batch_fit.BLOCK + 2 * recursive_fit.CHUNK
"""Until the fits after it have begun and a block has followed."""
STEP_NS = 1_000_000


def warm_up(config: IdentifierParameters) -> None:
    """Step the pipeline through samples and an event of the configured signals.

    Raises ParameterError when the configuration cannot work at all, before any message comes.
    """
    try:
        for _ in pipeline.run(config, _signals(config)):
            pass
    except SignalError:  # every field is there: a signal that even these messages cannot carry
        return


def _signals(config: IdentifierParameters) -> Iterator[JointRecord | CaptureEvent]:
    """Yield joints that swing at two frequencies when torque, at random, acts on them."""
    names = tuple(dict.fromkeys(
        signal.rpartition('/')[0] for signal in (*config.inputs, *config.outputs, *config.angles)))
    rng = np.random.default_rng(0)
    swing = np.exp(1j * np.array([0.1, 0.2]) - 0.01)
    shape = rng.standard_normal((2, len(names)))
    state = np.zeros(2, dtype=complex)
    for k in range(SAMPLES):
        if k == EVENT:
            yield CaptureEvent((k - 1) * STEP_NS, EventKind.CAPTURE)
        effort = rng.standard_normal(len(names))
        noise = 1e-3 * rng.standard_normal((2, len(names)))
        yield JointRecord(
            k * STEP_NS, names, 0.01 * (state.imag @ shape + noise[0]), state.real @ shape + noise[1], effort)
        state = swing * state + shape @ effort / math.sqrt(len(names))
