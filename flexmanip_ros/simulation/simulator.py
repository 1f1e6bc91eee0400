"""The simulated arm: init, step, attach, release, and a whole trajectory at once with the same numbers.

``step`` records the sample at the present stamp and then integrates one period with the torque held from
that stamp on. An event changes the state before the sample it belongs to: the sample stamped at the
event's instant is the first after the jump; an event between two stamps acts at the later one.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from flexmanip_ros.arm.capture import Body, free_object, rates_after
from flexmanip_ros.arm.late_torque import efforts_needed, late_torques
from flexmanip_ros.errors import ModelError, SignalError
from flexmanip_ros.parameters import ExcitationParameters, PlantParameters, SensorParameters
from flexmanip_ros.simulation import models, sensors, waveforms
from flexmanip_ros.types import Array, CaptureEvent, EventKind, JointRecord


@lru_cache
def joint_names(links: int) -> tuple[str, ...]:
    """Return the names in a message: joints, then bends."""
    return (*(f'joint{i + 1}' for i in range(links)), *(f'link{i + 1}_bend' for i in range(links)))


LONGEST_BLOCK = 10_000
"""Largest number of samples that one call of a compiled function simulates, some tenths of a second: an interrupt waits
for its end."""
REHEARSAL_TIME = 6.0
"""Seconds of the rehearsal that finds the signal levels, with the capture half way (the paper's run)."""


class PlantState(NamedTuple):
    """The arm between two samples. Never written to; ``model`` holds constants and scratch only."""

    model: models.Model
    start_ns: int
    sample: int
    """Number of the next sample."""
    x: Array
    """(2n,) coordinates and rates."""
    payload: Array
    """(4,) what the arm holds, see ``manipulator.payload_array``."""
    noise_std: Array
    """(4 L,) standard deviations of the noise on the positions, then on the rates."""
    gauges: Array
    """(2, L) low-pass state of the deflections and of their rates."""
    bends: Array
    """(K, 2 L) deflections and their rates of the last samples, where they are measured late."""
    efforts: Array
    """(P - 1, L) past efforts that still affect the torque, where torques are late."""
    commands: Array
    """(command_delay, L) torques on their way to the drives."""
    reported: Array
    """(effort_delay, L) torques that are still to be reported."""
    taking: Body | None = None
    """Part of an object that a soft gripper takes at each of the next samples."""
    taking_left: int = 0


class Trajectory(NamedTuple):
    """A simulated run as its messages carry it; columns in the order of ``names`` (effort: of the joints only)."""

    stamp_ns: np.ndarray[tuple[int], np.dtype[np.int64]]
    position: Array
    velocity: Array
    effort: Array
    names: tuple[str, ...]


def init(config: PlantParameters, start_ns: int = 0, noise_std: Array | None = None) -> PlantState:
    """Put the arm at rest at its initial angles, empty; sample 0 is stamped start_ns.

    noise_std: (4 L,) overrides the parameters'. With ``noise: snr`` and none given, the levels come from a
    noise-free rehearsal of the paper's excitation.
    """
    model = models.build(config)
    links = len(config.arm.link_length)
    late = efforts_needed(config.arm.torque_delay, max(config.arm.torque_lag), 1.0 / config.rate)
    return PlantState(
        model=model, start_ns=start_ns, sample=0, x=model.rest(), payload=np.zeros(4),
        noise_std=_levels(config) if noise_std is None else np.array(noise_std, dtype=np.float64),
        gauges=np.zeros((2, links)), bends=np.zeros((sensors.bends_needed(config), 2 * links)),
        efforts=np.zeros((late - 1, links)),
        commands=np.zeros((config.actuators.command_delay, links)),
        reported=np.zeros((config.arm.effort_delay, links)))


def stamp(config: PlantParameters, state: PlantState) -> int:
    """Stamp [ns] of the next sample."""
    return state.start_ns + round(state.sample * 1e9 / config.rate)


def step(
    config: PlantParameters, state: PlantState, efforts: Array,
) -> tuple[PlantState, JointRecord | None]:
    """Record the present sample and integrate one period under efforts (L,) [N m].

    The record is None when the sample is lost on its way (``sensors.drop_probability``).
    Raises SignalError when efforts are not as many finite numbers as joints, ModelError when the simulation diverges.
    """
    efforts = _checked(config, np.asarray(efforts, dtype=np.float64).reshape(1, -1))
    now = stamp(config, state)
    drawn = sensors.block(config.seed, state.sample // sensors.BLOCK)[state.sample % sensors.BLOCK][None]
    state, position, velocity, effort = _advance(config, state, efforts)
    if not sensors.arrives(config, drawn)[0]:
        return state, None
    sensors.read(config, position, velocity, state.noise_std, drawn)
    record = JointRecord(
        now + int(sensors.jitter_ns(config, drawn)[0]), joint_names(len(effort[0])), position[0], velocity[0],
        np.concatenate([effort[0], np.zeros_like(effort[0])]))
    return state, record


def attach(config: PlantParameters, state: PlantState) -> PlantState:
    """Attach the object of the parameters before the next sample; a soft gripper begins to take it.

    The part of a previous object that a soft gripper has yet to take is attached at once.
    """
    if state.taking is not None:
        state = _take(config, state, state.taking.part(state.taking_left))
        state = state._replace(taking=None, taking_left=0)
    parts = max(round(config.gripper_ramp * config.rate), 1)
    if parts == 1:
        return _take(config, state, free_object(config))
    return state._replace(taking=free_object(config).part(1.0 / parts), taking_left=parts)


def release(config: PlantParameters, state: PlantState) -> PlantState:
    """Let go of all that is held: the arm keeps its rates and the object those of the tip."""
    return state._replace(payload=np.zeros(4), taking=None, taking_left=0)


def on_samples(config: PlantParameters, events: Sequence[CaptureEvent], start_ns: int = 0) -> tuple[CaptureEvent, ...]:
    """Return events stamped at the instant at which they act: the first sample that is not older.

    A recording must say this instant. Taken as exact, a stamp that is half a millisecond early puts a mass that is
    caught at rest some 10 % off.
    """
    acting = (math.ceil((event.stamp_ns - start_ns) * 1e-9 * config.rate - 1e-6) for event in events)
    return tuple(event._replace(stamp_ns=start_ns + round(k * 1e9 / config.rate))
                 for event, k in zip(events, acting, strict=True))


def simulate(
    config: PlantParameters, efforts: Array, events: Sequence[CaptureEvent] = (), start_ns: int = 0,
) -> Trajectory:
    """Run efforts.shape[0] samples under efforts (N, L) [N m], events applied at their stamps.

    The same numbers as N steps. With ``noise: snr`` the levels are those of this very trajectory (a live plant cannot
    know them and rehearses).
    """
    efforts = _checked(config, np.asarray(efforts, dtype=np.float64))
    count = efforts.shape[0]
    own_levels = config.noise == 'snr'
    state = init(config, start_ns, np.zeros(4 * efforts.shape[1]) if own_levels else None)
    stamps = start_ns + np.round(np.arange(count) * 1e9 / config.rate).astype(np.int64)
    m = 2 * efforts.shape[1]
    rows = np.empty((count, 2 * m + m // 2))
    ordered = sorted(events, key=lambda event: event.stamp_ns)
    places = [int(np.searchsorted(stamps, event.stamp_ns)) for event in ordered]
    for first, last, event in zip([0, *places], [*places, count], [None, *ordered], strict=True):
        if event is not None and first < count:
            state = (attach if event.kind is EventKind.CAPTURE else release)(config, state)
        while first < last:
            end = first + 1 if state.taking_left else min(first + LONGEST_BLOCK, last)
            state, *parts = _advance(config, state, efforts[first:end])
            rows[first:end] = np.hstack(parts)
            first = end
    position, velocity, effort = rows[:, :m].copy(), rows[:, m:2 * m].copy(), rows[:, 2 * m:].copy()
    levels = sensors.std_for_snr(position, velocity, config.snr_db) if own_levels else state.noise_std
    drawn = sensors.normal(config.seed, count)
    sensors.read(config, position, velocity, levels, drawn)
    kept = sensors.arrives(config, drawn)
    stamps = stamps + sensors.jitter_ns(config, drawn)
    return Trajectory(stamps[kept], position[kept], velocity[kept], effort[kept], joint_names(efforts.shape[1]))


def records(
    trajectory: Trajectory, events: Sequence[CaptureEvent] = (),
) -> Iterator[JointRecord | CaptureEvent]:
    """Messages of a trajectory in time order, each event before the first sample that is not older."""
    waiting = sorted(events, key=lambda event: event.stamp_ns, reverse=True)
    for k, now in enumerate(trajectory.stamp_ns.tolist()):
        while waiting and waiting[-1].stamp_ns <= now:
            yield waiting.pop()
        yield JointRecord(
            now, trajectory.names, trajectory.position[k], trajectory.velocity[k],
            np.concatenate([trajectory.effort[k], np.zeros_like(trajectory.effort[k])]))


def _advance(
    config: PlantParameters, state: PlantState, efforts: Array,
) -> tuple[PlantState, Array, Array, Array]:
    """Run commands (N, L); return the state after them, positions, rates (N, 2 L) and reported torques."""
    if state.taking is not None:
        state = _take(config, state, state.taking)
        left = state.taking_left - 1
        state = state._replace(taking_left=left, taking=state.taking if left else None)
    count = len(efforts)
    queue = np.concatenate([state.commands, sensors.saturated(config, efforts)])
    applied = np.ascontiguousarray(queue[:count])
    reported = np.concatenate([state.reported, applied])
    x, gauges = state.x.copy(), state.gauges.copy()
    position, velocity = (np.empty((count, 2 * efforts.shape[1])) for _ in range(2))
    efforts = np.concatenate([state.efforts, applied])
    torques = applied.copy()
    if len(state.efforts):
        late_torques(efforts, config.arm.torque_delay, np.array(config.arm.torque_lag), 1.0 / config.rate, np.zeros(2),
                     torques)
    good = state.model.advance(x, state.payload, torques * np.array(config.arm.torque_gain), position, velocity)
    if good < count:
        raise ModelError(
            f'the simulation diverged {(state.sample + good) / config.rate:.3f} s after its start',
            'lower the torque, or velocity and spin of the object; raise the stiffness or the rate; or reset the plant')
    sensors.gauge(config, position, velocity, gauges)
    bends = sensors.late_bends(config, position, velocity, state.bends)
    sensors.misread(config, position, velocity)
    after = state._replace(sample=state.sample + count, x=x, gauges=gauges, bends=bends, efforts=efforts[count:],
                    commands=queue[count:], reported=reported[count:])
    return after, position, velocity, reported[:count]


def _take(config: PlantParameters, state: PlantState, body: Body) -> PlantState:
    x, model = state.x.copy(), state.model
    n = x.size // 2
    if config.capture_impact == 'momentum' and (body.mass or body.inertia):
        x[n:] = rates_after(
            model.mass_matrix(x, state.payload), model.body_jacobian(x, state.payload, body.com), x[n:], body,
            model.floating_mass(state.payload), model.held)
    return state._replace(x=x, payload=state.payload + body.payload)


def _levels(config: PlantParameters) -> Array:
    if config.noise == 'none':
        return np.zeros(4 * len(config.arm.link_length))
    if config.noise == 'std':
        return np.array(config.noise_std)
    gauges_only = SensorParameters(strain_cutoff=config.sensors.strain_cutoff)
    quiet = replace(config, noise='none', sensors=gauges_only)
    waves = ExcitationParameters(rate=config.rate, amplitude=config.rehearsal_torque, arm=config.arm)
    efforts = waveforms.scaled(waves, waves.amplitude, np.arange(round(REHEARSAL_TIME * config.rate)))
    half = round(round(len(efforts) / 2) * 1e9 / config.rate)
    run = simulate(quiet, efforts, (CaptureEvent(half, EventKind.CAPTURE),))
    return sensors.std_for_snr(run.position, run.velocity, config.snr_db)


def _checked(config: PlantParameters, efforts: Array) -> Array:
    links = len(config.arm.link_length)
    if efforts.ndim != 2 or efforts.shape[1] != links:
        raise SignalError(f'the efforts have shape {efforts.shape}', f'give one torque for each of {links} joints')
    if not np.isfinite(efforts).all():
        raise SignalError('an effort is not finite', 'look at the controller that sent it')
    return efforts
