"""The regulator over time: it follows configuration and trusted payload, without a bump in the torque.

``step`` takes a sample and gives the torques, ``estimate`` takes a payload estimate, ``goto`` a new setpoint.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from flexmanip_ros.control import path
from flexmanip_ros.control.feedback import Design, design, observation, reference
from flexmanip_ros.control.handover import PayloadEstimate, Verdict, judge
from flexmanip_ros.control.path import Path
from flexmanip_ros.errors import ModelError
from flexmanip_ros.parameters import ControllerParameters
from flexmanip_ros.types import Array


class Measured(NamedTuple):
    """Encoder angles and bends (2 L,) [rad, m], their rates (2 L,), and torques (L,) to add [N m]."""

    position: Array
    velocity: Array
    added: Array


class ControllerState(NamedTuple):
    """What is believed of the arm, gains in use and to come, and what they were made for."""

    C: Array
    now: Design
    old: Design
    """The design that ``now`` takes over from."""
    payload: float
    """Payload scheduled on [kg]; it follows ``trusted``."""
    trusted: float
    designed_payload: float
    designed_between: float
    x: Array | None = None
    """Predicted state (2n,) at the next sample; None before the first."""
    way: Path | None = None
    """Encoder angles to hold [rad], on the way to ``goal``."""
    goal: Array | None = None
    """The setpoint that ``way`` was planned for."""
    setpoint: Array | None = None
    blend: float = 1.0
    """0: the old gains, 1: the new ones."""
    verdict: Verdict | None = None
    """What became of the latest estimate."""
    designs: int = 0
    failed_designs: int = 0
    """How often there was no regulator for a configuration and payload."""

    @property
    def gain(self) -> Array:
        """Gains (2, 2n) in use."""
        return self.between(self.old.G, self.now.G)

    def between(self, old: Array, now: Array) -> Array:
        """Return what is in use while one design takes over from another."""
        return old + self.blend * (now - old)


def init(config: ControllerParameters) -> ControllerState:
    """Start with the gains of the straight arm and the initial payload."""
    first = design(config, 0.0, config.initial_payload)
    C: Array = np.kron(np.eye(2), observation(config)).astype(np.float64)
    return ControllerState(
        C=C, now=first, old=first,
        payload=config.initial_payload, trusted=config.initial_payload,
        designed_payload=config.initial_payload, designed_between=0.0,
        setpoint=None if config.hold_present else np.asarray(config.setpoint, dtype=np.float64))


def goto(state: ControllerState, angles: Array) -> ControllerState:
    """Move to other encoder angles (L,) [rad], as fast as rate, torque and bend may be."""
    if state.setpoint is not None and np.array_equal(state.setpoint, angles):
        return state
    return state._replace(setpoint=np.asarray(angles, dtype=np.float64))


def estimate(config: ControllerParameters, state: ControllerState, found: PayloadEstimate) -> ControllerState:
    """Take or refuse a payload estimate; the gains follow in ``step``."""
    verdict = judge(config, found)
    if verdict is Verdict.TRUSTED and config.use_estimate:
        return state._replace(verdict=verdict, trusted=max(found.mass, 0.0))
    return state._replace(verdict=verdict)


def step(config: ControllerParameters, state: ControllerState, measured: Measured
         ) -> tuple[ControllerState, Array]:
    """Return the torques (L,) [N m] for a sample, within the limits."""
    x = _filtered(config, state, measured)
    links = len(config.arm.link_length)
    state = _scheduled(config, state, float(x[links - 1] - x[0]))
    way = _onward(config, state, measured.position[:links])
    state = state._replace(way=way, goal=state.setpoint)
    wanted, acceleration = _wanted(config, state, way)
    feedforward = state.between(state.old.F, state.now.F) @ acceleration
    limit = np.asarray(config.effort_limit)
    torque: Array = np.clip(measured.added + feedforward - state.gain @ (x - wanted), -limit, limit)
    return state._replace(x=state.now.A @ x + state.now.B @ torque), torque


def _filtered(config: ControllerParameters, state: ControllerState, measured: Measured) -> Array:
    """Correct the prediction by the sample; at the first one the arm is taken for straight and at rest."""
    if state.x is None:
        first = np.zeros(len(state.now.A))
        links = len(measured.position) // 2
        first[:links] = reference(config, measured.position[:links])
        return first
    offset = np.zeros(len(state.C))
    offset[len(config.joints):len(measured.position)] = config.arm.bend_offset
    innovation = np.concatenate([measured.position, measured.velocity]) - offset - state.C @ state.x
    x: Array = state.x + state.now.L @ innovation
    return x


def _onward(config: ControllerParameters, state: ControllerState, present: Array) -> Path:
    """Stay at the first angles, go towards the setpoint when there is another one."""
    way = path.rest(present) if state.way is None else state.way.after(1.0 / config.rate)
    if state.setpoint is None or state.setpoint is state.goal:
        return way
    position, rate, *_ = way.now()
    design = state.now
    links = len(position)
    bends = state.C[links:2 * links, links:len(design.A) // 2] @ design.E
    limits = np.concatenate([config.move_effort * np.asarray(config.effort_limit), [config.move_bend] * links])
    seconds = path.duration(
        reference(config, state.setpoint - position), reference(config, rate), config.setpoint_rate,
        np.vstack([design.F, bends]), limits)
    return path.plan(way, state.setpoint, seconds)


def _wanted(config: ControllerParameters, state: ControllerState, way: Path) -> tuple[Array, Array]:
    """Return the state (2n,) that belongs to the way, bends included, and the chords' acceleration (L,)."""
    n = len(state.now.A) // 2
    if way.ended:
        wanted = np.zeros(2 * n)
        goal = reference(config, way.goal)
        wanted[:len(goal)] = goal
        return wanted, np.zeros(len(goal))
    position, rate, acceleration, jerk = (reference(config, row) for row in way.now())
    bends = state.between(state.old.E, state.now.E)
    return np.concatenate([position, bends @ acceleration, rate, bends @ jerk]), acceleration


def _scheduled(config: ControllerParameters, state: ControllerState, between: float) -> ControllerState:
    """Follow the trusted payload; design the gains again when it or the configuration changed enough."""
    reach = config.payload_rate / config.rate
    payload = state.payload + float(np.clip(state.trusted - state.payload, -reach, reach))
    share = 1.0 / (config.blend_time * config.rate) if config.blend_time > 0.0 else 1.0
    state = state._replace(payload=payload, blend=min(state.blend + share, 1.0))
    if state.blend < 1.0:
        return state  # one change after the other keeps the torque continuous and designs rare
    held_mass = config.arm.tip_mass + state.designed_payload
    same_mass = abs(payload - state.designed_payload) <= config.reschedule_mass * held_mass
    if same_mass and abs(between - state.designed_between) <= config.reschedule_angle:
        return state
    state = state._replace(designed_payload=payload, designed_between=between)
    try:
        wanted = design(config, between, payload)
    except ModelError:  # the gains in use go on
        return state._replace(failed_designs=state.failed_designs + 1)
    return state._replace(old=state.now, now=wanted, blend=0.0, designs=state.designs + 1)
