"""Value types that the modules exchange. They are immutable, and their arrays are never written to."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
QUANTILE = 1.959963984540054
"""Half width of a 95 % interval, in standard deviations."""
LOOPED_NS = 1_000_000_000
"""Step back of the stamps [ns] beyond which a new run begins, such as a looped recording."""


class EventKind(Enum):
    """What happened at the end of the arm; the value is the ``frame_id`` on the wire."""

    CAPTURE = 'capture'
    RELEASE = 'release'


DATING_STD_S = 0.003
"""Standard deviation of the instant of an event that was found in the signals [s]. For half of these events the error
is at most 2 ms (benchmark ``detection_delay``), which is 0.67 standard deviations."""


class CaptureEvent(NamedTuple):
    """The arm took or let go of an object at ``stamp_ns``; that is the stamp of the first sample after the change."""

    stamp_ns: int
    kind: EventKind
    std_s: float = 0.0
    """Standard deviation of the instant [s]; 0: it is known."""

    def heard_on(self, topic: str) -> CaptureEvent:
        """Return the event with the deviation of its topic: one on ``capture_detected`` was found in the signals."""
        return self._replace(std_s=DATING_STD_S) if topic.endswith('capture_detected') else self


def events_at(start_ns: int, capture_s: float, release_s: float) -> tuple[CaptureEvent, ...]:
    """Return a capture and a release at times after a stamp [s]; leave out one with a time below 0."""
    return tuple(CaptureEvent(start_ns + round(at * 1e9), kind) for at, kind in (
        (capture_s, EventKind.CAPTURE), (release_s, EventKind.RELEASE)) if at >= 0.0)


class JointRecord(NamedTuple):
    """One JointState as it was published: names and whatever of the three arrays it carried.

    position: (j,) [rad or m], velocity: (j,) or (0,), effort: (j,) or (0,) [N m].
    """

    stamp_ns: int
    names: tuple[str, ...]
    position: Array
    velocity: Array
    effort: Array


class JointBlock(NamedTuple):
    """N consecutive JointStates that share names and layout.

    stamp_ns: (N,); position: (N, j) or (N, 0) [rad or m], velocity: the same, effort: the same [N m].
    """

    names: tuple[str, ...]
    stamp_ns: NDArray[np.int64]
    position: Array
    velocity: Array
    effort: Array

    def record(self, k: int) -> JointRecord:
        """Return message number k."""
        return JointRecord(int(self.stamp_ns[k]), self.names, self.position[k], self.velocity[k], self.effort[k])

    def part(self, taken: slice | NDArray[np.bool_]) -> JointBlock:
        """Return some of the messages."""
        return JointBlock(self.names, self.stamp_ns[taken], self.position[taken], self.velocity[taken],
                          self.effort[taken])

    @classmethod
    def of(cls, record: JointRecord) -> JointBlock:
        """Return a block of one message."""
        return cls(record.names, np.array([record.stamp_ns]), record.position[None], record.velocity[None],
                   record.effort[None])


class Sample(NamedTuple):
    """One instant of the configured signals, in JointState units.

    u: (r,) inputs held from ``stamp_ns`` on [N m]; y: (m,) outputs [m, m/s, rad, ...];
    angles: (2,) measured configuration [rad], or (0,) when none is configured; rates: (2,) measured rates of the same
    joints [rad/s], NaN where the message has none, or (0,) when nothing reads them.
    """

    stamp_ns: int
    u: Array
    y: Array
    angles: Array
    rates: Array


class Status(Enum):
    """How far an estimate can be trusted. The value is the sentence a user reads."""

    WARMING_UP = 'not enough samples yet'
    TRACKING = 'tracking'
    POORLY_EXCITED = 'the signals carry too little information'
    ILL_CONDITIONED = 'the regression is nearly singular'
    ORDER_TOO_LOW = 'the signals hold more dynamics than the order'
    INCONSISTENT = 'the residuals do not fit the model; the interval was widened'
    UNOBSERVABLE = 'these signals cannot give a payload'
    DIVERGED = 'the computed motion went far from the samples; the estimator began again'


@dataclass(frozen=True, eq=False)
class StateSpace:
    """x(k+1) = A x + B u + K e, y = C x + D u + e, one step of ``dt`` seconds (paper eqs. 22-23).

    A: (n, n), B: (n, r), C: (m, n), D: (m, r), K: (n, m), in JointState units.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    K: Array
    dt: float

    @property
    def order(self) -> int:
        """Number of states n."""
        return int(self.A.shape[0])


class Mode(NamedTuple):
    """One oscillation: damped frequency [Hz], damping ratio [-], standard deviations (nan: unknown)."""

    frequency_hz: float
    damping_ratio: float
    frequency_std_hz: float = float('nan')
    damping_ratio_std: float = float('nan')


class Payload(NamedTuple):
    """What the arm holds.

    mass, std, lower, upper: [kg], the last two a 95 % interval; consistency: normalised residual
    power (1 = noise only); com: (3,) [m] and inertia: (6,) ixx ixy ixz iyy iyz izz [kg m^2] about
    the centre of mass, in the frame of the tip; covariance: (16,) row by row of mass, com x, com y and izz, empty where
    the object is not estimated as a body.
    """

    mass: float
    std: float
    lower: float
    upper: float
    consistency: float
    status: Status
    com: tuple[float, float, float] = (0.0, 0.0, 0.0)
    inertia: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    covariance: tuple[float, ...] = ()


class ArmParameter(NamedTuple):
    """A learned parameter of the arm with its standard deviation, in SI units."""

    name: str
    value: float
    std: float


class Estimate(NamedTuple):
    """Everything published at one stamp. ``model`` and ``payload`` are None until there is one."""

    stamp_ns: int
    status: Status
    model: StateSpace | None
    modes: tuple[Mode, ...]
    payload: Payload | None
    excitation: float = float('nan')
    """Smallest over largest eigenvalue of the regressor information, on scaled signals [-]."""
    condition: float = float('nan')
    """Condition number of the state regression [-]."""
    singular_values: Array | None = None
    """Singular values of observability x controllability, for the choice of the order."""
    innovation_power: float = float('nan')
    """Mean squared innovation over the variance expected [-]."""
    model_status: Status = Status.TRACKING
    """Status of the model; ``status`` is that of the payload where the payload is not read from the model."""
    model_is_new: bool = True
    """Whether model and modes were read at this stamp; False: they are those of an earlier estimate."""
    payload_is_new: bool = True
    """Whether no earlier estimate of this stamp contained the payload."""
    constant: Array | None = None
    """(n,) constant term of the model's state equation: offsets of sensors, bends under gravity."""
    arm_parameters: tuple[ArmParameter, ...] = ()
    """The learned arm parameters, in the first estimate of each second only."""
    reason: str = ''
    """What gave the model its status, with numbers; empty where the status says it all."""

    @property
    def status_reason(self) -> str:
        """``reason`` where ``status`` is that of the model."""
        return self.reason if self.status is self.model_status else ''
