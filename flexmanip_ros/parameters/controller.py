"""Parameters of the example controller (node ``payload_controller``)."""

from __future__ import annotations

from dataclasses import dataclass, field

from flexmanip_ros.errors import ParameterError
from flexmanip_ros.parameters.arm import ArmParameters
from flexmanip_ros.parameters.field import check_all, parameter


@dataclass(frozen=True)
class ControllerParameters:
    """Joint hold and vibration damping, rescheduled on the payload and the configuration."""

    joints: tuple[str, ...] = parameter(('joint1', 'joint2'), 'names of the two joints', size=2)
    bends: tuple[str, ...] = parameter(
        ('link1_bend', 'link2_bend'), 'names of the two bend sensors, deflection and rate', size=2)
    hold_present: bool = parameter(
        True, 'hold the angles of the first sample after activation; false: go to setpoint')
    setpoint: tuple[float, ...] = parameter(
        (0.0, 0.0), 'angles to hold, as the encoders read them; setting it ends hold_present', unit='rad',
        size=2, live=True)
    setpoint_rate: float = parameter(
        0.2, 'the held angles move to a new setpoint no faster than this', unit='rad/s', low=1e-3, high=100.0,
        live=True)
    move_bend: float = parameter(
        0.01, 'bend that a move to a new setpoint may take at the sensors; a heavier arm moves more slowly',
        unit='m', low=1e-6, high=10.0, live=True)
    move_effort: float = parameter(
        0.5, 'fraction of effort_limit that a move to a new setpoint may take', low=0.01, high=1.0, live=True)
    angle_scale: float = parameter(
        0.01, 'an angle error that costs as much as effort_scale (larger: softer)', unit='rad', low=1e-6)
    bend_scale: float = parameter(
        0.02, 'a bending that costs as much as effort_scale (larger: less damping of vibration)', unit='m',
        low=1e-7)
    effort_scale: tuple[float, ...] = parameter(
        (100.0, 50.0), 'torque that is cheap to use', unit='N m', low=1e-6, size=2)
    effort_limit: tuple[float, ...] = parameter(
        (300.0, 150.0), 'torques are cut to this, whatever is asked for', unit='N m', low=0.0, size=2,
        live=True)
    noise_std: tuple[float, ...] = parameter(
        (3e-3, 3e-3, 3e-4, 3e-4, 0.2, 0.2, 0.02, 0.02),
        'how little the angles, the bends, then their rates are trusted (larger: slower filter, which real '
        'modes beyond the modelled ones disturb less)', unit='rad, m, rad/s, m/s', low=1e-12,
        size=8)
    disturbance_std: tuple[float, ...] = parameter(
        (1.0, 1.0), 'torque that acts beside the commanded one, white from sample to sample', unit='N m',
        low=1e-9, size=2)
    rate: float = parameter(1000.0, 'joint states a second', unit='Hz', low=10.0, high=100000.0)
    use_estimate: bool = parameter(True, 'schedule on the estimated payload', live=True)
    initial_payload: float = parameter(0.0, 'payload before any estimate is trusted', unit='kg', low=0.0)
    max_payload: float = parameter(
        200.0, 'estimates above this are not believed', unit='kg', low=0.0, live=True)
    max_interval: float = parameter(
        0.2, 'widest trusted half of the 95 % interval, as a fraction of tip mass plus payload', low=0.0,
        high=10.0, live=True)
    max_consistency: float = parameter(
        4.0, 'largest trusted residual power of an estimate (1: noise only)', low=0.0, live=True)
    payload_rate: float = parameter(
        100.0, 'the scheduled payload follows a trusted estimate no faster than this', unit='kg/s', low=0.01,
        high=1e6, live=True)
    reschedule_mass: float = parameter(
        0.02, 'new gains after a change by this fraction of tip mass plus payload', low=1e-4, high=1.0)
    reschedule_angle: float = parameter(
        0.05, 'new gains after the angle between the links changed by this', unit='rad', low=1e-3, high=3.0)
    blend_time: float = parameter(
        0.1, 'new gains take over from the old ones within this time', unit='s', low=0.0, high=10.0)
    stale_after: float = parameter(
        0.1, 'without joint states or added efforts for this long, they count as zero', unit='s', low=0.005,
        high=10.0)
    arm: ArmParameters = field(default_factory=ArmParameters)

    def __post_init__(self) -> None:
        check_all(self)
        if len({*self.joints, *self.bends}) != 4:
            raise ParameterError("parameters 'joints' and 'bends' name a signal twice", 'name each once')
        for fraction in self.arm.sensor_position:
            if not 0.05 <= fraction <= 0.95:
                raise ParameterError(
                    f"parameter 'arm.sensor_position' is {fraction:g}",
                    'bend sensors so near an end of their link cannot be used; choose 0.05 to 0.95')
