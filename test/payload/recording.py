"""Samples of a simulated arm for the payload tests."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import scipy.signal

from flexmanip_ros.parameters import (
    ArmParameters,
    ExcitationParameters,
    IdentifierParameters,
    PlantParameters,
)
from flexmanip_ros.payload import filter_state as mem
from flexmanip_ros.payload import structured
from flexmanip_ros.samples import sampling
from flexmanip_ros.samples.sample_log import Rows, log_of
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, EventKind, JointRecord, Payload

BENDS = ('link1_bend/position', 'link2_bend/position')
RATES = ('link1_bend/velocity', 'link2_bend/velocity')
ARM = ArmParameters(shape_functions='sines', damping_ratio=0.003, modes=2)


def config(
        arm: ArmParameters = ARM, outputs: tuple[str, ...] = BENDS + RATES, **parameters,
) -> IdentifierParameters:
    return IdentifierParameters(arm=arm, outputs=outputs, order=4, **parameters)


def event(seconds: float, kind: EventKind = EventKind.CAPTURE) -> CaptureEvent:
    return CaptureEvent(round(seconds * 1e9), kind)


def record(
        seconds: float, events: tuple[CaptureEvent, ...] = (), degrees=(60.0, 45.0), payload: float = 20.0,
        outputs: tuple[str, ...] = BENDS + RATES, seed: int = 1, arm: ArmParameters = ARM, scale: float = 1.0,
        peaks: tuple[float, float] = (10.0, 5.0), added: np.ndarray | float = 0.0, **plant,
) -> Rows:
    """Samples at 1 kHz under the paper's square waves and the torques ``added``, 40 dB."""
    parameters = PlantParameters(
        initial_angles=tuple(np.radians(degrees)), payload_mass=payload, seed=seed, arm=arm, **plant)
    efforts = scale * excitation.sequence(ExcitationParameters(amplitude=peaks), round(1000 * seconds)) + added
    trajectory = simulator.simulate(parameters, efforts, events)
    columns = {'position': trajectory.position, 'velocity': trajectory.velocity}
    parts = [name.split('/') for name in outputs]
    Y = np.column_stack([columns[field][:, trajectory.names.index(joint)] for joint, field in parts])
    return rows_of(trajectory.effort[:, :2], Y, trajectory.position[:, :2], trajectory.stamp_ns)


def run(
        settings: IdentifierParameters, samples: Rows, events: tuple[CaptureEvent, ...] = (),
) -> structured.StructuredState:
    """The estimator after the samples, each event before the first one that is not older."""
    state, start = structured.init(settings), 0
    for one in events:
        stop = samples.log.row_at(one.stamp_ns, start)
        state = structured.event(settings, structured.advance(settings, state, samples.between(start, stop)), one)
        start = stop
    return structured.advance(settings, state, samples.since(start))


def rows_of(u: np.ndarray, y: np.ndarray, angles: np.ndarray, stamp_ns: np.ndarray,
            gap: np.ndarray | None = None) -> Rows:
    """All rows of a log of whole arrays."""
    return log_of(u, y, angles, stamp_ns, gap).rows(0, len(y))


def joined(*parts: Rows, gap: bool = False) -> Rows:
    """One log of parts; gap: a sample is missing between them."""
    gaps = [part.gap.copy() for part in parts]
    for one in gaps[1:]:
        one[0] = gap
    return rows_of(*(np.concatenate([getattr(part, name) for part in parts])
                     for name in ('u', 'y', 'angles', 'stamp_ns')), np.concatenate(gaps))


def altered(rows: Rows, **columns: np.ndarray) -> Rows:
    """The same rows with other columns."""
    whole = {name: getattr(rows, name) for name in ('u', 'y', 'angles', 'stamp_ns', 'gap')}
    return rows_of(**{**whole, **columns})


def noise_of_rows(state: structured.StructuredState, efforts: np.ndarray) -> np.ndarray:
    """The variance of each measurement (N, m) in the rows of the horizon, with that of the omitted modes.

    efforts: (N, L) of these rows; the changes are filtered all at once.
    """
    m, sensors = state.memory, state.sensors
    real, imaginary, last = m.ringing[1]
    turn = sensors.turn[0] + 1j * sensors.turn[1]
    changes = np.diff(np.vstack([last, efforts]), axis=0) + 0j
    changes[0] += turn * (real + 1j * imaginary)
    phasor = scipy.signal.lfilter([1.0], [1.0, -turn], changes, axis=0)
    return m.noise[:, mem.EFFECTIVE] + np.abs(phasor) ** 2 @ sensors.omitted.T


def samples_of(config: IdentifierParameters, items: Iterable[JointRecord | CaptureEvent]
               ) -> tuple[Rows, tuple[CaptureEvent, ...]]:
    """The samples that the pipeline makes of messages, and the events among them."""
    clock, log, events = sampling.Clock(), sampling.EMPTY, []
    for item in items:
        if isinstance(item, CaptureEvent):
            events.append(item)
        else:
            clock, log, _ = sampling.push(config, clock, log, item)
    clock, log, _ = sampling.flush(config, clock, log)
    assert clock.channels.outputs == config.outputs  # the messages carry what the configuration names
    return log.rows(0, log.end), tuple(events)


def payloads_of(config: IdentifierParameters, samples: Rows, events: tuple[CaptureEvent, ...], since: int
                ) -> list[Payload]:
    """What is known of the payload after ``since`` samples, and after every 20 more: 50 times a second at 1 kHz."""
    state = run(config, samples.between(0, since), events)
    found = [structured.estimate(config, state)]
    for row in range(since, len(samples), 20):
        state = structured.advance(config, state, samples.between(row, min(row + 20, len(samples))))
        found.append(structured.estimate(config, state))
    return found


def payload_at_end(config: IdentifierParameters, items: Iterable[JointRecord | CaptureEvent]) -> Payload:
    """What is known of the payload after the last message, to the bit as by the pipeline (``test_structured``).

    Nothing is identified: the model takes most of the time of the pipeline.
    """
    samples, events = samples_of(config, items)
    return structured.estimate(config, run(config, samples, events))
