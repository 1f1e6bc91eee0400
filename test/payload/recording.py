"""Samples of a simulated arm for the payload tests."""

from __future__ import annotations

import numpy as np

from flexmanip_ros.parameters import (
    ArmParameters,
    ExcitationParameters,
    IdentifierParameters,
    PlantParameters,
)
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, EventKind, Sample

BENDS = ('link1_bend/position', 'link2_bend/position')
RATES = ('link1_bend/velocity', 'link2_bend/velocity')
ARM = ArmParameters(damping_ratio=0.003, modes=2, slope_correction=False)


def config(
        arm: ArmParameters = ARM, outputs: tuple[str, ...] = BENDS + RATES, **parameters,
) -> IdentifierParameters:
    return IdentifierParameters(arm=arm, outputs=outputs, order=4, **parameters)


def event(seconds: float, kind: EventKind = EventKind.CAPTURE) -> CaptureEvent:
    return CaptureEvent(round(seconds * 1e9), kind)


def record(
        seconds: float, events: tuple[CaptureEvent, ...] = (), degrees=(60.0, 45.0), payload: float = 20.0,
        outputs: tuple[str, ...] = BENDS + RATES, seed: int = 1, arm: ArmParameters = ARM, scale: float = 1.0,
        **plant,
) -> list[Sample]:
    """Samples at 1 kHz under the paper's square waves, 40 dB."""
    parameters = PlantParameters(
        initial_angles=tuple(np.radians(degrees)), payload_mass=payload, seed=seed, arm=arm, **plant)
    efforts = scale * excitation.sequence(ExcitationParameters(), round(1000 * seconds))
    trajectory = simulator.simulate(parameters, efforts, events)
    columns = {'position': trajectory.position, 'velocity': trajectory.velocity}
    parts = [name.split('/') for name in outputs]
    Y = np.column_stack([columns[field][:, simulator.JOINT_NAMES.index(joint)] for joint, field in parts])
    return [Sample(int(stamp), effort, y, angles) for stamp, effort, y, angles in zip(
        trajectory.stamp_ns, trajectory.effort[:, :2], Y, trajectory.position[:, :2], strict=True)]
