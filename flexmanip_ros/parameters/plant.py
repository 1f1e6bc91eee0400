"""Parameters of the simulated arm (node ``plant_simulator``, program ``simulate_bag``)."""

from __future__ import annotations

from dataclasses import dataclass, field

from flexmanip_ros.errors import ParameterError
from flexmanip_ros.parameters.arm import ArmParameters
from flexmanip_ros.parameters.field import check_all, parameter
from flexmanip_ros.parameters.sensing import ActuatorParameters, SensorParameters


@dataclass(frozen=True)
class PlantParameters:
    """The arm, where it starts, what it will catch and how it is measured."""

    rate: float = parameter(1000.0, 'samples a second', unit='Hz', low=1.0, high=100000.0)
    initial_angles: tuple[float, ...] = parameter(
        (1.0471975511965976, 0.7853981633974483), 'chord angles theta at the start', unit='rad', size=2)
    model: str = parameter(
        'nonlinear', 'nonlinear: assumed modes; linear: the same at the initial angles, without shortening '
        'and slope correction (the paper); finite_element: Hermite beams at the initial angles',
        choices=('nonlinear', 'linear', 'finite_element'))
    tail_modes: int = parameter(
        0, 'further modes of each link that ring along without back-effect (model nonlinear with '
        'arm.slope_correction): encoder angles and rates right at few modes', low=0, high=20)
    elements: int = parameter(10, 'finite elements of each link (model finite_element)', low=2, high=60)
    locked: bool = parameter(False, 'hold both joints (encoder angles, or chords) at their initial angles')
    substeps: int = parameter(
        0, 'integration steps a sample; 0: as many as the fastest mode needs', low=0, high=1000)
    payload_mass: float = parameter(
        20.0, 'mass of the object taken at a capture event', unit='kg', low=0.0, live=True)
    payload_inertia: float = parameter(
        0.0, "the object's rotary inertia about its centre of mass", unit='kg m^2', low=0.0, live=True)
    payload_com: tuple[float, ...] = parameter(
        (0.0, 0.0), "the object's centre of mass from the tip: along the tip tangent, and to its left",
        unit='m', size=2, live=True)
    object_velocity: tuple[float, ...] = parameter(
        (0.0, 0.0), 'velocity x, y of the object before the capture', unit='m/s', size=2, live=True)
    object_spin: float = parameter(
        0.0, 'angular rate of the object before the capture', unit='rad/s', live=True)
    capture_impact: str = parameter(
        'momentum', 'momentum: conserved, rates jump; continuous: rates stay (the paper)',
        choices=('momentum', 'continuous'))
    gripper_ramp: float = parameter(
        0.0, 'a soft gripper takes the object over this time; 0: at once', unit='s', low=0.0, high=60.0)
    noise: str = parameter('snr', 'measurement noise', choices=('none', 'snr', 'std'))
    snr_db: float = parameter(40.0, 'signal-to-noise ratio of every output', unit='dB', low=-20.0, high=200.0)
    rehearsal_torque: tuple[float, ...] = parameter(
        (10.0, 5.0), "peak torque of the paper's square waves in the rehearsal that tells a live plant its "
        'signal levels (noise snr)', unit='N m', low=0.0, size=2)
    noise_std: tuple[float, ...] = parameter(
        (1e-5, 1e-5, 1e-5, 1e-5, 1e-3, 1e-3, 1e-3, 1e-3),
        'standard deviation of the four positions, then the four rates', unit='rad, m, rad/s, m/s',
        low=0.0, size=8)
    seed: int = parameter(1, 'seed of the noise', low=0)
    sensors: SensorParameters = field(default_factory=SensorParameters)
    actuators: ActuatorParameters = field(default_factory=ActuatorParameters)
    arm: ArmParameters = field(default_factory=ArmParameters)

    def __post_init__(self) -> None:
        check_all(self)
        if self.sensors.stamp_jitter * self.rate > 0.15:
            raise ParameterError(
                f"parameter 'sensors.stamp_jitter' is {self.sensors.stamp_jitter} s",
                f'stamps would change places; stay below {0.15 / self.rate:g} s at {self.rate:g} Hz')
