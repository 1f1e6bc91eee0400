"""Parameters of the live page (node ``live_view``)."""

from __future__ import annotations

from dataclasses import dataclass, field

from flexmanip_ros.errors import ParameterError
from flexmanip_ros.parameters.arm import ArmParameters
from flexmanip_ros.parameters.field import check_all, parameter
from flexmanip_ros.parameters.identifier import check_signals, fit_signals

WINDOWS = (5, 10, 30)
"""Lengths of time that the page can show [s]."""
PORT = 8765


@dataclass(frozen=True)
class ViewParameters:
    """What the live page shows and where. Signals and arm have the names that they have for the identifier."""

    port: int = parameter(PORT, 'port of the page on this machine; 0: any that is free', low=0, high=65535)
    rate: float = parameter(25.0, 'updates of the page a second', unit='Hz', low=1.0, high=60.0)
    window: int = parameter(10, 'time that the plots show at first: 5, 10 or 30', unit='s', low=5, high=30)
    exaggeration: float = parameter(
        20.0, 'factor by which the links are drawn more bent than they are, at first', low=1.0, high=100.0)
    stale_after: float = parameter(
        1.0, 'time without joint states after which the page says so in red', unit='s', low=0.1, high=60.0)
    identifier: str = parameter('rpbsid_identifier', 'name of the node whose estimates are shown')
    inputs: tuple[str, ...] = parameter(
        ('joint1/effort', 'joint2/effort'), 'torques, each NAME/FIELD of JointState')
    outputs: tuple[str, ...] = parameter(
        ('link1_bend/position', 'link2_bend/position'), 'bends, each NAME/FIELD of JointState; where one is a '
        'position, only positions are shown')
    angles: tuple[str, ...] = parameter(
        ('joint1/position', 'joint2/position'), "a joint angle a link, each NAME/FIELD of JointState; ['']: none, and "
        'no arm is drawn')
    arm: ArmParameters = field(default_factory=ArmParameters)

    def __post_init__(self) -> None:
        check_all(self)
        fit_signals(self, len(self.arm.link_length))
        if self.window not in WINDOWS:
            raise ParameterError(f"parameter 'window' is {self.window} s",
                                 f'give one of {", ".join(map(str, WINDOWS))}')
        if not self.identifier:
            raise ParameterError("parameter 'identifier' is empty", 'name the node, such as rpbsid_identifier')
        for group in ('inputs', 'outputs', 'angles'):
            check_signals(group, getattr(self, group))
