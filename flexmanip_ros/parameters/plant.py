"""Parameters of the simulated arm (node ``plant_simulator``, program ``simulate_bag``)."""

from __future__ import annotations

from dataclasses import dataclass, field

from flexmanip_ros.parameters.arm import ArmParameters
from flexmanip_ros.parameters.field import check_all, parameter


@dataclass(frozen=True)
class PlantParameters:
    """The arm, where it starts, what it will catch and how it is measured."""

    rate: float = parameter(1000.0, 'samples a second', unit='Hz', low=1.0, high=100000.0)
    initial_angles: tuple[float, ...] = parameter(
        (1.0471975511965976, 0.7853981633974483), 'chord angles theta at the start', unit='rad', size=2)
    payload_mass: float = parameter(
        20.0, 'mass of the object taken at a capture event', unit='kg', low=0.0, live=True)
    capture_impact: str = parameter(
        'momentum', 'momentum: conserved, rates jump; continuous: rates stay (the paper)',
        choices=('momentum', 'continuous'))
    noise: str = parameter('snr', 'measurement noise', choices=('none', 'snr', 'std'))
    snr_db: float = parameter(40.0, 'signal-to-noise ratio of every output', unit='dB', low=-20.0, high=200.0)
    noise_std: tuple[float, ...] = parameter(
        (1e-5, 1e-5, 1e-5, 1e-5, 1e-3, 1e-3, 1e-3, 1e-3),
        'standard deviation of the four positions, then the four rates', unit='rad, m, rad/s, m/s', low=0.0, size=8)
    seed: int = parameter(1, 'seed of the noise', low=0)
    arm: ArmParameters = field(default_factory=ArmParameters)

    def __post_init__(self) -> None:
        check_all(self)
