"""Parameters of the arm, which a user measures or looks up, and of the simulation: sensors, drives, torques, demo."""

import math
from dataclasses import dataclass, field
from typing import Any

from flexmanip_ros.errors import ParameterError
from flexmanip_ros.parameters.field import check_all, fit_links, parameter

SMALLEST = 1e-9
"""Lower bound of quantities that must be positive."""


@dataclass(frozen=True)
class ArmParameters:
    """One or two flexible links, a joint before each, a mass at the tip; symbols as in docs/notation.md."""

    link_length: tuple[float, ...] = parameter(
        (3.0, 3.0), 'length of each link; one value: an arm of one link', unit='m', low=SMALLEST, high=1e6, size=2,
        per_link=True)
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
        'component_modes', 'shapes of a bent link: component_modes, sines and the static shapes of moments at the two '
        'ends, where the torques act; sines, sines alone (the paper)',
        choices=('component_modes', 'sines'))
    modes: int = parameter(
        3, 'number of sines among the shape functions of each link (payload_method block uses order / 4 sines instead; '
        'beside the static shapes, method structured leaves out those faster than the sample rate)',
        low=1, high=12)
    shortening: bool = parameter(True, 'model the shortening of a bent link to second order (the paper: false)')
    rotor_inertia: tuple[float, ...] = parameter(
        (0.0, 0.0), "rotary inertia of each joint's rotor, times the gear ratio squared; it turns with the joint",
        unit='kg m^2', low=0.0, size=2, per_link=True)
    joint_viscous_friction: tuple[float, ...] = parameter(
        (0.0, 0.0), 'viscous friction of each joint', unit='N m s/rad', low=0.0, size=2, per_link=True)
    joint_coulomb_friction: tuple[float, ...] = parameter(
        (0.0, 0.0), 'Coulomb friction of each joint; where joint rates are measured, the identified model has '
        'the efforts less this friction as inputs, after an event less the learned one', unit='N m', low=0.0, size=2,
        per_link=True)
    torque_gain: tuple[float, ...] = parameter(
        (1.0, 1.0), 'torque of each joint over the effort that is reported', low=0.1, high=10.0, size=2, per_link=True)
    bend_gain: tuple[float, ...] = parameter(
        (1.0, 1.0), 'measured over true bend of each link', low=0.1, high=10.0, size=2, per_link=True)
    bend_offset: tuple[float, ...] = parameter(
        (0.0, 0.0), 'measured bend of each link when it is straight', unit='m', size=2, per_link=True)
    torque_delay: float = parameter(
        0.0, 'dead time between the effort in a message and the torque of all joints; sensors that are late by as much '
        'show the same', unit='s', low=0.0, high=0.2)
    torque_lag: tuple[float, ...] = parameter(
        (0.0, 0.0), 'time constant of the first-order lag with which the torque of each joint follows its effort',
        unit='s', low=0.0, high=0.1, size=2, per_link=True)
    bend_delay: float = parameter(
        0.0, 'time by which the bends in a message are older than the angles in it', unit='s', low=-0.02, high=0.02)
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
        fit_links(self, len(self.link_length), 'arm.')
        if self.base_mass and not self.base_inertia:
            raise ParameterError(f"parameter 'arm.base_mass' is {self.base_mass} kg, but 'arm.base_inertia' is 0",
                                 'give the inertia of the floating base, or arm.base_mass 0 for a fixed one')
        if self.base_mass and any(self.gravity):
            raise ParameterError("parameters 'arm.base_mass' and 'arm.gravity' are both set",
                                 'a base that floats falls freely: leave gravity out')


REFERENCE_ANGLES = (math.pi / 3, math.pi / 4)
"""Chord angles of the paper's reference configuration [rad]: 60 and 45 degrees."""


@dataclass(frozen=True)
class SensorParameters:
    """Measurement errors other than noise; all are off by default."""

    encoder_resolution: float = parameter(
        0.0, 'joint angles are rounded to multiples of this; 0: no rounding', unit='rad', low=0.0, high=1.0)
    bend_resolution: float = parameter(
        0.0, 'deflections are rounded to multiples of this; 0: no rounding', unit='m', low=0.0, high=1.0)
    bias: tuple[float, ...] = parameter(
        (0.0,) * 8, 'constant error of the angles, then bends, then of their rates', unit='rad, m, rad/s, m/s', size=8,
        per_link=True)
    strain_cutoff: float = parameter(
        0.0, "corner frequency of the strain gauges' first-order low-pass, on deflections and their rates; 0: none",
        unit='Hz', low=0.0, high=1e6)
    stamp_jitter: float = parameter(
        0.0, 'standard deviation of a stamp around its true instant (limited to three deviations)', unit='s',
        low=0.0, high=1.0)
    drop_probability: float = parameter(0.0, 'share of the samples that never arrive', low=0.0, high=0.99)

    def __post_init__(self) -> None:
        check_all(self)


@dataclass(frozen=True)
class ActuatorParameters:
    """Limits of the drives; all are off by default."""

    torque_limit: tuple[float, ...] = parameter(
        (0.0, 0.0), 'largest torque of each joint; 0: no limit', unit='N m', low=0.0, size=2, per_link=True)
    command_delay: int = parameter(
        0, 'number of samples between a command and its torque', unit='samples', low=0, high=100)

    def __post_init__(self) -> None:
        check_all(self)


@dataclass(frozen=True)
class PlantParameters:
    """The simulated arm (node ``plant_simulator``, program ``simulate_bag``): start, object, measurement."""

    rate: float = parameter(1000.0, 'samples a second', unit='Hz', low=1.0, high=100000.0)
    initial_angles: tuple[float, ...] = parameter(
        REFERENCE_ANGLES, 'chord angles theta at the start', unit='rad', size=2, per_link=True)
    model: str = parameter(
        'nonlinear', 'nonlinear: assumed modes; linear: the same, linearized at the initial angles, without shortening '
        '(the paper); finite_element: Hermite beams at the initial angles',
        choices=('nonlinear', 'linear', 'finite_element'))
    elements: int = parameter(10, 'number of finite elements of each link (model finite_element)', low=2, high=60)
    locked: bool = parameter(False, 'hold both joints at their initial angles (encoder angles, or chords)')
    substeps: int = parameter(
        0, 'number of integration steps in a sample; 0: as many as the fastest mode needs', low=0, high=1000)
    payload_mass: float = parameter(
        20.0, 'mass of the object that a capture event attaches', unit='kg', low=0.0, high=1e9, live=True)
    payload_inertia: float = parameter(
        0.0, "rotary inertia of the object about its centre of mass", unit='kg m^2', low=0.0, high=1e12, live=True)
    payload_com: tuple[float, ...] = parameter(
        (0.0, 0.0), "centre of mass of the object seen from the tip: along the tip tangent, and to its left",
        unit='m', low=-1e3, high=1e3, size=2, live=True)
    object_velocity: tuple[float, ...] = parameter(
        (0.0, 0.0), 'velocity x, y of the object before the capture', unit='m/s', low=-1e6, high=1e6, size=2,
        live=True)
    object_spin: float = parameter(
        0.0, 'angular rate of the object before the capture', unit='rad/s', low=-1e6, high=1e6, live=True)
    capture_impact: str = parameter(
        'momentum', 'momentum: momentum is conserved and rates jump; continuous: rates stay as they were (the paper)',
        choices=('momentum', 'continuous'))
    gripper_ramp: float = parameter(
        0.0, 'time in which a soft gripper takes the object; 0: at once', unit='s', low=0.0, high=60.0)
    noise: str = parameter(
        'snr', 'measurement noise: none; snr, from snr_db; std, from noise_std', choices=('none', 'snr', 'std'))
    snr_db: float = parameter(40.0, 'signal-to-noise ratio of every output', unit='dB', low=-20.0, high=200.0)
    rehearsal_torque: tuple[float, ...] = parameter(
        (10.0, 5.0), "peak torque of the paper's square waves, simulated before a live run to learn the signal levels "
        'that snr_db refers to (noise snr)', unit='N m', low=0.0, size=2, per_link=True)
    noise_std: tuple[float, ...] = parameter(
        (1e-5, 1e-5, 1e-5, 1e-5, 1e-3, 1e-3, 1e-3, 1e-3),
        'standard deviation of the angles, then bends, then of their rates (noise std)', unit='rad, m, rad/s, m/s',
        low=0.0, size=8, per_link=True)
    seed: int = parameter(1, 'seed of the noise', low=0)
    sensors: SensorParameters = field(default_factory=SensorParameters)
    actuators: ActuatorParameters = field(default_factory=ActuatorParameters)
    arm: ArmParameters = field(default_factory=ArmParameters)

    def __post_init__(self) -> None:
        check_all(self)
        for group, name in ((self, ''), (self.sensors, 'sensors.'), (self.actuators, 'actuators.')):
            fit_links(group, len(self.arm.link_length), name)
        if self.arm.bend_delay < 0.0:
            raise ParameterError(f"parameter 'arm.bend_delay' is {self.arm.bend_delay} s",
                                 'a simulated arm shows bends late or in time: give 0 or more')
        if self.sensors.stamp_jitter * self.rate > 0.15:  # three standard deviations stay below half a sample time
            raise ParameterError(
                f"parameter 'sensors.stamp_jitter' is {self.sensors.stamp_jitter} s, so that stamps change places",
                f'stay below {0.15 / self.rate:g} s at {self.rate:g} Hz')


@dataclass(frozen=True)
class ExcitationParameters:
    """The torque source (node ``excitation``): shape, amplitude and offset of each joint's torque."""

    rate: float = parameter(1000.0, 'commands a second', unit='Hz', low=1.0, high=100000.0)
    clock: str = parameter(
        'wall', 'wall: the torque follows the time since activation; joint_states: it follows the stamps since the '
        'first joint state, and so stays in step with a simulated arm that lags on a busy machine',
        choices=('wall', 'joint_states'))
    shape: str = parameter(
        'square', 'form of the torque over time', choices=('square', 'multisine', 'prbs', 'chirp', 'zero'))
    amplitude: tuple[float, ...] = parameter(
        (10.0, 5.0), 'peak torque of each joint', unit='N m', low=0.0, high=1e9, size=2, per_link=True, live=True)
    offset: tuple[float, ...] = parameter(
        (0.0, 0.0), 'constant torque added to each joint', unit='N m', low=-1e9, high=1e9, size=2, per_link=True,
        live=True)
    period: tuple[float, ...] = parameter(
        (1.0, 0.5), 'period of each square wave', unit='s', low=1e-3, size=2, per_link=True)
    band: tuple[float, ...] = parameter(
        (0.5, 15.0), 'lowest and highest frequency of multisine and chirp', unit='Hz', low=1e-3, size=2)
    repeat_time: float = parameter(
        4.0, 'period after which multisine, PRBS and chirp repeat', unit='s', low=0.01, high=600.0)
    bit_time: float = parameter(0.05, 'shortest pulse of the PRBS', unit='s', low=1e-4, high=60.0)
    seed: int = parameter(1, 'seed of the multisine phases and of the PRBS', low=0)
    allowed_angle: float = parameter(
        0.0, 'both amplitudes are scaled by one factor so that the chords of the empty arm turn this far '
        'within design_time; 0: no scaling', unit='rad', low=0.0, high=3.0)
    design_time: float = parameter(
        6.0, 'length of the run for which allowed_angle and the expected payload accuracy hold', unit='s',
        low=0.1, high=60.0)
    initial_angles: tuple[float, ...] = parameter(
        REFERENCE_ANGLES, 'chord angles at which the torque is designed', unit='rad', size=2, per_link=True)
    payload_mass: float = parameter(20.0, 'payload for which the expected accuracy is computed', unit='kg', low=0.0)
    snr_db: float = parameter(
        40.0, 'signal-to-noise ratio for which the expected accuracy is computed', unit='dB', low=-20.0, high=200.0)
    arm: ArmParameters = field(default_factory=ArmParameters)

    def __post_init__(self) -> None:
        check_all(self)
        fit_links(self, len(self.arm.link_length))
        low, high = self.band
        if not low < high:
            raise ParameterError(f"parameter 'band' is {low} to {high} Hz", 'give the lower frequency first')
        if self.shape in ('multisine', 'chirp') and high > self.rate / 2:
            raise ParameterError(
                f"parameter 'band' reaches {high} Hz", f'stay below half the rate ({self.rate / 2} Hz)')
        if self.shape == 'multisine' and int(high * self.repeat_time) < math.ceil(low * self.repeat_time):
            raise ParameterError(
                f"parameter 'band' holds no harmonic of 1 / repeat_time ({1 / self.repeat_time:g} Hz)",
                'widen the band or lengthen repeat_time')
        shortest, pulses = min(self.period), self.repeat_time / self.bit_time
        if self.shape == 'square' and shortest * self.rate < 2.0:
            raise ParameterError(f"parameter 'period' is {shortest:g} s, less than two commands at {self.rate:g} Hz",
                                 f'give at least {2.0 / self.rate:g} s, or raise the rate')
        if self.shape == 'prbs' and (self.bit_time * self.rate < 1.0 or pulses < 2.0):
            raise ParameterError(
                f"parameter 'bit_time' is {self.bit_time:g} s" + (
                    f', and repeat_time holds {pulses:g} pulses' if pulses < 2.0 else
                    f', less than one command at {self.rate:g} Hz'),
                f'give {1.0 / self.rate:g} s to half of repeat_time ({0.5 * self.repeat_time:g} s)')


@dataclass(frozen=True)
class DemoParameters:
    """The demonstration (program ``demo``): how long it runs, how fast, what is caught and when."""

    duration: float = parameter(6.0, 'length of the run', unit='s', low=0.5, high=3600.0)
    rate: float = parameter(1000.0, 'samples a second', unit='Hz', low=100.0, high=10000.0)
    payload_mass: float = parameter(20.0, 'mass of the object', unit='kg', low=0.0, high=1000.0)
    capture_time: float = parameter(
        3.0, 'time of the capture after the first sample; negative: no capture', unit='s', low=-1.0)
    release_time: float = parameter(
        -1.0, 'time of the release after the first sample; negative: no release', unit='s', low=-1.0)
    snr_db: float = parameter(40.0, 'signal-to-noise ratio of every output', unit='dB', low=-20.0, high=200.0)
    seed: int = parameter(1, 'seed of the noise', low=0)
    view: bool = parameter(False, 'show the run live in a browser (node live_view)')

    def __post_init__(self) -> None:
        check_all(self)
        for name in ('capture_time', 'release_time'):
            if getattr(self, name) >= self.duration:
                raise ParameterError(
                    f"parameter '{name}' is {getattr(self, name):g} s",
                    f'it must come before the end of the run ({self.duration:g} s)')
        check_order(self)


def check_order(config: Any) -> None:
    """Raise ParameterError where a release is set before its capture, or at the same time."""
    if 0.0 <= config.release_time <= config.capture_time:
        raise ParameterError(f"parameter 'release_time' is {config.release_time:g} s",
                             f'it must come after the capture ({config.capture_time:g} s); capture_time -1: none')


def settings(config: DemoParameters) -> dict[str, dict[str, Any]]:
    """Return the parameters of each node of the demonstration that differ from their defaults."""
    return {
        'plant_simulator': {'rate': config.rate, 'payload_mass': config.payload_mass, 'snr_db': config.snr_db,
                            'seed': config.seed},
        'excitation': {'rate': config.rate, 'clock': 'joint_states'},
        'capture_trigger': {'mode': 'time', 'capture_time': config.capture_time, 'release_time': config.release_time},
    }
