"""Node ``payload_adapter``: sends a trusted payload to a robot driver.

subscribes  rpbsid_identifier/payload_estimate  std_msgs/Float64MultiArray   whether to trust it
            rpbsid_identifier/payload           geometry_msgs/InertiaStamped what to send
publishes   /diagnostics                        diagnostic_msgs/DiagnosticArray  1 Hz
calls       the driver's service (`service`, `service_type`), whose request has a geometry_msgs/Inertia, or a mass and,
            where it has places for them, centre of mass, inertia and transition time (UR, Franka);
            with `target_node` its SetParameters for `mass_parameter`

A payload is sent once it has been trusted for `settle_time`, and again when its mass changed by more than
`min_change` of it and more than `max_std`, its centre of mass or radius of gyration by more than `min_displacement`.
"""

import importlib
import sys
import time
from functools import partial
from typing import Any

from geometry_msgs.msg import Inertia, InertiaStamped
from rcl_interfaces.srv import SetParameters
from rclpy.client import Client
from rclpy.duration import Duration
from rclpy.parameter import Parameter
from std_msgs.msg import Float64MultiArray

from flexmanip_ros.control import handover
from flexmanip_ros.control.handover import PayloadEstimate
from flexmanip_ros.errors import ParameterError
from flexmanip_ros.parameters import AdapterParameters
from flexmanip_ros.ros import qos
from flexmanip_ros.ros.diagnostics import ERROR, WARN, Report
from flexmanip_ros.ros.node import FlexmanipNode, run

NAME = 'payload_adapter'
ANSWER_S = 5.0
"""Longest wait for the answer of a driver [s], after which it may be asked again."""
INERTIA = ('ixx', 'iyy', 'izz', 'ixy', 'ixz', 'iyz')


class PayloadAdapter(FlexmanipNode[AdapterParameters]):
    """Sends payloads to the driver's service, one request at a time."""

    def __init__(self, **options: Any) -> None:
        super().__init__(NAME, AdapterParameters, **options)
        self.state = handover.HandoverState()
        self.sent = 0
        self.problem = ''
        self._inertia: Inertia | None = None
        self._arrivals = handover.Arrivals()
        self.doubtful = 0
        self._asked: tuple[Any, float] | None = None
        """Future of the request that waits for its answer, and when it was sent [s]; None without such a request."""

    def make_entities(self) -> None:
        """Create the subscriptions and the service client."""
        if self.config.target_node:
            self._client: Client = self.create_client(
                SetParameters, f'{self.config.target_node}/set_parameters')
        else:
            kind = service_class(self.config.service_type)
            fill(kind.Request(), Inertia())  # rejects a service whose request has no place for a payload
            self._client = self.create_client(kind, self.config.service)
        self.subscription(InertiaStamped, 'rpbsid_identifier/payload', self._on_payload, qos.latched_input())
        self.subscription(Float64MultiArray, 'rpbsid_identifier/payload_estimate', self._on_estimate,
                          qos.latched_input())

    def summary(self) -> str:
        """Say where payloads go."""
        return f'payloads go to {self._client.srv_name}'

    def activated(self) -> None:
        """Begin in the state in which no payload has been sent."""
        self._forget_request()
        self.state, self.problem = handover.HandoverState(), ''
        self._arrivals = handover.Arrivals()

    def _on_payload(self, message: InertiaStamped) -> None:
        self._inertia = message.inertia

    def _on_estimate(self, message: Float64MultiArray) -> None:
        if self.active and len(message.data) == 5:
            with self.meter.timed():
                self._take(PayloadEstimate(*message.data))

    def _take(self, found: PayloadEstimate) -> None:
        """Send the payload where that is due."""
        now = time.monotonic()
        self._arrivals = self._arrivals.with_latest(now)
        if self._inertia is None:
            return
        body = self._inertia
        found = found._replace(com=(body.com.x, body.com.y), inertia=body.izz)
        self.state, due = handover.step(self.config, self.state, found, now)
        self._give_up(now)
        if not due or self._asked is not None:
            return
        numbers = [getattr(body, name) for name in ('m', *INERTIA)] + [body.com.x, body.com.y, body.com.z]
        if body.m < 0.0 or not found.fits(numbers):
            self.doubtful += 1
            self.log_throttled('payload', 'a payload was not sent: its mass is not that of the estimate, or it '
                          'has a value that is not finite')
            return
        self._send(body, found._replace(mass=body.m), now)

    def _send(self, inertia: Inertia, found: PayloadEstimate, now: float) -> None:
        self.state = self.state._replace(sent_at=now)
        if not self._client.service_is_ready():
            self.problem = f"service '{self._client.srv_name}' is not available"
            self.log_throttled('service', f'{self.problem}; start the driver, or correct the parameters')
            return
        future = self._client.call_async(self._request(inertia))
        self._asked = future, now
        future.add_done_callback(lambda future: self._answered(future, found))

    def _give_up(self, now: float) -> None:
        """Stop waiting for an answer that has not come within ``ANSWER_S``."""
        if self._asked is not None and now - self._asked[1] >= ANSWER_S:
            self.problem = f"service '{self._client.srv_name}' has not answered within {ANSWER_S:g} s"
            self.log_throttled('silence', f'{self.problem}; it is asked again with the next estimate, no sooner than '
                               'min_period after the last request')
            self._forget_request()

    def _forget_request(self) -> None:
        """Stop waiting for the answer and remove the request, which the client would keep without end."""
        if self._asked is not None:
            future, self._asked = self._asked[0], None
            self._client.remove_pending_request(future)

    def _request(self, inertia: Inertia) -> Any:
        if not self.config.target_node:
            return fill(self._client.srv_type.Request(), inertia, self.config.transition_time)
        parameter = Parameter(self.config.mass_parameter, value=float(inertia.m))
        return SetParameters.Request(parameters=[parameter.to_parameter_msg()])

    def _answered(self, future: Any, sent: PayloadEstimate) -> None:
        if self._asked is None or self._asked[0] is not future:
            return  # the answer to a request that was given up
        self._asked = None
        reason = rejection(future.result())
        if reason:
            self.problem = f'{sent.mass:.3f} kg was rejected: {reason}'
            if self.config.target_node:
                self.problem = (f"node '{self.config.target_node}' did not set its parameter "
                                f"'{self.config.mass_parameter}' to {sent.mass:.3f} kg ({reason}); let target_node and "
                                'mass_parameter name a double that the node declares and lets others set')
            self.log_throttled('rejected', self.problem)
            self.state = self.state._replace(sent_at=time.monotonic())
            return
        self.problem = ''
        self.sent += 1
        self.state = self.state._replace(sent=sent, sent_at=time.monotonic())
        self.get_logger().info(f'the driver accepted a payload of {sent.mass:.3f} kg')

    def report(self, report: Report) -> None:
        """Report what was sent, how old the latest estimate is, and what went wrong."""
        now = time.monotonic()
        age, have_ceased = self._arrivals.age(now), self._arrivals.have_ceased(now)
        self._give_up(now)
        if have_ceased:
            self.state = self.state._replace(trusted_since=None)  # settle_time begins again
        report.values.update(
            sent=self.sent, sent_mass_kg='none' if self.state.sent is None else self.state.sent.mass,
            trusted=self.state.trusted_since is not None, estimate_age_s=age,
            doubtful=self.doubtful)
        if self.problem:
            report.worse(ERROR, self.problem)
        if self.active and have_ceased:
            report.worse(WARN, f'no payload estimate for {age:.0f} s')
        elif self.active and not self.problem and self.state.trusted_since is None:
            report.worse(WARN, 'no payload that can be trusted')


def service_class(name: str) -> Any:
    """Return the class of a service type PACKAGE/srv/TYPE. Raises ParameterError when it is not installed."""
    package, _, kind = name.split('/')
    try:
        return getattr(importlib.import_module(f'{package}.srv'), kind)
    except (ImportError, AttributeError) as error:
        raise ParameterError(f"service type '{name}' is not installed",
                             f'install and source the package {package}') from error


def fill(request: Any, inertia: Inertia, transition_time: float = 0.0) -> Any:
    """Put a payload into a driver's request, by the fields that it has.

    The fields are a geometry_msgs/Inertia; or a mass and, where the request has fields for them, the centre of mass
    (Vector3 or three numbers), the inertia about it (six numbers by name, or nine of a matrix) and the transition
    time [s]. Raises ParameterError when the request has no field for a payload.
    """
    fields, inertia = request.get_fields_and_field_types(), physical(inertia)
    for name, kind in fields.items():
        if kind == 'geometry_msgs/Inertia':
            setattr(request, name, inertia)
            return request
    mass = next((name for name in ('mass', 'payload') if fields.get(name) in ('float', 'double')), None)
    if mass is None:
        raise ParameterError(f'a request with {", ".join(fields) or "no fields"} has no place for a payload',
                             'give a service_type with a geometry_msgs/Inertia or a mass')
    setattr(request, mass, float(inertia.m))
    com = inertia.com
    for name, kind in fields.items():
        if kind == 'geometry_msgs/Vector3':
            setattr(request, name, com)
        elif kind == 'double[3]':
            setattr(request, name, [com.x, com.y, com.z])
        elif kind == 'double[9]':  # symmetric: row-major and column-major order are the same
            i = inertia
            setattr(request, name, [i.ixx, i.ixy, i.ixz, i.ixy, i.iyy, i.iyz, i.ixz, i.iyz, i.izz])
        elif kind == 'builtin_interfaces/Duration':
            setattr(request, name, Duration(seconds=transition_time).to_msg())
        elif name in INERTIA and kind in ('float', 'double'):
            setattr(request, name, float(getattr(inertia, name)))
    return request


def physical(inertia: Inertia) -> Inertia:
    """Return the inertia with ixx and iyy of a flat body where only izz is known, that of a turn in the plane.

    ixx = iyy = izz / 2 are the smallest values of a body (izz <= ixx + iyy); a driver may reject smaller ones.
    """
    if inertia.ixx or inertia.iyy or not inertia.izz > 0.0:
        return inertia
    half = inertia.izz / 2.0
    return Inertia(m=inertia.m, com=inertia.com, ixx=half, iyy=half, izz=inertia.izz, ixy=inertia.ixy, ixz=inertia.ixz,
                   iyz=inertia.iyz)


def rejection(response: Any) -> str:
    """Return why a driver or a node rejected a request; empty when it accepted it."""
    results = getattr(response, 'results', None)
    answer = results[0] if results else response
    if getattr(answer, 'success', getattr(answer, 'successful', True)):
        return ''
    return next((text for text in (getattr(answer, name, '') for name in ('reason', 'message', 'error')) if text),
                'no reason given')


main = partial(run, PayloadAdapter, NAME, __doc__, AdapterParameters)

if __name__ == '__main__':
    sys.exit(main())
