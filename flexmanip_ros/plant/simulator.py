"""The simulated arm: init, step, attach, release, and a whole trajectory at once with the same numbers.

``step`` records the sample at the present stamp and then integrates one period with the torque held from
that stamp on. An event changes the state before the sample it belongs to: the sample stamped at the
event's instant is the first after the jump; an event between two stamps acts at the later one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from flexmanip_ros.errors import ModelError, SignalError
from flexmanip_ros.parameters.excitation import ExcitationParameters
from flexmanip_ros.parameters.plant import PlantParameters
from flexmanip_ros.plant import excitation, models, noise
from flexmanip_ros.plant.capture import Body, free_object, joined, rates_after
from flexmanip_ros.types import Array, CaptureEvent, EventKind, JointRecord

JOINT_NAMES = ('joint1', 'joint2', 'link1_bend', 'link2_bend')
REHEARSAL_TIME = 6.0
"""Seconds of the rehearsal that finds the signal levels, with the capture half way (the paper's run)."""


@dataclass(frozen=True, eq=False)
class PlantState:
    """The arm between two samples. Never written to; ``model`` holds constants and scratch only."""

    model: models.Model
    start_ns: int
    index: int
    """Number of the next sample."""
    x: Array
    """(2n,) coordinates and rates."""
    payload: Array
    """(4,) what the arm holds, see ``manipulator.payload_array``."""
    previous: Array
    """(2,) torque [N m] of the interval before the next sample."""
    noise_std: Array
    """(8,) of the positions, then the rates."""
    noise_block: Array
    """(BLOCK, 8) standard normal numbers around the next sample."""
    noise_number: int
    """Which block that is."""
    taking: Body | None = None
    """Part of an object that a soft gripper takes at each of the next samples."""
    taking_left: int = 0


class Trajectory(NamedTuple):
    """A simulated run, columns in the order of JOINT_NAMES (effort: the two joints)."""

    stamp_ns: np.ndarray[tuple[int], np.dtype[np.int64]]
    position: Array
    velocity: Array
    effort: Array
    names: tuple[str, ...] = JOINT_NAMES


def init(config: PlantParameters, start_ns: int = 0, noise_std: Array | None = None) -> PlantState:
    """Put the arm at rest at its initial angles, empty; sample 0 is stamped start_ns.

    noise_std: (8,) overrides the parameters'. With ``noise: snr`` and none given, the levels come from a
    noise-free rehearsal of the paper's excitation.
    """
    model = models.build(config)
    return PlantState(
        model=model, start_ns=start_ns, index=0, x=model.rest(), payload=np.zeros(4), previous=np.zeros(2),
        noise_std=_levels(config) if noise_std is None else np.array(noise_std, dtype=np.float64),
        noise_block=noise.block(config.seed, 0), noise_number=0)


def stamp(config: PlantParameters, state: PlantState) -> int:
    """Stamp [ns] of the next sample."""
    return state.start_ns + round(state.index * 1e9 / config.rate)


def step(config: PlantParameters, state: PlantState, efforts: Array) -> tuple[PlantState, JointRecord]:
    """Record the present sample and integrate one period under efforts (2,) [N m].

    Raises SignalError when efforts are not two finite numbers, ModelError when the simulation diverges.
    """
    efforts = _checked(np.asarray(efforts, dtype=np.float64).reshape(1, -1))
    now = stamp(config, state)
    state, position, velocity = _advance(config, state, efforts)
    record = JointRecord(now, JOINT_NAMES, position[0], velocity[0], np.array([*efforts[0], 0.0, 0.0]))
    return state, record


def attach(config: PlantParameters, state: PlantState) -> PlantState:
    """Take the object of the parameters, before the next sample; a soft gripper begins to."""
    parts = max(round(config.gripper_ramp * config.rate), 1)
    if parts == 1:
        return _take(config, state, free_object(config))
    return replace(state, taking=free_object(config).part(1.0 / parts), taking_left=parts)


def release(config: PlantParameters, state: PlantState) -> PlantState:
    """Let go of all that is held: the arm keeps its rates and the object those of the tip."""
    return replace(state, payload=np.zeros(4), taking=None, taking_left=0)


def simulate(
    config: PlantParameters, efforts: Array, events: Sequence[CaptureEvent] = (), start_ns: int = 0,
    noise_std: Array | None = None,
) -> Trajectory:
    """Run efforts.shape[0] samples under efforts (N, 2) [N m], events applied at their stamps.

    The same numbers as N steps. With ``noise: snr`` and no noise_std given, the levels are those of this
    very trajectory (a live plant cannot know them and rehearses).
    """
    efforts = _checked(np.asarray(efforts, dtype=np.float64))
    count = efforts.shape[0]
    own_levels = config.noise == 'snr' and noise_std is None
    state = init(config, start_ns, np.zeros(8) if own_levels else noise_std)
    stamps = start_ns + np.round(np.arange(count) * 1e9 / config.rate).astype(np.int64)
    position, velocity = np.empty((count, 4)), np.empty((count, 4))
    ordered = sorted(events, key=lambda event: event.stamp_ns)
    places = [int(np.searchsorted(stamps, event.stamp_ns)) for event in ordered]
    for first, last, event in zip([0, *places], [*places, count], [None, *ordered], strict=True):
        if event is not None and first < count:
            state = (attach if event.kind is EventKind.CAPTURE else release)(config, state)
        while first < last:
            end = first + 1 if state.taking_left else last
            state, position[first:end], velocity[first:end] = _advance(config, state, efforts[first:end])
            first = end
    if own_levels:
        levels = noise.std_for_snr(position, velocity, config.snr_db)
        normal = noise.normal(config.seed, 0, count) * levels
        position, velocity = position + normal[:, :4], velocity + normal[:, 4:]
    return Trajectory(stamps, position, velocity, efforts)


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
            np.array([*trajectory.effort[k], 0.0, 0.0]))


def _advance(config: PlantParameters, state: PlantState, efforts: Array) -> tuple[PlantState, Array, Array]:
    """Run efforts.shape[0] samples; return the state after them, positions and velocities (N, 4)."""
    if state.taking is not None:
        state = _take(config, state, state.taking)
        left = state.taking_left - 1
        state = replace(state, taking_left=left, taking=state.taking if left else None)
    x, previous = state.x.copy(), state.previous.copy()
    position, velocity = np.empty((len(efforts), 4)), np.empty((len(efforts), 4))
    good = state.model.advance(x, state.payload, previous, efforts, position, velocity)
    if good < len(efforts) or not np.all(np.isfinite(x)):
        raise ModelError(
            f'the simulation diverged {(state.index + good) / config.rate:.3f} s after its start',
            'lower the torque, raise the stiffness or the rate, or reset the plant')
    normal, number = state.noise_block, state.noise_number
    if np.any(state.noise_std):
        if len(efforts) == 1:
            if state.index // noise.BLOCK != number:
                number = state.index // noise.BLOCK
                normal = noise.block(config.seed, number)
            drawn = normal[state.index % noise.BLOCK][None]
        else:
            drawn = noise.normal(config.seed, state.index, len(efforts))
        position = position + drawn[:, :4] * state.noise_std[:4]
        velocity = velocity + drawn[:, 4:] * state.noise_std[4:]
    after = replace(state, index=state.index + len(efforts), x=x, previous=previous,
                    noise_block=normal, noise_number=number)
    return after, position, velocity


def _take(config: PlantParameters, state: PlantState, body: Body) -> PlantState:
    x = state.x.copy()
    n = x.size // 2
    if config.capture_impact == 'momentum' and (body.mass or body.inertia):
        M = state.model.mass_matrix(x, state.payload)
        x[n:] = rates_after(M, state.model.body_jacobian(x, body.com), x[n:], body, state.model.held)
    return replace(state, x=x, payload=joined(state.payload, body))


def _levels(config: PlantParameters) -> Array:
    if config.noise == 'none':
        return np.zeros(8)
    if config.noise == 'std':
        return np.array(config.noise_std)
    quiet = replace(config, noise='none')
    waves = ExcitationParameters(rate=config.rate, amplitude=config.rehearsal_torque)
    efforts = excitation.sequence(waves, round(REHEARSAL_TIME * config.rate))
    half = round(round(len(efforts) / 2) * 1e9 / config.rate)
    run = simulate(quiet, efforts, (CaptureEvent(half, EventKind.CAPTURE),))
    return noise.std_for_snr(run.position, run.velocity, config.snr_db)


def _checked(efforts: Array) -> Array:
    if efforts.ndim != 2 or efforts.shape[1] != 2:
        raise SignalError(f'the efforts have shape {efforts.shape}', 'give one torque for each of 2 joints')
    if not np.all(np.isfinite(efforts)):
        raise SignalError('an effort is not finite', 'look at the controller that sent it')
    return efforts
