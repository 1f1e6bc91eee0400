"""Store of all samples of a run: columns to which rows are only appended.

A ``SampleLog`` is a value: appending returns a new one and leaves the old one as it was. Both share one buffer, so
an append copies the new rows alone. Estimators keep row numbers, counted from the first sample of the run, and
read slices.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.types import Array, Sample

Kind = TypeVar('Kind', bound=np.generic)
SMALLEST = 1024
"""Number of rows of the first buffer: about one second at 1 kHz."""
MOST_FRICTIONS = 100
"""Number of latest events of which the friction is kept. A rewind goes back over fewer."""


class Width(NamedTuple):
    """Number of inputs r, outputs m, angles a and joint rates of a row."""

    inputs: int
    outputs: int
    angles: int
    rates: int = 0


class Friction(NamedTuple):
    """Coulomb friction F tanh(w / rate) of a joint with the measured rate w, which opposes an input."""

    input: int
    """Column of u."""
    joint: int
    """Column of the joints' rates."""
    torque: float
    """F [N m]."""
    rate: float
    """Rate [rad/s] at which 76 % of F act."""


class FrictionSince(NamedTuple):
    """Coulomb friction of each joint, in units of its input (L,) [N m], from a stamp on [ns]."""

    stamp_ns: int
    torques: tuple[float, ...]


@dataclass(eq=False, slots=True)
class _Buffer:
    """Memory shared by logs. Rows below ``filled`` belong to some log and are never written again.

    The exception is the inputs of waiting rows. They are written later, and no log shows such a row before.
    """

    first: int
    """Number of the row at index 0."""
    filled: int
    """Number of the row after the last one written."""
    stamp_ns: NDArray[np.int64]
    time_ns: NDArray[np.int64]
    values: Array
    gap: NDArray[np.bool_]
    missing: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class SampleLog:
    """Samples of the configured signals, one a row.

    start, end: numbers of the first row still kept, and of the row after the last one shown; waiting: number of rows
    from ``end`` on that are not shown yet, because their inputs (``arm.effort_delay``) or the sample time are unknown.
    """

    width: Width
    start: int = 0
    end: int = 0
    waiting: int = 0
    friction: tuple[FrictionSince, ...] = ()
    """The Coulomb friction learned before each of the latest events at which the payload was TRACKING."""
    _buffer: _Buffer | None = None

    def rows(self, first: int, until: int) -> Rows:
        """Return the rows ``first <= row < until``. Raises IndexError where they are not kept."""
        if not self.start <= first <= until <= self.end:
            raise IndexError(f'rows {first} to {until} of a log that holds {self.start} to {self.end}')
        return Rows(self, first, until)

    def row_at(self, stamp_ns: int, first: int) -> int:
        """Return the first row, ``first`` or later, with this stamp [ns] or a later one; ``end`` if none has."""
        buffer = self._buffer
        if buffer is None or first >= self.end:
            return self.end
        stamps = buffer.stamp_ns[first - buffer.first:self.end - buffer.first]
        return first + int(np.searchsorted(stamps, stamp_ns, side='left'))

    def append(self, stamp_ns: NDArray[np.int64], u: Array, y: Array, angles: Array, gap: NDArray[np.bool_],
               delay: int = 0, missing: NDArray[np.int64] | None = None, rates: Array | None = None,
               time_ns: NDArray[np.int64] | None = None) -> SampleLog:
        """Return the log with N more rows.

        stamp_ns: (N,); u: (N, r), whose row k holds the inputs of the row ``delay`` rows before row k; y: (N, m);
        angles: (N, a); gap: (N,); missing: (N,), see ``Rows.missing``; None: all were measured; rates: (N, a), where
        they are kept; time_ns: (N,), None: the stamps. A row is shown once its inputs are known.
        """
        buffer = self._with_room(len(stamp_ns))
        r, m, a = self.width[:3]
        at = self.end + self.waiting - buffer.first
        stop = at + len(stamp_ns)
        buffer.stamp_ns[at:stop] = stamp_ns
        buffer.time_ns[at:stop] = stamp_ns if time_ns is None else time_ns
        buffer.values[at:stop, r:r + m] = y
        buffer.values[at:stop, r + m:r + m + a] = angles
        if rates is not None:
            buffer.values[at:stop, r + m + a:] = rates
        buffer.gap[at:stop] = gap
        buffer.missing[at:stop] = 0 if missing is None else missing
        earliest = self.end - buffer.first
        skipped = max(0, earliest - (at - delay))
        if skipped < len(u):
            buffer.values[at - delay + skipped:stop - delay, :r] = u[skipped:]
        buffer.filled = stop + buffer.first
        end = max(self.end, buffer.filled - delay)
        return replace(self, end=end, waiting=buffer.filled - end, _buffer=buffer)

    def wait(self, raw: Sample) -> SampleLog:
        """Return the log with one more waiting row, whose inputs are its own (no ``delay``)."""
        log = self.append(np.array([raw.stamp_ns]), raw.u[None], raw.y[None], raw.angles[None],
                          np.zeros(1, dtype=np.bool_), rates=raw.rates[None])
        return replace(log, end=self.end, waiting=self.waiting + 1)

    def waiting_rows(self) -> Rows:
        """Return the waiting rows."""
        return Rows(self, self.end, self.end + self.waiting)

    @property
    def first_ns(self) -> int:
        """Stamp of the first row that is kept, waiting or not [ns]."""
        return int(Rows(self, self.start, self.end + self.waiting).stamp_ns[0])

    def without_waiting(self) -> SampleLog:
        """Return the log without the waiting rows."""
        return replace(self, waiting=0)

    def before(self, until: int) -> SampleLog:
        """Return the log without the rows from ``until`` on, waiting ones included."""
        return replace(self, end=until, waiting=0)

    def from_row(self, first: int) -> SampleLog:
        """Return the log without the rows before ``first``; their memory is freed with the next buffer."""
        return replace(self, start=min(max(first, self.start), self.end))

    def with_friction(self, stamp_ns: int, torques: tuple[float, ...] | None) -> SampleLog:
        """Return the log with the friction from a stamp on; None: that before it stays. Forget what was noted later."""
        known = [one for one in self.friction if one.stamp_ns < stamp_ns]
        if torques is not None:
            known.append(FrictionSince(stamp_ns, torques))
        return replace(self, friction=tuple(known[-MOST_FRICTIONS:]))

    def _with_room(self, count: int) -> _Buffer:
        """Return a buffer that may be written after the last row, with room for ``count`` rows."""
        old, last = self._buffer, self.end + self.waiting
        if old is not None and old.filled == last and last - old.first + count <= len(old.stamp_ns):
            return old
        kept = last - self.start
        size = max(SMALLEST, 2 * (kept + count))
        new = _Buffer(self.start, last, np.zeros(size, dtype=np.int64), np.zeros(size, dtype=np.int64),
                      np.zeros((size, sum(self.width))), np.zeros(size, dtype=np.bool_), np.zeros(size, dtype=np.int64))
        if old is not None and kept:
            for name in ('stamp_ns', 'time_ns', 'values', 'gap', 'missing'):
                getattr(new, name)[:kept] = getattr(old, name)[self.start - old.first:last - old.first]
        return new


@dataclass(frozen=True, eq=False)
class Rows:
    """The rows ``first <= row < until`` of a log; N = until - first. Its arrays are views: do not write them."""

    log: SampleLog
    first: int
    until: int
    chosen: tuple[int, ...] | None = None
    """Which outputs ``y`` shows; None: all."""
    friction: tuple[Friction, ...] = ()
    """Coulomb friction that ``u`` is without."""

    def __len__(self) -> int:
        """Return N."""
        return self.until - self.first

    def since(self, first: int) -> Rows:
        """Return the rows from another first row on. Raises IndexError where that is not kept any more."""
        if not self.log.start <= first <= self.until:
            raise IndexError(f'row {first} of a log that holds {self.log.start} to {self.log.end}')
        return Rows(self.log, first, self.until, self.chosen, self.friction)

    def between(self, first: int, until: int) -> Rows:
        """Return the rows ``first <= row < until`` of the same log."""
        return Rows(self.log, first, until, self.chosen, self.friction)

    def _column(self, name: str, kind: type[Kind]) -> NDArray[Kind]:
        buffer = self.log._buffer
        if buffer is None:
            return np.zeros(0, kind)
        column: NDArray[Kind] = getattr(buffer, name)
        return column[self.first - buffer.first:self.until - buffer.first]

    def _values(self, begin: int, end: int) -> Array:
        buffer = self.log._buffer
        return np.zeros((0, end - begin)) if buffer is None else (
            buffer.values[self.first - buffer.first:self.until - buffer.first, begin:end])

    @property
    def stamp_ns(self) -> NDArray[np.int64]:
        """(N,) stamps [ns]."""
        return self._column('stamp_ns', np.int64)

    @property
    def time_ns(self) -> NDArray[np.int64]:
        """(N,) when the rows were sampled, by the clock of the publisher [ns]; without jitter the stamps."""
        return self._column('time_ns', np.int64)

    @property
    def u(self) -> Array:
        """(N, r) inputs, each held from its stamp on [N m], less the ``friction`` (zero where a rate is unknown)."""
        u = self._values(0, self.log.width.inputs)
        if not self.friction:
            return u
        net = u.copy()
        for column, joint, torque, rate in self.friction:
            net[:, column] -= torque * np.nan_to_num(np.tanh(self.rates[:, joint] / rate))
        return net

    @property
    def y(self) -> Array:
        """(N, m) outputs [m, m/s, rad, ...]."""
        y = self._values(self.log.width.inputs, self.log.width.inputs + self.log.width.outputs)
        return y if self.chosen is None else y[:, list(self.chosen)]

    @property
    def u_y(self) -> Array:
        """(N, r + m) inputs and outputs."""
        inputs = self.log.width.inputs
        both = self._values(0, inputs + self.log.width.outputs)
        return np.hstack([self.u, both[:, inputs:]]) if self.friction else both

    @property
    def angles(self) -> Array:
        """(N, a) measured configuration [rad]."""
        before = self.log.width.inputs + self.log.width.outputs
        return self._values(before, before + self.log.width.angles)

    @property
    def rates(self) -> Array:
        """(N, a) measured rates of the joints [rad/s], NaN where the message had none; (N, 0): none are kept."""
        return self._values(sum(self.log.width[:3]), sum(self.log.width))

    @property
    def missing(self) -> NDArray[np.int64]:
        """(N,) 0 where the row was measured; k where it is the k-th of consecutive rows whose messages never came.

        The values of a missing row are interpolated between the messages around it. No estimator treats its outputs as
        measured. A row made of several rows (decimation) counts as measured where half of them were.
        """
        return self._column('missing', np.int64)

    @property
    def gap(self) -> NDArray[np.bool_]:
        """(N,) True where motion or torques just before the row are unknown: no regressor may reach back over it."""
        return self._column('gap', np.bool_)

    def stretches(self) -> list[Rows]:
        """Return the rows in pieces, each of which has a gap at most before its first row."""
        later = self.gap[1:]
        if not later.any():
            return [self] if len(self) else []
        gaps = (np.flatnonzero(later) + self.first + 1).tolist()
        borders = [self.first, *gaps, self.until]
        return [self.between(a, b) for a, b in pairwise(borders) if b > a]


@dataclass(frozen=True, eq=False)
class Signals:
    """The samples of a run as named columns, for pictures, tables and scores.

    stamp_ns: (N,); u: (N, r) the inputs of the model; y: (N, m); angles: (N, 2) or (N, 0); gap: (N,) True where the
    motion before the sample is unknown; missing: (N,) not 0 where the message never came and values are interpolated.
    with_friction: (N, r) the inputs of the messages; None: they are those of the model.
    """

    stamp_ns: NDArray[np.int64]
    u: Array
    y: Array
    angles: Array
    gap: NDArray[np.bool_]
    missing: NDArray[np.int64]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    with_friction: Array | None = None

    @property
    def efforts(self) -> Array:
        """(N, r) inputs of the messages: those of the model and the Coulomb friction."""
        return self.u if self.with_friction is None else self.with_friction

    @property
    def time(self) -> Array:
        """Seconds from the first sample: (N,)."""
        first = self.stamp_ns[0] if self.stamp_ns.size else 0
        return np.asarray((self.stamp_ns - first) * 1e-9, dtype=np.float64)


def log_of(u: Array, y: Array, angles: Array | None = None, stamp_ns: NDArray[np.int64] | None = None,
           gap: NDArray[np.bool_] | None = None, missing: NDArray[np.int64] | None = None,
           rates: Array | None = None) -> SampleLog:
    """Return a log of arrays: u (N, r), y (N, m), angles and rates (N, a), stamp_ns, gap and missing (N,)."""
    u, y = np.atleast_2d(u), np.atleast_2d(y)
    count = len(y)
    angles = np.zeros((count, 0)) if angles is None else angles
    log = SampleLog(Width(u.shape[1], y.shape[1], angles.shape[1], 0 if rates is None else rates.shape[1]))
    return log.append(np.zeros(count, dtype=np.int64) if stamp_ns is None else stamp_ns, u, y, angles,
                      np.zeros(count, dtype=np.bool_) if gap is None else gap, missing=missing, rates=rates)
