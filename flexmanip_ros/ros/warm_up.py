"""Run the identifier once on made-up signals, so that nothing is compiled while the first samples come."""

from __future__ import annotations

import math

import numpy as np

from flexmanip_ros import pipeline
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.types import CaptureEvent, EventKind, JointRecord

SAMPLES = 120
STEP_NS = 1_000_000


def warm_up(config: IdentifierParameters) -> None:
    """Step the pipeline through samples and an event of the configured signals.

    Raises ParameterError when the configuration cannot work at all, before any message comes.
    """
    names = tuple(dict.fromkeys(
        signal.rpartition('/')[0] for signal in (*config.inputs, *config.outputs, *config.angles)))
    state = pipeline.init()
    for k in range(SAMPLES):
        wave = np.array([math.sin(0.1 * (k + 1) * (i + 1)) for i in range(len(names))]) * 1e-2
        record = JointRecord(k * STEP_NS, names, wave, wave * 3.0, wave * 100.0)
        state, _ = pipeline.step(config, state, record)
        if k == SAMPLES // 2:
            state, _ = pipeline.step(config, state, CaptureEvent((k - 1) * STEP_NS, EventKind.CAPTURE))
