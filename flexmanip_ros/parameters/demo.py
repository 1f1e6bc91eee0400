"""Parameters of the demonstration (program ``demo``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from flexmanip_ros.errors import ParameterError
from flexmanip_ros.parameters.field import check_all, parameter


@dataclass(frozen=True)
class DemoParameters:
    """What is shown: how long, how fast, what is caught and when."""

    duration: float = parameter(6.0, 'length of the run', unit='s', low=0.5, high=3600.0)
    rate: float = parameter(1000.0, 'samples a second', unit='Hz', low=100.0, high=10000.0)
    payload_mass: float = parameter(20.0, 'mass of the object', unit='kg', low=0.0, high=1000.0)
    capture_time: float = parameter(
        3.0, 'capture after the first sample; negative: never', unit='s', low=-1.0)
    release_time: float = parameter(
        -1.0, 'release after the first sample; negative: never', unit='s', low=-1.0)
    snr_db: float = parameter(40.0, 'signal-to-noise ratio of every output', unit='dB', low=-20.0, high=200.0)
    seed: int = parameter(1, 'seed of the noise', low=0)

    def __post_init__(self) -> None:
        check_all(self)
        for name in ('capture_time', 'release_time'):
            if getattr(self, name) >= self.duration:
                raise ParameterError(
                    f"parameter '{name}' is {getattr(self, name):g} s",
                    f'it must come before the end of the run ({self.duration:g} s)')


def settings(config: DemoParameters) -> dict[str, dict[str, Any]]:
    """Return the parameters of each node of the demonstration that differ from their defaults."""
    return {
        'plant_simulator': {'rate': config.rate, 'payload_mass': config.payload_mass,
                            'snr_db': config.snr_db, 'seed': config.seed},
        'excitation': {'rate': config.rate, 'clock': 'joint_states'},
        'capture_trigger': {'mode': 'time', 'capture_time': config.capture_time,
                            'release_time': config.release_time},
    }
