"""Mode auto of the capture trigger: joint states in, the events that they reveal out."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from flexmanip_ros.parameters import IdentifierParameters, TriggerParameters
from flexmanip_ros.payload import capture_detection
from flexmanip_ros.samples import sampling
from flexmanip_ros.samples.signals import Rejection
from flexmanip_ros.types import CaptureEvent, JointRecord

REHEARSAL = 1500
"""Made-up samples that bring every compiled function of the detector into memory."""


class Watcher:
    """Samples on the clock of their stamps, watched for a capture or a release."""

    def __init__(self, config: TriggerParameters) -> None:
        self._config = self._settled = config
        self._sampling = IdentifierParameters(
            inputs=config.inputs, outputs=config.outputs, angles=config.angles, arm=config.arm,
            payload=config.payload)
        self._clock, self._log, self._cursor = sampling.Clock(), sampling.EMPTY, 0
        self._state: capture_detection.DetectionState | None = None

    def take(self, record: JointRecord) -> tuple[CaptureEvent, ...]:
        """Take one message; return the events found with it, each dated at its onset."""
        self._clock, self._log, reset = sampling.push(self._sampling, self._clock, self._log, record)
        if self._clock.outputs is None:
            return ()
        if self._state is None or reset:
            self._settled = replace(self._config, outputs=self._clock.outputs)
            self._state, self._cursor = capture_detection.init(self._settled), 0
        rows = self._log.rows(self._cursor, self._log.end)
        self._cursor = self._log.end
        self._state, events = capture_detection.advance(self._settled, self._state, rows)
        self._log = self._log.from_row(capture_detection.first_needed(self._state))
        return events

    @property
    def counters(self) -> sampling.Counters:
        """What became of the messages."""
        return self._clock.counters

    @property
    def rejection(self) -> Rejection | None:
        """Why the latest unusable message could not be used."""
        return self._clock.rejection

    @property
    def statistic(self) -> tuple[float, float]:
        """The latest statistic and its threshold."""
        return (0.0, math.inf) if self._state is None else capture_detection.statistic(self._state)


def rehearse(config: TriggerParameters) -> None:
    """Run the detector once, so that nothing is compiled while samples come."""
    names = tuple(dict.fromkeys(
        signal.rpartition('/')[0] for signal in (*config.inputs, *config.outputs, *config.angles)))
    watcher = Watcher(config)
    for k in range(REHEARSAL):
        wave = np.array([math.sin(0.05 * k * (i + 1)) for i in range(len(names))]) * 1e-3
        watcher.take(JointRecord(k * 1_000_000, names, wave, wave * 0.0, wave * 1e3))
