"""The signals of a run as columns, for pictures, tables and scores."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.samples import sampling
from flexmanip_ros.types import Array, JointRecord, Sample


@dataclass(frozen=True, eq=False)
class Signals:
    """Samples as arrays.

    stamp_ns: (N,); u: (N, r); y: (N, m); angles: (N, 2) or (N, 0); gap: (N,) a sample is missing before it.
    """

    stamp_ns: np.ndarray[tuple[int], np.dtype[np.int64]]
    u: Array
    y: Array
    angles: Array
    gap: np.ndarray[tuple[int], np.dtype[np.bool_]]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    @property
    def time(self) -> Array:
        """Seconds from the first sample: (N,)."""
        first = self.stamp_ns[0] if self.stamp_ns.size else 0
        return np.asarray((self.stamp_ns - first) * 1e-9, dtype=np.float64)


class History:
    """Collects the samples of a run the way the pipeline makes them, 8 bytes a value."""

    def __init__(self, config: IdentifierParameters) -> None:
        self._config = config
        self._clock = sampling.init()
        self._stamps = array('q')
        self._gaps = bytearray()
        self._values = array('d')
        self._width = (0, 0, 0)

    def add(self, record: JointRecord) -> None:
        """Take one message."""
        self._clock, sampled = sampling.step(self._config, self._clock, record)
        self._keep(sampled.samples, reset=sampled.reset)

    def _keep(self, samples: Sequence[Sample], *, reset: bool) -> None:
        for sample in samples:
            self._width = (sample.u.size, sample.y.size, sample.angles.size)
            self._stamps.append(sample.stamp_ns)
            self._gaps.append(sample.gap or reset)
            self._values.extend(sample.u)
            self._values.extend(sample.y)
            self._values.extend(sample.angles)
            reset = False

    def signals(self) -> Signals:
        """Return everything so far."""
        self._clock, held = sampling.flush(self._config, self._clock)
        self._keep(held.samples, reset=False)
        r, m, a = self._width
        table = np.array(self._values, dtype=np.float64).reshape(len(self._stamps), r + m + a)
        return Signals(
            np.array(self._stamps, dtype=np.int64), table[:, :r].copy(), table[:, r:r + m].copy(),
            table[:, r + m:].copy(), np.array(self._gaps, dtype=np.bool_),
            self._config.inputs, self._clock.outputs or self._config.outputs)
