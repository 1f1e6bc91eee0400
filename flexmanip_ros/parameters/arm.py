"""The arm: what a user measures or looks up before anything is identified."""

from __future__ import annotations

from dataclasses import dataclass

from flexmanip_ros.parameters.field import check_all, parameter

SMALLEST = 1e-9
"""Lower bound of quantities that must be positive."""


@dataclass(frozen=True)
class ArmParameters:
    """Two flexible links, two joints, a mass at the tip (``MODEL`` notation in docs/notation.md)."""

    link_length: tuple[float, ...] = parameter(
        (3.0, 3.0), 'length of each link', unit='m', low=SMALLEST, size=2)
    linear_density: tuple[float, ...] = parameter(
        (5.0, 5.0), 'mass of each link per length', unit='kg/m', low=SMALLEST, size=2)
    bending_stiffness: tuple[float, ...] = parameter(
        (5000.0, 5000.0), "Young's modulus times second moment of area of each link", unit='N m^2',
        low=SMALLEST, size=2)
    joint_mass: float = parameter(10.0, 'mass at the end of link 1', unit='kg', low=SMALLEST)
    tip_mass: float = parameter(10.0, 'mass at the end of link 2 before capture', unit='kg', low=SMALLEST)
    hub_inertia: tuple[float, ...] = parameter(
        (0.0, 0.0), "rotary inertia of each joint's hub, turning with the root of its link", unit='kg m^2',
        low=0.0, size=2)
    joint_inertia: float = parameter(
        0.0, 'rotary inertia of the mass at the end of link 1, turning with it', unit='kg m^2', low=0.0)
    tip_inertia: float = parameter(
        0.0, 'rotary inertia of the tip mass, turning with the end of link 2', unit='kg m^2', low=0.0)
    damping_ratio: float = parameter(
        0.0, "damping of critical at each link's first pinned mode", low=0.0, high=0.99)
    damping_model: str = parameter(
        'stiffness', 'how damping grows over the modes: with frequency, or the same for every mode',
        choices=('stiffness', 'modal'))
    modes: int = parameter(
        3, 'assumed modes kappa of each link (`block` takes order / 4 instead)', low=1, high=12)
    shortening: bool = parameter(
        True, 'keep the shortening of a bent link to second order (the paper: false)')
    slope_correction: bool = parameter(
        True, 'add the truncated modes quasi-statically to the encoder angles (the paper: false)')
    sensor_position: tuple[float, ...] = parameter(
        (0.5, 0.5), "place of each bend sensor as a fraction of its link's length (its ends do not bend)",
        low=1e-6, high=0.999999, size=2)
    effort_delay: int = parameter(
        0, 'samples by which effort lags (1: a message reports the torque of the previous interval)',
        unit='samples', low=0, high=10)
    torque_convention: str = parameter(
        'joint', 'joint: torque 2 acts between link 1 and link 2 (a real arm); paper: on link 2 alone',
        choices=('joint', 'paper'))
    angle_convention: str = parameter(
        'encoder', 'encoder: root slopes, joint 2 relative to the tip of link 1; chord: absolute chords',
        choices=('encoder', 'chord'))

    def __post_init__(self) -> None:
        check_all(self)
