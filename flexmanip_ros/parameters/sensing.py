"""Parameters of imperfect sensors and actuators; everything is off by default."""

from __future__ import annotations

from dataclasses import dataclass

from flexmanip_ros.parameters.field import check_all, parameter


@dataclass(frozen=True)
class SensorParameters:
    """What the measurement does to the signals, beside noise."""

    encoder_resolution: float = parameter(
        0.0, 'joint angles are rounded to multiples of this; 0: not at all', unit='rad', low=0.0, high=1.0)
    bend_resolution: float = parameter(
        0.0, 'deflections are rounded to multiples of this; 0: not at all', unit='m', low=0.0, high=1.0)
    bias: tuple[float, ...] = parameter(
        (0.0,) * 8, 'constant error of the four positions, then the four rates', unit='rad, m, rad/s, m/s',
        size=8)
    strain_cutoff: float = parameter(
        0.0, "corner of the strain gauges' first-order low-pass, on deflections and their rates; 0: none",
        unit='Hz', low=0.0, high=1e6)
    stamp_jitter: float = parameter(
        0.0, 'standard deviation of the stamps around the instants they stand for (cut at three)', unit='s',
        low=0.0, high=1.0)
    drop_probability: float = parameter(
        0.0, 'share of the samples that never arrive', low=0.0, high=0.99)

    def __post_init__(self) -> None:
        check_all(self)


@dataclass(frozen=True)
class ActuatorParameters:
    """What the drives do to the commands."""

    torque_limit: tuple[float, ...] = parameter(
        (0.0, 0.0), 'largest torque of each joint; 0: no limit', unit='N m', low=0.0, size=2)
    command_delay: int = parameter(
        0, 'samples between a command and its torque', unit='samples', low=0, high=100)

    def __post_init__(self) -> None:
        check_all(self)
