"""Parameters of the payload estimators (group ``payload`` of the identifier)."""

from __future__ import annotations

from dataclasses import dataclass

from flexmanip_ros.errors import ParameterError
from flexmanip_ros.parameters.field import check_all, parameter


@dataclass(frozen=True)
class PayloadParameters:
    """What is known beforehand of the arm and of the object, and how the payload is read from it."""

    known_coupling: bool = parameter(
        False, '`block`: use the coupling M_b of the arm model instead of identifying it (2-8 times tighter)')

    dynamics: str = parameter(
        'nonlinear', '`structured`: nonlinear, follows the moving configuration; linear, keeps the first',
        choices=('nonlinear', 'linear'))
    working_point: tuple[float, ...] = parameter(
        (), "chord angles at which dynamics 'linear' stays; [] for the measured ones", unit='rad')
    stiffness_std: float = parameter(
        0.03, 'relative standard deviation of the bending stiffnesses, learned from the empty arm', low=0.0,
        high=1.0)
    damping_std: float = parameter(
        0.005, 'standard deviation of the damping ratio, learned from the empty arm', low=0.0, high=1.0)
    capture_speed: float = parameter(
        0.3, 'how fast an object may move against the tip when it is caught', unit='m/s', low=0.0, high=100.0)
    model_error: float = parameter(
        0.003, "relative error of the arm's inertia to reckon with where a sensor shows more than its noise, "
        'and half of it where the arm shows modes beyond `arm.modes`',
        low=0.0, high=1.0)
    rotary_inertia: bool = parameter(
        False, "`structured`: estimate the object's rotary inertia as well, where the signals tell it")
    gravity: float = parameter(
        0.0, 'along -y, for the algebraic method alone; the paper runs it with 9.81', unit='m/s^2', low=0.0)
    memory_time: float = parameter(
        20.0, 'how long old samples count', unit='s', low=0.1, high=1e6)

    def __post_init__(self) -> None:
        check_all(self)
        if len(self.working_point) not in (0, 2):
            raise ParameterError(
                f"parameter 'working_point' has {len(self.working_point)} elements",
                'give two angles, or [] for the measured ones')
