"""Convert the messages of a run to the compact JSON that the page shows, without ROS.

A ``Screen`` takes joint states in blocks, events and the identifier's status messages, and returns frames. A frame
contains everything since the frame before. A live page gets a frame at a rate of ``ViewParameters.rate``, the page of a
recording a single frame with everything. Times are the stamps in seconds since the first sample. Samples are sent as
rows of float32 in base64: each value has seven digits, and NaN stays NaN, which the page draws as a gap.
"""

import base64
import json
import math
from collections import deque
from collections.abc import Iterable
from importlib import resources
from typing import Any, NamedTuple

import numpy as np

from flexmanip_ros import messages
from flexmanip_ros.messages import Diagnostics, DiagnosticStatus
from flexmanip_ros.parameters import IdentifierParameters, ViewParameters
from flexmanip_ros.parameters.nodes import WINDOWS
from flexmanip_ros.samples.signals import reads_angles
from flexmanip_ros.types import LOOPED_NS, Array, CaptureEvent, Estimate, EventKind, JointBlock, Status

COLOURS = ('#0072B2', '#D55E00', '#009E73', '#CC79A7', '#E69F00', '#56B4E9', '#7F7F7F', '#000000')
"""Colours of lines on this page and in figures: the palette of Okabe and Ito, distinct for any colour vision."""
PAYLOAD_COLOUR = '#009E73'
EVENT_COLOUR = '#AA0000'
STATUS_LOOKS: dict[Status, tuple[str, str]] = {
    Status.WARMING_UP: ('#C8C8C8', '..'), Status.TRACKING: ('#009E73', ''), Status.POORLY_EXCITED: ('#E69F00', '//'),
    Status.ILL_CONDITIONED: ('#CC79A7', 'xx'), Status.INCONSISTENT: ('#D55E00', '\\\\'),
    Status.UNOBSERVABLE: ('#7F7F7F', '++'), Status.DIVERGED: ('#000000', 'OO'), Status.ORDER_TOO_LOW: ('#F0E442', '**'),
}
"""Colour and hatch of each status, so that they differ by more than their colour."""
MODES_APART = 4.0
"""Ratio to the lowest known frequency above which a mode does not set the range of a plot [-]."""
KNOWN_BAND = 0.3
"""Largest half width of the 95 % band of a mode that counts as known, as a fraction of its frequency [-]."""

GAP = 3.0
"""Interval between samples above which a line has a gap [sample times]."""
SAME_EVENT_S = 0.2
"""Time within which two events of one kind are shown as one, as when it is announced and found in the signals [s]."""
LATEST_INTERVALS = 64
"""Number of latest intervals between samples, whose median is taken as the sample time."""
MOST_ESTIMATES = 10_000
"""Largest number of payloads, and of models, shown of a recording. Of a larger number every n-th is shown."""
MOST_EVENTS = 200
LARGEST = 3e38
"""Largest magnitude of a value that is sent as float32; a larger one becomes NaN."""
PAYLOAD_NUMBERS = ('mass_kg', 'std_kg', 'lower95_kg', 'upper95_kg', 'consistency')
STATUSES = {status.name: index for index, status in enumerate(Status)}
SPACE_FOR = '"insert the layout here"', '"insert the recording here"'
"""Placeholders in the page that are replaced by the layout and the recording."""
EMBEDDED_ROWS = 40_000
"""Number of rows to which the samples inside a report are thinned out, so that it stays below some megabytes."""


class Source(NamedTuple):
    """Which signals are shown, and of which arm."""

    title: str
    words: str
    """Where the samples come from: a topic, or the name of a recording."""
    config: ViewParameters

    @property
    def bends(self) -> tuple[str, ...]:
        """The signals below the inputs: outputs that are positions but no joint angles; without any, all outputs."""
        positions = tuple(name for name in self.config.outputs
                          if name.endswith('/position') and name not in self.config.angles)
        return positions or self.config.outputs

    @property
    def columns(self) -> tuple[str, ...]:
        """The signals of a row, in which they follow the time."""
        return (*self.config.inputs, *self.bends, *self.config.angles)

    @property
    def is_arm(self) -> bool:
        """Whether the arm can be drawn: there are one angle and one bend for each link."""
        return len(self.config.angles) == len(self.bends) == len(self.config.arm.link_length)

    def layout(self) -> dict[str, Any]:
        """Return what a page has to know before the first sample."""
        config, arm, r, m = self.config, self.config.arm, len(self.config.inputs), len(self.bends)
        torques = all(name.endswith('/effort') for name in config.inputs)
        positions = all(name.endswith('/position') for name in self.bends)
        return {
            'title': self.title, 'words': self.words, 'columns': len(self.columns),
            'torques': {'title': 'torque' if torques else 'input', 'unit': 'N m' if torques else '', 'scale': 1,
                        'lines': [[_short(name, torques), k] for k, name in enumerate(config.inputs)]},
            'bends': {'title': 'bend' if self.is_arm else 'position' if positions else 'output',
                      'unit': 'mm' if self.is_arm else '', 'scale': 1000 if self.is_arm else 1,
                      'lines': [[_short(name, positions), r + k] for k, name in enumerate(self.bends)]},
            'arm': {'length': arm.link_length, 'sensor': arm.sensor_position, 'bends': [*range(r, r + m)],
                    'angles': [*range(r + m, r + 2 * m)],
                    'chords': arm.angle_convention == 'chord'} if self.is_arm else None,
            'statuses': [[status.name, status.value, STATUS_LOOKS[status][0]] for status in Status],
            'tracking': STATUSES[Status.TRACKING.name],
            'colours': COLOURS, 'payload_colour': PAYLOAD_COLOUR, 'event_colour': EVENT_COLOUR,
            'modes_apart': MODES_APART, 'known_band': KNOWN_BAND, 'stale_after': config.stale_after,
            'exaggeration': config.exaggeration, 'window': config.window, 'windows': WINDOWS,
        }


def of_identifier(config: IdentifierParameters, words: str) -> Source:
    """Return what is shown of a recording. words: its name."""
    return Source('Recording', words, ViewParameters(
        inputs=config.inputs, outputs=config.outputs, angles=config.angles if reads_angles(config) else (),
        arm=config.arm))


class Screen:
    """Takes messages and returns frames. After a frame it keeps only the latest events of the messages."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.samples = 0
        """Number of joint states taken since the start, in all runs."""
        self.runs = 0
        """Number of runs begun; each run has its own time 0."""
        self._joints = {name.rpartition('/')[0] for name in source.columns}
        self._is_known = False
        """Whether a joint state with any of these joints came."""
        self._begin()

    def _begin(self) -> None:
        """Forget the run."""
        self.first_ns: int | None = None
        self._last_ns: int | None = None
        self._intervals: Array = np.zeros(0)
        self._rows: list[Array] = []
        self._payloads: list[tuple[int, list[Any]]] = []
        self._models: list[tuple[int, list[Any]]] = []
        self._known: deque[CaptureEvent] = deque(maxlen=MOST_EVENTS)
        self._events: deque[CaptureEvent] = deque(maxlen=MOST_EVENTS)

    def _begin_with(self, events: list[CaptureEvent]) -> None:
        self._begin()
        for event in events:
            self.event(event)

    def joint_states(self, block: JointBlock) -> None:
        """Take joint states. Stamps that do not advance are left out; a jump back begins a new run.

        Those with none of the joints shown, such as those of a gripper, are left out once others came.
        """
        has_joint = not self._joints.isdisjoint(block.names)
        if self._is_known and not has_joint:
            return
        if has_joint and not self._is_known and self.first_ns is not None:
            self._begin_with(list(self._known))
        self._is_known = has_joint
        stamps = block.stamp_ns
        if not len(stamps):
            return
        before = self._last_ns
        highest = np.maximum.accumulate(np.concatenate([[stamps[0] - 1 if before is None else before], stamps]))[:-1]
        back = np.flatnonzero(stamps < highest - LOOPED_NS)
        if back.size:
            k = int(back[0])
            self.joint_states(block.part(slice(0, k)))
            self._begin_with([event for event in self._known if event.stamp_ns >= stamps[k]])
            self.joint_states(block.part(slice(k, None)))
            return
        self.samples += len(stamps)
        if self.first_ns is None:
            self.first_ns = int(stamps[0])
            self.runs += 1
        advancing = stamps > highest
        if not advancing.any():
            return
        values = self._values(block)[advancing]
        stamps = stamps[advancing]
        self._last_ns = int(stamps[-1])
        time = (stamps - self.first_ns) * 1e-9
        self._rows.append(self._with_gaps(np.column_stack([time, values]), before))

    def _values(self, block: JointBlock) -> Array:
        """Return the signals (N, c), NaN for one that is not in the messages."""
        values = np.full((len(block.stamp_ns), len(self.source.columns)), np.nan)
        for column, name in enumerate(self.source.columns):
            joint, _, field = name.rpartition('/')
            given: Array = getattr(block, field)
            if joint in block.names[:given.shape[1]]:
                values[:, column] = given[:, block.names.index(joint)]
        values[~(np.abs(values) <= LARGEST)] = np.nan
        return values

    def _with_gaps(self, rows: Array, before_ns: int | None) -> Array:
        """Return the rows with a row of NaN inserted wherever samples are missing."""
        assert self.first_ns is not None
        earlier = rows[:1, 0] if before_ns is None else [(before_ns - self.first_ns) * 1e-9]
        intervals = np.diff(np.concatenate([earlier, rows[:, 0]]))
        known = intervals[intervals > 0.0]
        self._intervals = np.concatenate([self._intervals, known])[-LATEST_INTERVALS:]
        if not self._intervals.size:
            return rows
        median = np.sort(self._intervals)[self._intervals.size // 2]  # takes a tenth of the time of np.median
        missing = np.flatnonzero(intervals > GAP * median)
        if not missing.size:
            return rows
        gaps = np.full((missing.size, rows.shape[1]), np.nan)
        gaps[:, 0] = rows[missing, 0] - 0.5 * intervals[missing]
        return np.insert(rows, missing, gaps, axis=0)

    def event(self, event: CaptureEvent) -> None:
        """Take a capture or release, announced or found in the signals."""
        if not any(known.kind is event.kind and abs(known.stamp_ns - event.stamp_ns) <= SAME_EVENT_S * 1e9
                   for known in self._known):
            self._known.append(event)
            self._events.append(event)

    def status(self, message: Diagnostics) -> None:
        """Take a message of the identifier's ``~/status``."""
        for status in message.statuses:
            row = _numbers(status)
            if row is not None:
                (self._payloads if status.name == 'payload' else self._models).append((message.stamp_ns, row))

    def estimate(self, estimate: Estimate) -> None:
        """Take an estimate as the messages that the node would publish."""
        for name, value in messages.outgoing(estimate, ''):
            if name == messages.STATUS and isinstance(value, Diagnostics):
                self.status(value)

    def frame(self, most_rows: int | None = None) -> dict[str, Any]:
        """Return what came since the frame before. most_rows: samples are thinned to so many."""
        if self.first_ns is None:  # without a first sample there is no time 0
            del self._payloads[:-1], self._models[:-1]
            return {}
        first_ns, frame = self.first_ns, dict[str, Any]()
        if self._rows:
            rows = np.concatenate(self._rows)
            if most_rows is not None:
                rows = thinned(rows, most_rows)
            start = float(rows[0, 0])
            rows[:, 0] -= start
            frame['samples'] = {'start': start, 'data': base64.b64encode(rows.astype('<f4').tobytes()).decode('ascii')}
        for name, found in (('payloads', self._payloads), ('models', self._models)):
            if found:
                step = 1 if most_rows is None else -(-len(found) // MOST_ESTIMATES)
                frame[name] = [[(stamp - first_ns) * 1e-9, *row] for stamp, row in found[::-step][::-1]]
        if self._events:
            frame['events'] = [[(event.stamp_ns - first_ns) * 1e-9, event.kind is EventKind.CAPTURE]
                               for event in self._events]
        self._rows, self._payloads, self._models = [], [], []
        self._events.clear()
        return frame


def thinned(rows: Array, most: int) -> Array:
    """Return about ``most`` rows (N, 1 + c) that draw the same lines: the extremes of each stretch, in order.

    A stretch that holds a NaN is a gap in that column.
    """
    if len(rows) <= most:
        return rows
    size = -(-2 * len(rows) // most)
    count = len(rows) // size
    blocks = rows[:count * size].reshape(count, size, -1)
    values = blocks[:, :, 1:]
    low, high = values.argmin(axis=1), values.argmax(axis=1)  # the index of a NaN where there is one
    pair = np.sort(np.stack([low, high], axis=1), axis=1)
    made = np.empty((count, 2, rows.shape[1]))
    made[:, :, 1:] = np.take_along_axis(values, pair, axis=1)
    made[:, 0, 0], made[:, 1, 0] = blocks[:, size // 4, 0], blocks[:, 3 * size // 4, 0]
    return np.concatenate([made.reshape(-1, rows.shape[1]), rows[count * size:][-1:]])


def page(source: Source, recording: dict[str, Any] | None = None, speed: float = 1.0, *, playing: bool = True) -> str:
    """Return the whole page; with a recording inside it needs no server.

    playing: whether a recording plays at once; if not, its end is shown first.
    """
    text = resources.files('flexmanip_ros.view').joinpath('page.html').read_text(encoding='utf-8')
    layout = source.layout() | {'speed': speed, 'playing': playing}
    for place, value in zip(SPACE_FOR, (layout, recording), strict=True):
        # The browser ends a script element at "</script>" even inside a string.
        text = text.replace(place, encoded(value).replace('<', '\\u003c'), 1)
    return text


def embedded(screen: Screen, estimates: Iterable[Estimate]) -> str:
    """Return a page with a recording inside, for a report. screen: already contains joint states and events."""
    for estimate in estimates:
        screen.estimate(estimate)
    return page(screen.source, screen.frame(EMBEDDED_ROWS), playing=False)


def encoded(value: Any) -> str:
    """Return a value as JSON without spaces."""
    return json.dumps(value, separators=(',', ':'), allow_nan=False)


def _short(name: str, by_joint: bool) -> str:
    """Return the label of a line: the joint's name where all lines show the same field, else the signal's name."""
    return name.rpartition('/')[0] if by_joint else name


def _numbers(status: DiagnosticStatus) -> list[Any] | None:
    """Return the index of the status, then the numbers of a payload or of each mode; None for other entries."""
    texts = dict(status.values)
    index = STATUSES.get(texts.get('status', ''))
    if index is None or status.name not in ('payload', 'model'):
        return None
    if status.name == 'payload':
        return [index, *(_finite(texts.get(name)) for name in PAYLOAD_NUMBERS)]
    numbers: list[Any] = [index]
    while f'frequency_hz_{1 + len(numbers) // 2}' in texts:
        k = 1 + len(numbers) // 2
        numbers += [_finite(texts[f'frequency_hz_{k}']), _finite(texts.get(f'frequency_std_hz_{k}'))]
    return numbers


def _finite(text: str | None) -> float | None:
    """Return a number of a status message, with seven digits; None where there is none or it is infinite."""
    try:
        value = float(text or 'nan')
    except ValueError:
        return None
    return float(f'{value:.7g}') if math.isfinite(value) else None
