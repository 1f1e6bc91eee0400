"""Parameters of the bridge to a robot driver (node ``payload_adapter``)."""

from __future__ import annotations

from dataclasses import dataclass

from flexmanip_ros.errors import ParameterError
from flexmanip_ros.parameters.field import check_all, parameter


@dataclass(frozen=True)
class AdapterParameters:
    """Whom to tell the payload, and when it is worth telling."""

    service: str = parameter(
        'io_and_status_controller/set_payload', 'service of the driver that takes a payload')
    service_type: str = parameter(
        'ur_msgs/srv/SetPayload', 'its type; the request has a geometry_msgs/Inertia, or mass and '
        'center_of_gravity')
    target_node: str = parameter(
        '', 'node that has a parameter for the payload, told instead of the service; empty: none')
    mass_parameter: str = parameter('payload_mass', 'name of that parameter (a double)', unit='kg')
    max_relative_std: float = parameter(
        0.05, 'a payload is told when its standard deviation is below this fraction of it, or below '
        'max_std', low=1e-6, high=1.0, live=True)
    max_std: float = parameter(
        0.2, 'standard deviation below which any payload is told', unit='kg', low=1e-6, high=1e3, live=True)
    max_consistency: float = parameter(
        4.0, 'largest trusted residual power (1: noise only)', low=0.0, live=True)
    max_payload: float = parameter(
        100.0, 'payloads above this are never told', unit='kg', low=0.0, live=True)
    settle_time: float = parameter(
        0.3, 'a payload must have been trusted for this long', unit='s', low=0.0, high=60.0, live=True)
    min_change: float = parameter(
        0.05, 'a payload is told again when it changed by this fraction, or by max_std', low=0.0, high=10.0,
        live=True)
    min_period: float = parameter(
        1.0, 'two messages to the driver are at least this far apart', unit='s', low=0.01, high=3600.0)

    def __post_init__(self) -> None:
        check_all(self)
        if not self.service and not self.target_node:
            raise ParameterError("parameters 'service' and 'target_node' are both empty",
                                 'name the driver service or the node that takes the payload')
        parts = self.service_type.split('/')
        if len(parts) != 3 or parts[1] != 'srv' or not all(part.isidentifier() for part in parts):
            raise ParameterError(f"parameter 'service_type' is '{self.service_type}'",
                                 'write PACKAGE/srv/TYPE')
