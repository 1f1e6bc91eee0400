"""Parameters of the event source (node ``capture_trigger``)."""

from __future__ import annotations

from dataclasses import dataclass, field

from flexmanip_ros.parameters.arm import ArmParameters
from flexmanip_ros.parameters.field import check_all, parameter
from flexmanip_ros.parameters.identifier import PayloadParameters, fit_signals


@dataclass(frozen=True)
class TriggerParameters:
    """When a capture or release is announced."""

    mode: str = parameter(
        'service', 'service: on request; time: at set times after the first sample; auto: when the signals show it',
        choices=('service', 'time', 'auto'))
    capture_time: float = parameter(
        3.0, 'time of the capture after the first sample (mode time); negative: no capture', unit='s', low=-1.0)
    release_time: float = parameter(
        -1.0, 'time of the release after the first sample (mode time); negative: no release', unit='s', low=-1.0)
    lead_time: float = parameter(
        0.5, 'an event at a set time is announced this long before its stamp, so that every node knows it in time',
        unit='s', low=0.0, high=10.0)
    service_delay: float = parameter(
        0.02, 'a requested event takes effect this long after the request (the time that a gripper needs)',
        unit='s', low=0.0, high=10.0, live=True)
    stale_after: float = parameter(
        1.0, 'a request is rejected when no joint_states have come for this long', unit='s', low=0.001, live=True)
    inputs: tuple[str, ...] = parameter(
        ('joint1/effort', 'joint2/effort'), 'torques, each NAME/FIELD of JointState (mode auto)')
    outputs: tuple[str, ...] = parameter(
        ('link1_bend/position', 'link2_bend/position', 'link1_bend/velocity', 'link2_bend/velocity'),
        'bends, each NAME/FIELD of JointState (mode auto)')
    angles: tuple[str, ...] = parameter(
        ('joint1/position', 'joint2/position'), 'joint angles, each NAME/FIELD of JointState (mode auto)')
    false_alarms_per_hour: float = parameter(
        0.05, 'rate of false alarms that the threshold allows where the model fits (mode auto); a lower rate delays '
        'the detection', unit='1/h', low=1e-12, high=1e4)
    detection_window: float = parameter(
        0.1, 'longest time between an event and its detection (mode auto)', unit='s', low=0.005, high=1.0)
    arm: ArmParameters = field(default_factory=ArmParameters)
    payload: PayloadParameters = field(default_factory=PayloadParameters)

    def __post_init__(self) -> None:
        check_all(self)
        fit_signals(self, len(self.arm.link_length))
