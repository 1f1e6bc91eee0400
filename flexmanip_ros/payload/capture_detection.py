"""Capture and release found in the signals, sample by sample, without a trigger.

A structured filter that takes nothing to change runs along; its innovations are tested for a force that began
to push on the tip within the last ``detection_window`` (``detection_kernel``). The threshold follows from the
rate of false alarms allowed, and rises with what the model always misses, so that a plant the model does not
quite fit (unmodelled shortening, omitted modes) does not trip it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from flexmanip_ros.numerics.compiled import Prepared
from flexmanip_ros.parameters import IdentifierParameters, TriggerParameters
from flexmanip_ros.payload import capture_detection_kernel as kernel
from flexmanip_ros.payload import filter_state as mem
from flexmanip_ros.payload import structured
from flexmanip_ros.types import CaptureEvent, EventKind, Sample

SETTLE = 0.5
"""Seconds after the start or an event before the next can be told."""
CONFIRM = 0.01
"""Seconds from an alarm to its report: they date the onset."""
PEAK_MEMORY = 20.0
"""Seconds in which a peak of the statistic is forgotten."""
INDEPENDENT = 0.5
"""Samples a look that is as good as independent, over all onsets of the window (for the false alarms)."""
SPEED, ACCELERATION, JERK = 0.3, 5.0, 200.0
"""Prior deviations of what the tip's light mass would gain: impulse [m/s], step [m/s^2], ramp [m/s^3]."""
watch_samples = Prepared(kernel.watch_samples, 2)


@dataclass(frozen=True, eq=False)
class DetectionState:
    """Everything remembered; constant in size."""

    identifier: IdentifierParameters
    filter: structured.StructuredState
    kept: tuple[int, ...]
    """Outputs that are looked at."""
    watch: kernel.Watch | None = None
    dt: float = 0.0
    stamps: tuple[int, ...] = ()
    """Stamps of the last samples, to date an onset."""


def init(config: TriggerParameters) -> DetectionState:
    """Start with an empty arm."""
    # rates show the modes that the model leaves out, at every step of the torque
    kept = tuple(i for i, name in enumerate(config.outputs) if not name.endswith('/velocity'))
    kept = kept or tuple(range(len(config.outputs)))
    settings = IdentifierParameters(
        inputs=config.inputs, outputs=tuple(config.outputs[i] for i in kept), angles=config.angles,
        arm=config.arm, payload=config.payload, order=1)
    return DetectionState(settings, structured.init(settings), kept)


def step(
    config: TriggerParameters, state: DetectionState, sample: Sample,
) -> tuple[DetectionState, CaptureEvent | None]:
    """Take one sample; return the event it reveals, dated at its onset."""
    state, events = advance(config, state, (sample,))
    return state, events[0] if events else None


def advance(
    config: TriggerParameters, state: DetectionState, samples: Sequence[Sample],
) -> tuple[DetectionState, tuple[CaptureEvent, ...]]:
    """Take samples in the order of their stamps; return the events found, the same as one by one."""
    found: list[CaptureEvent] = []
    left = [sample._replace(y=sample.y[list(state.kept)]) for sample in samples]
    while left and state.filter.model is not None:
        if state.watch is None or state.filter.memory is None:
            state = _start(config, state, left[0])
            left = left[1:]
            continue
        gap = next((i for i, sample in enumerate(left) if sample.gap), len(left))
        if gap == 0:
            state = _resume(config, state, left[0])
            left = left[1:]
            continue
        state, taken, event = _watch(config, state, left[:gap])
        left = left[taken:]
        if event is not None:
            found.append(event)
    return state, tuple(found)


def statistic(state: DetectionState) -> tuple[float, float]:
    """Return the latest statistic and its threshold (0 and infinite before there are any)."""
    if state.watch is None:
        return 0.0, float('inf')
    level = state.watch.level
    return float(level[0]), float(max(level[3], kernel.CALM * level[2]))


def threshold(config: TriggerParameters, dt: float) -> float:
    """Return what the statistic exceeds by chance as rarely as the parameters allow.

    Under no event it is chi-square with as many degrees of freedom as there are causes; an hour holds so many
    independent looks, each at every onset of the window.
    """
    looks = 3600.0 / dt / INDEPENDENT
    chance = min(0.5, config.false_alarms_per_hour / looks)
    return float(chi2.isf(chance, kernel.CAUSES))


def _start(config: TriggerParameters, state: DetectionState, sample: Sample) -> DetectionState:
    """Let the filter start; then allocate the watch for its sample time."""
    stamps = (*state.stamps, sample.stamp_ns)
    state = replace(state, filter=structured.step(state.identifier, state.filter, sample), stamps=stamps)
    if state.filter.memory is None or state.filter.model is None:
        return state
    dt = float(np.median(np.diff(stamps))) * 1e-9
    w = max(kernel.SHORTEST + 2, round(config.detection_window / dt))
    n2 = 2 * state.filter.model.motion.q.size
    m = len(state.filter.model.roles)
    watch = kernel.Watch(
        trace=np.zeros((w, m, kernel.CAUSES)), factors=np.zeros((w, kernel.CAUSES, kernel.CAUSES)),
        scores=np.zeros((w, kernel.CAUSES)), past=np.zeros((w, m)), clock=np.zeros(6, dtype=np.int64),
        level=np.array([0.0, 0.0, 0.0, threshold(config, dt)]), history=np.zeros(2 * w),
        statistic=np.zeros(w), flow=np.zeros((n2, n2)), state=np.zeros((2, n2, 2)))
    return replace(state, watch=watch, dt=dt, stamps=stamps[-w:])


def _watch(
    config: TriggerParameters, state: DetectionState, samples: Sequence[Sample],
) -> tuple[DetectionState, int, CaptureEvent | None]:
    """Run until an alarm; return how many samples were taken and the event."""
    filtered, watch = state.filter, state.watch
    assert filtered.model is not None
    assert filtered.memory is not None
    assert filtered.sensors is not None
    assert filtered.effort is not None
    assert watch is not None
    m = mem.copy(filtered.memory)
    watch = kernel.Watch._make(part.copy() for part in watch)
    stamps = np.array([filtered.last_ns] + [sample.stamp_ns for sample in samples])
    efforts = np.array([filtered.effort, *(sample.u for sample in samples)], dtype=np.float64)
    confirm = round(CONFIRM / state.dt)
    light = filtered.model.motion.scale
    taken = watch_samples(
        filtered.model.motion, filtered.sensors, m, watch, light * np.array([SPEED, ACCELERATION, JERK]),
        state.dt, float(np.exp(-state.dt / PEAK_MEMORY)), round(SETTLE / state.dt), confirm,
        np.diff(stamps) * 1e-9, efforts[:-1], structured.measurements(filtered.model, samples),
        np.zeros(kernel.CAUSES))
    if taken < 0:
        fresh = replace(init(config), stamps=())
        return fresh, -taken, None
    w = watch.trace.shape[0]
    seen = (*state.stamps, *(int(stamp) for stamp in stamps[1:taken + 1]))[-w:]
    filtered = filtered._replace(memory=m, last_ns=int(stamps[taken]), effort=efforts[taken])
    state = replace(state, filter=filtered, watch=watch, stamps=seen)
    if watch.clock[kernel.ALARMED] <= confirm:
        return state, taken, None
    lag = min(int(watch.level[1]), len(seen) - 1)
    kind = EventKind.RELEASE if m.counts[mem.HELD] else EventKind.CAPTURE
    event = CaptureEvent(seen[-1 - lag], kind)
    return _after(state, event), taken, event


def _after(state: DetectionState, event: CaptureEvent) -> DetectionState:
    """Let the filter know; the samples since the onset misled it, so it looks at the motion anew."""
    assert state.watch is not None
    now = event._replace(stamp_ns=state.filter.last_ns)
    filtered = structured.event(state.identifier, state.filter, now)
    filtered = structured.reopen(state.identifier, filtered)
    return replace(state, filter=filtered, watch=_quiet(state.watch))


def _resume(config: TriggerParameters, state: DetectionState, sample: Sample) -> DetectionState:
    """After a gap: filter anew, test anew."""
    assert state.watch is not None
    filtered = structured.step(state.identifier, state.filter, sample)
    return replace(state, filter=filtered, watch=_quiet(state.watch), stamps=(sample.stamp_ns,))


def _quiet(watch: kernel.Watch) -> kernel.Watch:
    """Forget what was gathered; wait before the next alarm. What the model always misses stays known."""
    fresh = kernel.Watch._make(part.copy() for part in watch)
    fresh.clock[:] = 0
    fresh.level[:2] = 0.0
    fresh.history[:] = 0.0
    fresh.scores[:] = 0.0
    return fresh
