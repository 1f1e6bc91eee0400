"""Parameters of the torque source (node ``excitation``)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from flexmanip_ros.errors import ParameterError
from flexmanip_ros.parameters.arm import ArmParameters
from flexmanip_ros.parameters.field import check_all, parameter


@dataclass(frozen=True)
class ExcitationParameters:
    """Shape, amplitude and offset of each joint's torque."""

    rate: float = parameter(1000.0, 'commands a second', unit='Hz', low=1.0, high=100000.0)
    clock: str = parameter(
        'wall', 'wall: torques follow the time since activation; joint_states: the stamps since the first '
        'joint state, in step with a simulated arm that lags on a busy machine',
        choices=('wall', 'joint_states'))
    shape: str = parameter(
        'square', 'form of the torque', choices=('square', 'multisine', 'prbs', 'chirp', 'zero'))
    amplitude: tuple[float, ...] = parameter(
        (10.0, 5.0), 'peak torque of each joint', unit='N m', low=0.0, size=2, live=True)
    offset: tuple[float, ...] = parameter(
        (0.0, 0.0), 'constant torque added to each joint', unit='N m', size=2, live=True)
    period: tuple[float, ...] = parameter(
        (1.0, 0.5), 'period of each square wave', unit='s', low=1e-3, size=2)
    band: tuple[float, ...] = parameter(
        (0.5, 15.0), 'lowest and highest frequency of multisine and chirp', unit='Hz', low=1e-3, size=2)
    repeat_time: float = parameter(
        4.0, 'multisine, PRBS and chirp repeat after this time', unit='s', low=0.01, high=600.0)
    bit_time: float = parameter(0.05, 'shortest pulse of the PRBS', unit='s', low=1e-4, high=60.0)
    seed: int = parameter(1, 'seed of multisine phases and PRBS', low=0)
    allowed_angle: float = parameter(
        0.0, 'the amplitudes are scaled together so that the chords of the empty arm turn just this far '
        'within design_time; 0: amplitudes as given', unit='rad', low=0.0, high=3.0)
    design_time: float = parameter(
        6.0, 'length of the run that allowed_angle and the expected payload accuracy are for', unit='s',
        low=0.1, high=60.0)
    initial_angles: tuple[float, ...] = parameter(
        (1.0471975511965976, 0.7853981633974483), 'chord angles at which the design is made', unit='rad',
        size=2)
    payload_mass: float = parameter(
        20.0, 'payload for which the expected accuracy is told', unit='kg', low=0.0)
    snr_db: float = parameter(
        40.0, 'signal-to-noise ratio for which the expected accuracy is told', unit='dB',
        low=-20.0, high=200.0)
    arm: ArmParameters = field(default_factory=ArmParameters)

    def __post_init__(self) -> None:
        check_all(self)
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
