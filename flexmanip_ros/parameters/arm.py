"""The arm: what a user measures or looks up before anything is identified."""

from __future__ import annotations

from dataclasses import dataclass

from flexmanip_ros.errors import ParameterError
from flexmanip_ros.parameters.field import check_all, fit_links, parameter

SMALLEST = 1e-9
"""Lower bound of quantities that must be positive."""


@dataclass(frozen=True)
class ArmParameters:
    """One or two flexible links, a joint before each, a mass at the tip; symbols as in docs/notation.md."""

    link_length: tuple[float, ...] = parameter(
        (3.0, 3.0), 'length of each link; one value: an arm of one link', unit='m', low=SMALLEST, size=2, per_link=True)
    linear_density: tuple[float, ...] = parameter(
        (5.0, 5.0), 'mass per length of each link', unit='kg/m', low=SMALLEST, size=2, per_link=True)
    bending_stiffness: tuple[float, ...] = parameter(
        (5000.0, 5000.0), "Young's modulus times second moment of area of each link", unit='N m^2',
        low=SMALLEST, size=2, per_link=True)
    joint_mass: float = parameter(10.0, 'mass at the end of link 1, where joint 2 is', unit='kg', low=SMALLEST)
    tip_mass: float = parameter(10.0, 'mass at the end of the last link before a capture', unit='kg', low=SMALLEST)
    hub_inertia: tuple[float, ...] = parameter(
        (0.0, 0.0), "rotary inertia of each joint's hub, which turns with the root of its link", unit='kg m^2',
        low=0.0, size=2, per_link=True)
    joint_inertia: float = parameter(
        0.0, 'rotary inertia of the mass at the end of link 1, which turns with that end', unit='kg m^2', low=0.0)
    tip_inertia: float = parameter(
        0.0, 'rotary inertia of the tip mass, which turns with the end of the last link', unit='kg m^2', low=0.0)
    damping_ratio: float = parameter(0.0, "damping ratio of each link's first pinned mode", low=0.0, high=0.99)
    damping_model: str = parameter(
        'stiffness', 'damping ratio of the higher modes: stiffness, grows with the frequency; modal, the same for '
        'every mode', choices=('stiffness', 'modal'))
    shape_functions: str = parameter(
        'component_modes', 'shapes of a bent link: component_modes, sines and the two static shapes of end moments, '
        'which joint torques bend; sines, sines alone (the paper)', choices=('component_modes', 'sines'))
    modes: int = parameter(
        3, 'number of sines among the shape functions of each link (payload_method block uses order / 4 sines instead)',
        low=1, high=12)
    shortening: bool = parameter(True, 'model the shortening of a bent link to second order (the paper: false)')
    rotor_inertia: tuple[float, ...] = parameter(
        (0.0, 0.0), "rotary inertia of each joint's rotor, times the gear ratio squared; it turns with the joint",
        unit='kg m^2', low=0.0, size=2, per_link=True)
    joint_viscous_friction: tuple[float, ...] = parameter(
        (0.0, 0.0), 'viscous friction of each joint', unit='N m s/rad', low=0.0, size=2, per_link=True)
    joint_coulomb_friction: tuple[float, ...] = parameter(
        (0.0, 0.0), 'Coulomb friction of each joint', unit='N m', low=0.0, size=2, per_link=True)
    torque_gain: tuple[float, ...] = parameter(
        (1.0, 1.0), 'torque of each joint over the effort that is reported', low=0.1, high=10.0, size=2, per_link=True)
    bend_gain: tuple[float, ...] = parameter(
        (1.0, 1.0), 'measured over true bend of each link', low=0.1, high=10.0, size=2, per_link=True)
    bend_offset: tuple[float, ...] = parameter(
        (0.0, 0.0), 'measured bend of each link when it is straight', unit='m', size=2, per_link=True)
    gravity: tuple[float, ...] = parameter(
        (0.0, 0.0), 'gravity along x and y; (0, -9.81): the arm moves in a vertical plane', unit='m/s^2', size=2)
    base_mass: float = parameter(
        0.0, 'mass of a base that floats freely; 0: the base is fixed', unit='kg', low=0.0)
    base_inertia: float = parameter(
        0.0, 'rotary inertia of a floating base about its centre of mass', unit='kg m^2', low=0.0)
    base_joint_offset: tuple[float, ...] = parameter(
        (0.0, 0.0), 'place of joint 1 from the centre of mass of a floating base, in its frame', unit='m', size=2)
    sensor_position: tuple[float, ...] = parameter(
        (0.5, 0.5), "position of each bend sensor as a fraction of its link's length (the ends do not bend)",
        low=1e-6, high=0.999999, size=2, per_link=True)
    effort_delay: int = parameter(
        0, 'number of samples by which effort lags; 1: a message reports the torque of the interval before it',
        unit='samples', low=0, high=10)
    torque_convention: str = parameter(
        'joint', 'joint: torque 2 acts between link 1 and link 2, as a motor does; paper: it acts on link 2 alone',
        choices=('joint', 'paper'))
    angle_convention: str = parameter(
        'encoder', 'encoder: angles are root slopes, joint 2 relative to the tip of link 1; chord: angles are absolute '
        'chord angles', choices=('encoder', 'chord'))

    def __post_init__(self) -> None:
        check_all(self)
        fit_links(self, len(self.link_length))
        if self.base_mass and not self.base_inertia:
            raise ParameterError(f"parameter 'base_mass' is {self.base_mass} kg, but 'base_inertia' is 0",
                                 'give the inertia of the floating base, or base_mass 0 for a fixed one')
        if self.base_mass and any(self.gravity):
            raise ParameterError("parameters 'base_mass' and 'gravity' are both set",
                                 'a base that floats falls freely: leave gravity out')
