"""The regulator over time: it follows configuration and trusted payload, without a bump in the torque.

``step`` takes a sample and gives the torques, ``estimate`` takes a payload estimate, ``goto`` a new setpoint.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from flexmanip_ros.control.feedback import Design, design, observation, reference
from flexmanip_ros.control.gate import PayloadEstimate, Verdict, judge
from flexmanip_ros.errors import ModelError
from flexmanip_ros.parameters.controller import ControllerParameters
from flexmanip_ros.types import Array


class Measured(NamedTuple):
    """Encoder angles and bends (4,) [rad, m], their rates (4,), and torques (2,) to add [N m]."""

    position: Array
    velocity: Array
    added: Array


class ControllerState(NamedTuple):
    """What is believed of the arm, gains in use and to come, and what they were made for."""

    C: Array
    now: Design
    old: Array
    """Gains (2, 2n) that ``now.G`` takes over from."""
    payload: float
    """Payload scheduled on [kg]; it follows ``trusted``."""
    trusted: float
    designed_payload: float
    designed_between: float
    x: Array | None = None
    """Predicted state (2n,) at the next sample; None before the first."""
    held: Array | None = None
    """Encoder angles held now (2,) [rad], on the way to ``setpoint``."""
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
        return self.old + self.blend * (self.now.G - self.old)


def init(config: ControllerParameters) -> ControllerState:
    """Start with the gains of the straight arm and the initial payload."""
    first = design(config, 0.0, config.initial_payload)
    C: Array = np.kron(np.eye(2), observation(config)).astype(np.float64)
    return ControllerState(
        C=C, now=first, old=first.G,
        payload=config.initial_payload, trusted=config.initial_payload,
        designed_payload=config.initial_payload, designed_between=0.0,
        setpoint=None if config.hold_present else np.asarray(config.setpoint, dtype=np.float64))


def goto(state: ControllerState, angles: Array) -> ControllerState:
    """Move to other encoder angles (2,) [rad], at the configured rate."""
    return state._replace(setpoint=np.asarray(angles, dtype=np.float64))


def estimate(config: ControllerParameters, state: ControllerState, found: PayloadEstimate) -> ControllerState:
    """Take or refuse a payload estimate; the gains follow in ``step``."""
    verdict = judge(config, found)
    if verdict is Verdict.TRUSTED and config.use_estimate:
        return state._replace(verdict=verdict, trusted=max(found.mass, 0.0))
    return state._replace(verdict=verdict)


def step(config: ControllerParameters, state: ControllerState, measured: Measured
         ) -> tuple[ControllerState, Array]:
    """Return the torques (2,) [N m] for a sample, within the limits."""
    x = _filtered(config, state, measured)
    state = _held(config, state, measured.position[:2])
    state = _scheduled(config, state, float(x[1] - x[0]))
    assert state.held is not None
    error = x.copy()
    error[:2] -= reference(config, state.held)
    limit = np.asarray(config.effort_limit)
    torque: Array = np.clip(measured.added - state.gain @ error, -limit, limit)
    return state._replace(x=state.now.A @ x + state.now.B @ torque), torque


def _filtered(config: ControllerParameters, state: ControllerState, measured: Measured) -> Array:
    """Correct the prediction by the sample; at the first one the arm is taken for straight and at rest."""
    if state.x is None:
        first = np.zeros(len(state.now.A))
        first[:2] = reference(config, measured.position[:2])
        return first
    innovation = np.concatenate([measured.position, measured.velocity]) - state.C @ state.x
    x: Array = state.x + state.now.L @ innovation
    return x


def _held(config: ControllerParameters, state: ControllerState, present: Array) -> ControllerState:
    """Take the present angles at first, then move towards the setpoint no faster than allowed."""
    held = present.copy() if state.held is None else state.held
    target = held if state.setpoint is None else state.setpoint
    reach = config.setpoint_rate / config.rate
    return state._replace(held=held + np.clip(target - held, -reach, reach))


def _scheduled(config: ControllerParameters, state: ControllerState, between: float) -> ControllerState:
    """Let the payload follow the trusted one, design anew when it or the configuration changed enough."""
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
    return state._replace(old=state.now.G, now=wanted, blend=0.0, designs=state.designs + 1)
