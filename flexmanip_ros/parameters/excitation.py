"""Parameters of the torque source (node ``excitation``)."""

from __future__ import annotations

from dataclasses import dataclass

from flexmanip_ros.parameters.field import check_all, parameter


@dataclass(frozen=True)
class ExcitationParameters:
    """Shape, amplitude and offset of each joint's torque."""

    rate: float = parameter(1000.0, 'commands a second', unit='Hz', low=1.0, high=100000.0)
    shape: str = parameter(
        'square', 'form of the torque', choices=('square', 'multisine', 'prbs', 'chirp', 'zero'))
    amplitude: tuple[float, ...] = parameter(
        (10.0, 5.0), 'peak torque of each joint', unit='N m', low=0.0, size=2, live=True)
    offset: tuple[float, ...] = parameter(
        (0.0, 0.0), 'constant torque added to each joint', unit='N m', size=2, live=True)
    period: tuple[float, ...] = parameter(
        (1.0, 0.5), 'period of each square wave', unit='s', low=1e-3, size=2)
    seed: int = parameter(1, 'seed of multisine phases and PRBS', low=0)

    def __post_init__(self) -> None:
        check_all(self)
