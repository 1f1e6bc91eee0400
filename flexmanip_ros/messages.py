"""The layout of everything published, as plain values: the live node and a bag written offline share it.

Nothing here imports ROS. ``message`` builds the message of a value; ``ros/conversions`` and ``io/bag_writer`` each
give it their own message classes, so both carry the same numbers.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from flexmanip_ros.types import (
    QUANTILE,
    ArmParameter,
    Array,
    CaptureEvent,
    Estimate,
    JointRecord,
    Mode,
    Payload,
    StateSpace,
    Status,
)

MODEL = 'model'
MODES = 'modes'
MODES_INTERVAL = 'modes_interval'
PAYLOAD_MASS = 'payload_mass'
PAYLOAD_ESTIMATE = 'payload_estimate'
PAYLOAD = 'payload'
PAYLOAD_BODY = 'payload_body'
ARM_PARAMETERS = 'arm_parameters'
STATUS = 'status'
LATCHED = frozenset({MODEL, PAYLOAD_ESTIMATE, PAYLOAD, PAYLOAD_BODY, ARM_PARAMETERS, STATUS})
"""The topics whose last message a late subscription still gets (transient local, depth 1)."""


class LabelledArray(NamedTuple):
    """A Float64MultiArray, row-major, data_offset 0; labels: one for each dimension of ``data``, outermost first."""

    labels: tuple[str, ...]
    data: Array


class Inertia(NamedTuple):
    """An InertiaStamped in ``frame_id``.

    mass: [kg], com: (3,) [m], inertia: ixx ixy ixz iyy iyz izz [kg m^2] about the centre of mass.
    """

    stamp_ns: int
    frame_id: str
    mass: float
    com: tuple[float, float, float]
    inertia: tuple[float, float, float, float, float, float]


class DiagnosticStatus(NamedTuple):
    """One entry of a DiagnosticArray; level 0 OK, 1 WARN, 2 ERROR, 3 STALE."""

    level: int
    name: str
    message: str
    hardware_id: str
    values: tuple[tuple[str, str], ...]


class Diagnostics(NamedTuple):
    """A DiagnosticArray."""

    stamp_ns: int
    statuses: tuple[DiagnosticStatus, ...]


def model_matrix(model: StateSpace) -> LabelledArray:
    """Return [[A, B, K], [C, D, I]] (n + m, n + r + m) with its sizes and sample time in the labels."""
    n, r, m = model.order, model.B.shape[1], model.C.shape[0]
    values = np.block([[model.A, model.B, model.K], [model.C, model.D, np.eye(m)]])
    return LabelledArray((f'rows: state={n} output={m} dt={model.dt!r}',
                          f'columns: state={n} input={r} innovation={m}'), values)


def modes_matrix(modes: tuple[Mode, ...], order: int) -> LabelledArray:
    """Return (order // 2, 2), one mode a row in rising frequency: damped frequency [Hz], damping ratio.

    A model of order n has up to n // 2 modes; rows without a mode are NaN. The size never changes, so a viewer that
    draws one curve for each entry of the first message shows all modes.
    """
    rows = [(mode.frequency_hz, mode.damping_ratio) for mode in _known(modes)]
    return LabelledArray(('modes', 'frequency_hz damping_ratio'), _filled(rows, order // 2, 2))


def modes_interval(modes: tuple[Mode, ...], order: int) -> LabelledArray:
    """Return (order // 2, 4), rows as in ``modes_matrix``: lower and upper 95 % of frequency [Hz] and damping ratio.

    Entries are NaN where there is no mode, where its standard deviation is unknown, and where the interval is too wide:
    it would reach below 0 Hz, or more than 1 to either side of the damping ratio. The first samples of a model give
    intervals of 1e10 Hz, which would set the scale of every viewer.
    """
    rows = []
    for mode in _known(modes):
        frequency, damping = QUANTILE * mode.frequency_std_hz, QUANTILE * mode.damping_ratio_std
        frequency = frequency if frequency <= mode.frequency_hz else math.nan
        damping = damping if damping <= 1.0 else math.nan
        rows.append((mode.frequency_hz - frequency, mode.frequency_hz + frequency,
                     mode.damping_ratio - damping, mode.damping_ratio + damping))
    return LabelledArray(('modes', 'frequency_lower95_hz frequency_upper95_hz damping_lower95 damping_upper95'),
                         _filled(rows, order // 2, 4))


def _known(modes: tuple[Mode, ...]) -> list[Mode]:
    """Return the modes with a frequency and a damping ratio, rising frequency."""
    return sorted((mode for mode in modes if math.isfinite(mode.frequency_hz) and math.isfinite(mode.damping_ratio)),
                  key=lambda mode: (mode.frequency_hz, mode.damping_ratio))


def _filled(rows: Sequence[tuple[float, ...]], height: int, width: int) -> Array:
    """Return rows as (height, width); missing or non-finite entries are NaN, all with the same bits."""
    values = np.full((height, width), np.nan)
    if rows:
        given = np.array(rows[:height], dtype=np.float64)
        values[:len(given)] = np.where(np.isfinite(given), given, np.nan)
    return values


def payload_body(payload: Payload) -> LabelledArray:
    """Return (5, 4): row 1 mass [kg], centre of mass x, y [m], inertia about it [kg m^2]; rows 2 to 5 covariance."""
    first = np.array([payload.mass, payload.com[0], payload.com[1], payload.inertia[5]])
    return LabelledArray(
        ('value covariance_mass covariance_com_x covariance_com_y covariance_izz', 'mass com_x com_y izz'),
        np.vstack([first, np.array(payload.covariance).reshape(4, 4)]))


def arm_parameters(found: Sequence[ArmParameter]) -> LabelledArray:
    """Return value and standard deviation, one parameter a row; the label of the rows lists the names in order."""
    return LabelledArray((','.join(one.name for one in found), 'value std'),
                         np.array([(one.value, one.std) for one in found]).reshape(len(found), 2))


def payload_status(payload: Payload, stamp_ns: int, frame_id: str) -> Diagnostics:
    """Return payload, interval and status under one stamp; level OK only where the payload is to be trusted.

    mass_kg is nan while nothing is known of it.
    """
    known = math.isfinite(payload.std)
    trusted = known and payload.status is Status.TRACKING
    numbers = {'mass_kg': payload.mass if known else math.nan, 'std_kg': payload.std, 'lower95_kg': payload.lower,
               'upper95_kg': payload.upper, 'consistency': payload.consistency,
               **dict(zip(('com_x_m', 'com_y_m', 'com_z_m'), payload.com, strict=True)),
               **dict(zip(('ixx', 'ixy', 'ixz', 'iyy', 'iyz', 'izz'), payload.inertia, strict=True))}
    return _status('payload', payload.status, trusted, stamp_ns, frame_id, numbers)


def model_status(estimate: Estimate) -> Diagnostics:
    """Return the status of model and modes under their stamp; level OK only where they are to be trusted."""
    numbers = {f'{name}{k}': value for k, mode in enumerate(estimate.modes, start=1) for name, value in (
        ('frequency_hz_', mode.frequency_hz), ('frequency_std_hz_', mode.frequency_std_hz),
        ('damping_ratio_', mode.damping_ratio), ('damping_ratio_std_', mode.damping_ratio_std))}
    status = estimate.model_status
    return _status('model', status, status is Status.TRACKING, estimate.stamp_ns, '', numbers)


def _status(name: str, status: Status, trusted: bool, stamp_ns: int, hardware_id: str, numbers: dict[str, float]
            ) -> Diagnostics:
    values = (('status', status.name), *((key, repr(float(value))) for key, value in numbers.items()))
    return Diagnostics(stamp_ns, (DiagnosticStatus(0 if trusted else 1, name, status.value, hardware_id, values),))


Value = LabelledArray | Inertia | Diagnostics | float
"""What the identifier publishes."""
AnyValue = Value | JointRecord | CaptureEvent
"""Every value that has a message."""
SECOND = 1_000_000_000
FIRST_NS, LAST_NS = -(1 << 31) * SECOND, (1 << 31) * SECOND - 1
"""Smallest and largest time that a stamp can hold [ns] (its seconds have 32 bits)."""


def stamp(nanoseconds: int) -> dict[str, int]:
    """Return the fields of a Time; a time beyond the range of stamps becomes the nearest stamp."""
    sec, nanosec = divmod(min(max(nanoseconds, FIRST_NS), LAST_NS), SECOND)
    return {'sec': sec, 'nanosec': nanosec}


def message(value: AnyValue, new: Callable[..., Any]) -> Any:
    """Return a value as its ROS message. new: makes a message from the name of its type and its fields."""
    def header(stamp_ns: int, frame_id: str = '') -> Any:
        return new('std_msgs/msg/Header', stamp=new('builtin_interfaces/msg/Time', **stamp(stamp_ns)),
                   frame_id=frame_id)

    if isinstance(value, JointRecord):
        arrays = {name: np.ascontiguousarray(getattr(value, name), dtype=np.float64)
                  for name in ('position', 'velocity', 'effort')}
        return new('sensor_msgs/msg/JointState', header=header(value.stamp_ns), name=list(value.names), **arrays)
    if isinstance(value, CaptureEvent):
        return header(value.stamp_ns, value.kind.value)
    if isinstance(value, LabelledArray):
        shape, data = value.data.shape, np.ascontiguousarray(value.data, dtype=np.float64).ravel()
        dimensions = [new('std_msgs/msg/MultiArrayDimension', label=label, size=size, stride=math.prod(shape[k:]))
                      for k, (label, size) in enumerate(zip(value.labels, shape, strict=True))]
        layout = new('std_msgs/msg/MultiArrayLayout', dim=dimensions, data_offset=0)
        return new('std_msgs/msg/Float64MultiArray', layout=layout, data=data)
    if isinstance(value, Inertia):
        com = new('geometry_msgs/msg/Vector3', **dict(zip('xyz', map(float, value.com), strict=True)))
        moments = dict(zip(('ixx', 'ixy', 'ixz', 'iyy', 'iyz', 'izz'), map(float, value.inertia), strict=True))
        body = new('geometry_msgs/msg/Inertia', m=float(value.mass), com=com, **moments)
        return new('geometry_msgs/msg/InertiaStamped', header=header(value.stamp_ns, value.frame_id), inertia=body)
    if isinstance(value, Diagnostics):
        statuses = [
            new('diagnostic_msgs/msg/DiagnosticStatus', level=item.level, name=item.name, message=item.message,
                hardware_id=item.hardware_id,
                values=[new('diagnostic_msgs/msg/KeyValue', key=key, value=text) for key, text in item.values])
            for item in value.statuses]
        return new('diagnostic_msgs/msg/DiagnosticArray', header=header(value.stamp_ns), status=statuses)
    return new('std_msgs/msg/Float64', data=float(value))


def outgoing(estimate: Estimate, frame_id: str) -> Iterator[tuple[str, Value]]:
    """Yield (topic below the node's name, value) of everything an estimate publishes."""
    yield from outgoing_payload(estimate.payload, estimate.stamp_ns, frame_id)
    found = estimate.arm_parameters
    if found and all(math.isfinite(one.value) and math.isfinite(one.std) for one in found):
        yield ARM_PARAMETERS, arm_parameters(found)
    yield from outgoing_model(estimate)


def outgoing_payload(payload: Payload | None, stamp_ns: int, frame_id: str) -> Iterator[tuple[str, Value]]:
    """Yield what an estimate says of the payload.

    Only the status may contain NaN. While nothing is known the interval is infinite, and neither ``payload`` nor
    ``payload_mass`` is published.
    """
    if payload is None or not math.isfinite(payload.mass):
        return
    numbers = payload.std, payload.lower, payload.upper, payload.consistency
    if any(map(math.isnan, numbers)):
        return
    if all(map(math.isfinite, (payload.std, *payload.com, *payload.inertia))):
        yield PAYLOAD, Inertia(stamp_ns, frame_id, payload.mass, payload.com, payload.inertia)
    yield PAYLOAD_ESTIMATE, LabelledArray(('mass std lower95 upper95 consistency',), np.array([payload.mass, *numbers]))
    if payload.covariance and all(map(math.isfinite, (*payload.covariance, *payload.com, *payload.inertia))):
        yield PAYLOAD_BODY, payload_body(payload)
    if math.isfinite(payload.std):
        yield PAYLOAD_MASS, payload.mass
    yield STATUS, payload_status(payload, stamp_ns, frame_id)


def outgoing_model(estimate: Estimate) -> Iterator[tuple[str, Value]]:
    """Yield model, modes and their status if they were read with this estimate.

    Unknown rows of modes and intervals are NaN. Nothing is yielded where a matrix of the model is not finite.
    """
    model = estimate.model
    if model is None or not estimate.model_is_new:
        return
    if all(np.isfinite(part).all() for part in (model.A, model.B, model.C, model.D, model.K)):
        yield MODEL, model_matrix(model)
        yield MODES, modes_matrix(estimate.modes, model.order)
        yield MODES_INTERVAL, modes_interval(estimate.modes, model.order)
        yield STATUS, model_status(estimate)
