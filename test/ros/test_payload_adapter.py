from __future__ import annotations

import re
import time
from pathlib import Path
from typing import Any

import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Inertia, InertiaStamped, Vector3
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from ros_harness import Ros, overrides
from std_msgs.msg import Float64MultiArray

from flexmanip_ros.control import handover
from flexmanip_ros.errors import ParameterError
from flexmanip_ros.io.parameter_file import load
from flexmanip_ros.messages import payload_status
from flexmanip_ros.parameters import AdapterParameters, ControllerParameters, IdentifierParameters
from flexmanip_ros.ros import qos
from flexmanip_ros.ros.conversions import to_message
from flexmanip_ros.ros.nodes import payload_adapter
from flexmanip_ros.ros.nodes.payload_adapter import PayloadAdapter, fill, rejection, service_class
from flexmanip_ros.ros.nodes.plant_simulator import PlantSimulator
from flexmanip_ros.types import Payload, Status

ROOT = Path(__file__).resolve().parents[2]


def say(ros: Ros, mass: float, std: float, period: float = 0.02) -> tuple[Any, Any]:
    """Return publishers of a payload and its estimate, latched; the estimate is published every ``period`` [s]."""
    payload = ros.helper.create_publisher(InertiaStamped, 'rpbsid_identifier/payload', qos.latched())
    estimate = ros.helper.create_publisher(
        Float64MultiArray, 'rpbsid_identifier/payload_estimate', qos.latched())
    message = InertiaStamped()
    message.inertia.m = mass
    payload.publish(message)
    ros.helper.create_timer(period, lambda: estimate.publish(
        Float64MultiArray(data=[mass, std, mass - 2 * std, mass + 2 * std, 1.0])))
    return payload, estimate


def beside_a_plant(ros: Ros, **values: Any) -> tuple[PayloadAdapter, PlantSimulator]:
    """Return an adapter that sets a parameter of a plant, and the plant."""
    plant = ros.managed(PlantSimulator(context=ros.context, overrides=overrides(rate=50.0, arm__modes=1)))
    return ros.managed(PayloadAdapter(context=ros.context, overrides=overrides(
        target_node='plant_simulator', **values))), plant


def test_a_trusted_payload_becomes_a_parameter_of_another_node(ros: Ros) -> None:
    adapter, plant = beside_a_plant(ros, settle_time=0.1)
    say(ros, 31.5, 0.1)
    ros.wait(lambda: plant.config.payload_mass == 31.5, what='the parameter')
    ros.wait(lambda: adapter.sent == 1)
    assert adapter.state.sent.mass == 31.5


def test_a_doubtful_payload_is_not_told(ros: Ros) -> None:
    adapter, plant = beside_a_plant(ros, settle_time=0.0)
    heard = ros.listen(Float64MultiArray, 'rpbsid_identifier/payload_estimate', 10)
    say(ros, 31.5, 9.0)
    ros.wait(lambda: len(heard) > 20)
    assert (plant.config.payload_mass, adapter.sent) == (20.0, 0)


@pytest.mark.parametrize(('name', 'words'), [
    ('rate', ('read-only',)),
    ('pay_load', ("node 'plant_simulator' did not set its parameter 'pay_load' to 31.500 kg",
                  'let target_node and mass_parameter name a double that the node declares'))])
def test_a_parameter_that_the_node_does_not_set_is_named_with_the_reason_and_what_to_do(
        ros: Ros, name: str, words: tuple[str, ...]) -> None:
    adapter, _ = beside_a_plant(ros, mass_parameter=name, settle_time=0.0, min_period=0.05)
    say(ros, 31.5, 0.1)
    ros.wait(lambda: all(part in adapter.problem for part in words), what='the reason')
    assert adapter.sent == 0


def test_estimates_that_cease_are_a_warning_and_are_no_longer_trusted(
        ros: Ros, monkeypatch: pytest.MonkeyPatch) -> None:
    adapter, _ = beside_a_plant(ros, settle_time=0.0)
    heard = ros.listen(DiagnosticArray, '/diagnostics')
    say(ros, 31.5, 0.1)
    ros.wait(lambda: adapter.sent == 1)
    timer = next(iter(ros.helper.timers))
    ros.run(ros.helper, timer.cancel)
    monkeypatch.setattr(handover, 'LONGEST_AGE', 0.2)
    found = ros.wait(lambda: [status for message in heard for status in message.status
                              if 'no payload estimate for' in status.message], what='the warning')[0]
    values = {item.key: item.value for item in found.values}
    assert (found.name, found.level) == ('/payload_adapter: status', b'\x01')
    assert (values['trusted'], float(values['estimate_age_s']) > 0.2) == ('False', True)


def test_estimates_every_half_a_second_are_trusted_and_no_warning_where_a_fifth_of_a_second_counts_as_long(
        ros: Ros, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(handover, 'LONGEST_AGE', 0.2)
    adapter, plant = beside_a_plant(ros, settle_time=3.0)
    heard = ros.listen(DiagnosticArray, '/diagnostics')
    say(ros, 31.5, 0.1, period=0.5)
    ros.wait(lambda: adapter.sent == 1)
    assert plant.config.payload_mass == 31.5
    said = [status.message for message in heard for status in message.status if 'payload_adapter' in status.name]
    assert 'no payload estimate' not in ''.join(said[2:])  # the period is known from the second estimate on


def test_a_driver_that_is_not_there_is_named(ros: Ros) -> None:
    adapter = ros.managed(PayloadAdapter(context=ros.context, overrides=overrides(
        target_node='nobody', settle_time=0.0)))
    say(ros, 31.5, 0.1)
    ros.wait(lambda: 'nobody/set_parameters' in adapter.problem)


def test_a_service_type_that_is_not_installed_is_named() -> None:
    with pytest.raises(ParameterError, match="'ur_msgs/srv/SetPayload' is not installed; install and source"):
        service_class('ur_msgs/srv/SetPayload')


def test_a_request_without_a_place_for_a_payload_is_refused_before_it_is_needed(ros: Ros) -> None:
    node = ros.managed(PayloadAdapter(context=ros.context, overrides=overrides(
        service='driver/set', service_type='std_srvs/srv/SetBool')))
    assert not node.active


def test_a_payload_that_is_not_that_of_its_estimate_is_not_told(ros: Ros) -> None:
    adapter, plant = beside_a_plant(ros, settle_time=0.0)
    payload, _ = say(ros, 31.5, 0.1)
    ros.wait(lambda: adapter.sent == 1)
    payload.publish(InertiaStamped(inertia=Inertia(m=90.0)))
    ros.wait(lambda: adapter._inertia.m == 90.0)
    adapter.state = adapter.state._replace(sent=None, sent_at=-1e9)
    ros.wait(lambda: adapter.doubtful > 0)
    assert (plant.config.payload_mass, adapter.sent) == (31.5, 1)


def beside_a_deaf_driver(ros: Ros, monkeypatch: pytest.MonkeyPatch, min_period: float) -> tuple[PayloadAdapter, Node]:
    """An adapter whose driver takes requests and never answers, and that driver's node."""
    monkeypatch.setattr(payload_adapter, 'ANSWER_S', 0.05)
    node = Node('deaf', context=ros.context)  # never spun
    node.create_service(SetParameters, 'driver/set_parameters', lambda request, response: response)
    adapter = ros.managed(PayloadAdapter(context=ros.context, overrides=overrides(
        target_node='driver', settle_time=0.0, min_period=min_period)))
    ros.wait(adapter._client.service_is_ready)
    return adapter, node


def test_a_driver_that_does_not_answer_is_said_and_its_requests_are_not_kept(
        ros: Ros, monkeypatch: pytest.MonkeyPatch) -> None:
    adapter, node = beside_a_deaf_driver(ros, monkeypatch, min_period=0.01)
    say(ros, 31.5, 0.1)
    ros.wait(lambda: 'has not answered' in adapter.problem)
    for _ in range(5):
        first = adapter._asked
        ros.wait(lambda first=first: adapter._asked is not first, what='another request')
    assert len(adapter._client._pending_requests) <= 1
    ros.wait(lambda: adapter._asked is not None)
    ros.run(ros.helper, next(iter(ros.helper.timers)).cancel)
    ros.wait(lambda: adapter._asked is None, what='the end of the wait without another estimate')
    node.destroy_node()


def test_a_driver_that_does_not_answer_is_not_asked_again_before_min_period(
        ros: Ros, monkeypatch: pytest.MonkeyPatch) -> None:
    adapter, node = beside_a_deaf_driver(ros, monkeypatch, min_period=60.0)
    requests: list[Any] = []
    call = adapter._client.call_async
    monkeypatch.setattr(adapter._client, 'call_async', lambda request: requests.append(request) or call(request))
    say(ros, 31.5, 0.1)
    ros.wait(lambda: 'has not answered' in adapter.problem)
    ended = time.monotonic()
    ros.wait(lambda: adapter._arrivals.times[0] > ended, what='three more estimates')
    assert len(requests) == 1
    node.destroy_node()


class WithInertia:
    """The shape of a request, as generated messages describe themselves."""

    fields = {'inertia': 'geometry_msgs/Inertia'}  # noqa: RUF012

    def get_fields_and_field_types(self) -> dict[str, str]:
        return self.fields


class WithMass(WithInertia):
    fields = {'mass': 'float', 'center_of_gravity': 'geometry_msgs/Vector3'}  # noqa: RUF012


class WithNeither(WithInertia):
    fields = {'data': 'boolean'}  # noqa: RUF012


def test_a_request_is_filled_by_its_fields() -> None:
    body = Inertia(m=20.0, com=Vector3(x=0.1))
    assert fill(WithInertia(), body).inertia is body
    filled = fill(WithMass(), body)
    assert (filled.mass, filled.center_of_gravity.x) == (20.0, 0.1)
    with pytest.raises(ParameterError, match='no place for a payload'):
        fill(WithNeither(), body)


class Ur(WithInertia):
    """ur_msgs/srv/SetPayload of Jazzy."""

    fields = {'mass': 'float', 'center_of_gravity': 'geometry_msgs/Vector3', **dict.fromkeys(  # noqa: RUF012
        ('ixx', 'iyy', 'izz', 'ixy', 'ixz', 'iyz'), 'double'), 'transition_time': 'builtin_interfaces/Duration'}


class Franka(WithInertia):
    """franka_msgs/srv/SetLoad."""

    fields = {'mass': 'double', 'center_of_mass': 'double[3]', 'load_inertia': 'double[9]'}  # noqa: RUF012


BODY = Inertia(m=2.0, com=Vector3(x=0.1, y=0.2, z=0.3), ixx=1.0, ixy=2.0, ixz=3.0, iyy=4.0, iyz=5.0, izz=6.0)


def test_a_ur_driver_gets_inertia_and_transition_time() -> None:
    filled = fill(Ur(), BODY, 0.25)
    assert (filled.mass, filled.center_of_gravity) == (2.0, BODY.com)
    assert [getattr(filled, name) for name in ('ixx', 'iyy', 'izz', 'ixy', 'ixz', 'iyz')] == [1, 4, 6, 2, 3, 5]
    assert (filled.transition_time.sec, filled.transition_time.nanosec) == (0, 250_000_000)


def test_a_driver_gets_a_tensor_that_a_body_can_have_where_only_the_plane_is_known() -> None:
    filled = fill(Ur(), Inertia(m=2.0, com=Vector3(x=0.1, y=-0.05), izz=1.5), 0.25)
    assert (filled.ixx, filled.iyy, filled.izz) == (0.75, 0.75, 1.5)
    assert (filled.ixy, filled.ixz, filled.iyz) == (0.0, 0.0, 0.0)
    assert (filled.center_of_gravity.x, filled.center_of_gravity.y) == (0.1, -0.05)


def test_a_franka_driver_gets_arrays() -> None:
    filled = fill(Franka(), BODY)
    assert (filled.mass, filled.center_of_mass) == (2.0, [0.1, 0.2, 0.3])
    assert filled.load_inertia == [1, 2, 3, 2, 4, 5, 3, 5, 6]


@pytest.mark.parametrize(('name', 'service', 'kind'), [
    ('ur', 'io_and_status_controller/set_payload', 'ur_msgs/srv/SetPayload'),
    ('franka', 'service_server/set_load', 'franka_msgs/srv/SetLoad')])
def test_the_parameter_file_of_a_driver_is_one_of_the_adapter(name: str, service: str, kind: str) -> None:
    config = load(AdapterParameters, 'payload_adapter', ROOT / 'config' / 'drivers' / f'{name}.yaml')
    assert (config.service, config.service_type) == (service, kind)


def test_the_example_for_ros2_control_has_the_names_and_topics_of_the_nodes() -> None:
    found = yaml.safe_load((ROOT / 'config' / 'ros2_control.yaml').read_text(encoding='utf-8'))
    manager = found['controller_manager']['ros__parameters']
    assert {name for name, value in manager.items() if isinstance(value, dict)} == set(found) - {'controller_manager'}
    efforts = found['effort_controller']['ros__parameters']
    assert [f"{name}/{efforts['interface_name']}" for name in efforts['joints']] == list(IdentifierParameters().inputs)
    assert tuple(efforts['joints']) == ControllerParameters().joints
    assert manager['update_rate'] == ControllerParameters().rate


def test_the_consumer_of_the_documentation_takes_a_payload_that_is_trusted_and_no_other(ros: Ros) -> None:
    text = (ROOT / 'docs' / 'nodes.md').read_text(encoding='utf-8')
    (code,) = re.findall(r'^```python\n(.*?)^```', text, re.MULTILINE | re.DOTALL)
    assert code.count('\n') < 30
    module: dict[str, Any] = {}
    exec(code, module)
    publisher = ros.helper.create_publisher(DiagnosticArray, 'rpbsid_identifier/status', qos.latched())
    held = Payload(20.0, 0.1, 19.8, 20.2, 1.0, Status.TRACKING)
    publisher.publish(to_message(payload_status(held, 0, 'tip')))
    consumer = ros.add(module['Consumer'](context=ros.context))  # later than the payload
    ros.wait(lambda: consumer.mass == 20.0, what='the latched payload')
    publisher.publish(to_message(payload_status(held._replace(status=Status.INCONSISTENT), 0, 'tip')))
    ros.wait(lambda: consumer.mass is None, what='the doubt')


def test_answers_of_drivers_and_nodes_are_understood() -> None:
    class Answer:
        success = False
        message = 'too heavy'

    assert rejection(Answer()) == 'too heavy'
    del Answer.message
    Answer.error = 'the arm moves'
    assert rejection(Answer()) == 'the arm moves'
    Answer.success = True
    assert rejection(Answer()) == ''
