"""Parameters of the nodes around the identifier: controller, payload adapter, capture trigger and live page."""

import math
from dataclasses import dataclass, field

from flexmanip_ros.errors import ParameterError
from flexmanip_ros.parameters.arm import ArmParameters, check_order
from flexmanip_ros.parameters.field import check_all, fit_links, parameter
from flexmanip_ros.parameters.identifier import PayloadParameters, fit_signals

LARGEST_SETPOINT = round(4.0 * math.pi, 2)
"""Largest setpoint [rad]: two turns, which joints seldom exceed, but angles in degrees and encoder counts do."""


@dataclass(frozen=True)
class ControllerParameters:
    """Joint hold and vibration damping, scheduled on payload and configuration (node ``payload_controller``)."""

    joints: tuple[str, ...] = parameter(('joint1', 'joint2'), 'names of the joints', size=2, per_link=True)
    bends: tuple[str, ...] = parameter(
        ('link1_bend', 'link2_bend'), 'names of the bend sensors (deflection and rate)', size=2, per_link=True)
    hold_present: bool = parameter(
        True, 'true: hold the angles of the first sample after activation; false: move to setpoint')
    setpoint: tuple[float, ...] = parameter(
        (0.0, 0.0), 'encoder angles to hold; setting them ends hold_present', unit='rad', low=-LARGEST_SETPOINT,
        high=LARGEST_SETPOINT, size=2, per_link=True, live=True)
    setpoint_rate: float = parameter(
        0.2, 'largest rate of the held angles while they move to a new setpoint', unit='rad/s', low=1e-3, high=100.0,
        live=True)
    move_bend: float = parameter(
        0.01, 'largest bend at the sensors that a move to a new setpoint may need; a heavier arm moves more slowly',
        unit='m', low=1e-6, high=10.0, live=True)
    move_effort: float = parameter(
        0.5, 'fraction of effort_limit that a move to a new setpoint may need', low=0.01, high=1.0, live=True)
    angle_scale: float = parameter(
        0.01, 'angle error that costs as much as a torque of effort_scale (larger: softer)', unit='rad', low=1e-6)
    bend_scale: float = parameter(
        0.02, 'bend that costs as much as a torque of effort_scale (larger: less damping of vibration)', unit='m',
        low=1e-7)
    effort_scale: tuple[float, ...] = parameter(
        (100.0, 50.0), 'torque that costs one unit in the regulator', unit='N m', low=1e-6, size=2, per_link=True)
    effort_limit: tuple[float, ...] = parameter(
        (300.0, 150.0), 'largest torque of each joint; a larger command is cut to it; 0: a passive joint; a raised '
        'limit is reached within blend_time', unit='N m', low=0.0, size=2, per_link=True, live=True)
    noise_std: tuple[float, ...] = parameter(
        (3e-3, 3e-3, 3e-4, 3e-4, 0.2, 0.2, 0.02, 0.02),
        'measurement noise that the filter assumes for the angles, the bends, then their rates (larger: slower filter, '
        'less disturbed by modes beyond kappa)', unit='rad, m, rad/s, m/s', low=1e-12, size=8, per_link=True)
    disturbance_std: tuple[float, ...] = parameter(
        (1.0, 1.0), 'white torque disturbance that the filter assumes beside the command', unit='N m', low=1e-9, size=2,
        per_link=True)
    rate: float = parameter(1000.0, 'joint states a second', unit='Hz', low=10.0, high=100000.0)
    use_estimate: bool = parameter(True, 'schedule the gains on the estimated payload', live=True)
    initial_payload: float = parameter(0.0, 'payload before the first trusted estimate', unit='kg', low=0.0)
    max_payload: float = parameter(200.0, 'largest trusted payload estimate', unit='kg', low=0.0, live=True)
    max_interval: float = parameter(
        0.2, 'largest trusted half width of the 95 % interval, as a fraction of tip mass plus payload', low=0.0,
        high=10.0, live=True)
    max_consistency: float = parameter(
        2.0, 'largest trusted consistency: residual power of an estimate (1: noise alone; INCONSISTENT above 2)',
        low=0.0, live=True)
    payload_rate: float = parameter(
        100.0, 'largest rate at which the scheduled payload follows a trusted estimate', unit='kg/s', low=0.01,
        high=1e6, live=True)
    reschedule_mass: float = parameter(
        0.02, 'change of the payload that asks for new gains, as a fraction of tip mass plus payload', low=1e-4,
        high=1.0)
    reschedule_angle: float = parameter(
        0.05, 'change of a chord angle that the arm depends on (that between the links) that asks for new gains',
        unit='rad', low=1e-3, high=3.0)
    blend_time: float = parameter(
        0.1, 'time over which new gains replace the old ones, and a raised effort_limit is reached', unit='s', low=0.0,
        high=10.0)
    stale_after: float = parameter(
        0.1, 'time without joint states (or added efforts) after which the torque (or the added torque) is zero',
        unit='s', low=0.005, high=10.0)
    arm: ArmParameters = field(default_factory=ArmParameters)

    def __post_init__(self) -> None:
        check_all(self)
        fit_links(self, len(self.arm.link_length))
        if len({*self.joints, *self.bends}) != 2 * len(self.joints):
            raise ParameterError("parameters 'joints' and 'bends' name a signal twice", 'name each once')
        for fraction in self.arm.sensor_position:
            if not 0.05 <= fraction <= 0.95:
                raise ParameterError(
                    f"parameter 'arm.sensor_position' is {fraction:g}",
                    'bend sensors so near an end of their link cannot be used; choose 0.05 to 0.95')


@dataclass(frozen=True)
class AdapterParameters:
    """Which driver gets the payload, and which payload is trusted (node ``payload_adapter``)."""

    service: str = parameter('io_and_status_controller/set_payload', 'service of the driver that takes a payload')
    service_type: str = parameter(
        'ur_msgs/srv/SetPayload', 'type of that service; its request holds a geometry_msgs/Inertia, or a mass and, '
        'where it has places for them, centre of mass, inertia and transition time')
    transition_time: float = parameter(
        0.5, 'time over which the driver is to go from the old payload to the new one, where its request says so',
        unit='s', low=0.0, high=60.0, live=True)
    target_node: str = parameter(
        '', 'node whose parameter is set to the payload instead of calling the service; empty: none')
    mass_parameter: str = parameter('payload_mass', 'name of that parameter (a double)', unit='kg')
    max_relative_std: float = parameter(
        0.05, 'a payload is sent when its standard deviation is below this fraction of it, or below max_std',
        low=1e-6, high=1.0, live=True)
    max_std: float = parameter(
        0.2, 'standard deviation below which every payload is sent', unit='kg', low=1e-6, high=1e3, live=True)
    max_consistency: float = parameter(
        2.0, 'largest trusted consistency: residual power of an estimate (1: noise alone; INCONSISTENT above 2)',
        low=0.0, live=True)
    max_payload: float = parameter(100.0, 'largest payload that is sent', unit='kg', low=0.0, live=True)
    settle_time: float = parameter(
        0.3, 'time for which a payload must have been trusted before it is sent', unit='s', low=0.0, high=60.0,
        live=True)
    min_change: float = parameter(
        0.05, 'a payload is sent again when it changed by more than this fraction of it, and by more than max_std',
        low=0.0, high=10.0, live=True)
    min_displacement: float = parameter(
        0.02, 'a payload is sent again when its centre of mass moved, or its radius of gyration changed, by this',
        unit='m', low=0.0, high=100.0, live=True)
    min_period: float = parameter(
        1.0, 'shortest time between two requests to the driver', unit='s', low=0.01, high=3600.0)

    def __post_init__(self) -> None:
        check_all(self)
        if not self.service and not self.target_node:
            raise ParameterError("parameters 'service' and 'target_node' are both empty",
                                 'name the driver service or the node that takes the payload')
        parts = self.service_type.split('/')
        if len(parts) != 3 or parts[1] != 'srv' or not all(part.isidentifier() for part in parts):
            raise ParameterError(f"parameter 'service_type' is '{self.service_type}'",
                                 'write PACKAGE/srv/TYPE')


@dataclass(frozen=True)
class TriggerParameters:
    """When a capture or release is announced."""

    mode: str = parameter(
        'service', 'service: on request; time: at set times after the first sample; auto: when the signals show it',
        choices=('service', 'time', 'auto'))
    capture_time: float = parameter(
        3.0, 'time of the capture after the first sample (mode time); negative: no capture', unit='s', low=-1.0,
        high=1e9)
    release_time: float = parameter(
        -1.0, 'time of the release after the first sample (mode time); negative: no release', unit='s', low=-1.0,
        high=1e9)
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
        if self.mode == 'time':
            check_order(self)


WINDOWS = (5, 10, 30)
"""Lengths of time that the page can show [s]."""
PORT = 8765


@dataclass(frozen=True)
class ViewParameters:
    """What the live page shows and where. Signals and arm have the same parameter names as in the identifier."""

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
