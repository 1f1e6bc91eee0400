from __future__ import annotations

from typing import Any

import pytest
import rclpy
from geometry_msgs.msg import Inertia, InertiaStamped, Vector3
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from ros_harness import Ros, overrides
from std_msgs.msg import Float64MultiArray

from flexmanip_ros.errors import ParameterError
from flexmanip_ros.ros import qos
from flexmanip_ros.ros.nodes import payload_adapter
from flexmanip_ros.ros.nodes.payload_adapter import PayloadAdapter, fill, rejection, service_class
from flexmanip_ros.ros.nodes.plant_simulator import PlantSimulator


def say(ros: Ros, mass: float, std: float) -> tuple[Any, Any]:
    """Return publishers of a payload and its estimate, latched."""
    payload = ros.helper.create_publisher(InertiaStamped, 'rpbsid_identifier/payload', qos.latched())
    estimate = ros.helper.create_publisher(
        Float64MultiArray, 'rpbsid_identifier/payload_estimate', qos.latched())
    message = InertiaStamped()
    message.inertia.m = mass
    payload.publish(message)
    ros.helper.create_timer(0.02, lambda: estimate.publish(
        Float64MultiArray(data=[mass, std, mass - 2 * std, mass + 2 * std, 1.0])))
    return payload, estimate


def test_a_trusted_payload_becomes_a_parameter_of_another_node(ros: Ros) -> None:
    plant = ros.managed(PlantSimulator(context=ros.context, overrides=overrides(rate=50.0, arm__modes=1)))
    adapter = ros.managed(PayloadAdapter(context=ros.context, overrides=overrides(
        target_node='plant_simulator', settle_time=0.1)))
    say(ros, 31.5, 0.1)
    ros.wait(lambda: plant.config.payload_mass == 31.5, what='the parameter')
    ros.wait(lambda: adapter.sent == 1)
    assert adapter.state.sent_mass == 31.5


def test_a_doubtful_payload_is_not_told(ros: Ros) -> None:
    plant = ros.managed(PlantSimulator(context=ros.context, overrides=overrides(rate=50.0, arm__modes=1)))
    adapter = ros.managed(PayloadAdapter(context=ros.context, overrides=overrides(
        target_node='plant_simulator', settle_time=0.0)))
    heard = ros.listen(Float64MultiArray, 'rpbsid_identifier/payload_estimate', 10)
    say(ros, 31.5, 9.0)
    ros.wait(lambda: len(heard) > 20)
    assert (plant.config.payload_mass, adapter.sent) == (20.0, 0)


def test_a_refusal_is_reported_with_its_reason_and_asked_again(ros: Ros) -> None:
    ros.managed(PlantSimulator(context=ros.context, overrides=overrides(rate=50.0, arm__modes=1)))
    adapter = ros.managed(PayloadAdapter(context=ros.context, overrides=overrides(
        target_node='plant_simulator', mass_parameter='rate', settle_time=0.0, min_period=0.05)))
    say(ros, 31.5, 0.1)
    ros.wait(lambda: 'read-only' in adapter.problem, what='the reason')
    assert adapter.sent == 0


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
    plant = ros.managed(PlantSimulator(context=ros.context, overrides=overrides(rate=50.0, arm__modes=1)))
    adapter = ros.managed(PayloadAdapter(context=ros.context, overrides=overrides(
        target_node='plant_simulator', settle_time=0.0)))
    payload, _ = say(ros, 31.5, 0.1)
    ros.wait(lambda: adapter.sent == 1)
    payload.publish(InertiaStamped(inertia=Inertia(m=90.0)))
    ros.wait(lambda: adapter._inertia.m == 90.0)
    adapter.state = adapter.state._replace(sent_mass=None, sent_at=-1e9)
    ros.wait(lambda: adapter.doubtful > 0)
    assert (plant.config.payload_mass, adapter.sent) == (31.5, 1)


def test_a_driver_that_does_not_answer_is_said_and_its_requests_are_not_kept(
        ros: Ros, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(payload_adapter, 'ANSWER_S', 0.05)
    deaf = Context()
    rclpy.init(context=deaf, domain_id=ros.domain, signal_handler_options=SignalHandlerOptions.NO)
    node = Node('deaf', context=deaf)  # never spun
    node.create_service(SetParameters, 'driver/set_parameters', lambda request, response: response)
    adapter = ros.managed(PayloadAdapter(context=ros.context, overrides=overrides(
        target_node='driver', settle_time=0.0, min_period=0.01)))
    ros.wait(adapter._client.service_is_ready)
    say(ros, 31.5, 0.1)
    ros.wait(lambda: 'has not answered' in adapter.problem)
    for _ in range(5):
        first = adapter._asked
        ros.wait(lambda first=first: adapter._asked is not first, what='another request')
    assert len(adapter._client._pending_requests) <= 1
    node.destroy_node()
    rclpy.shutdown(context=deaf)


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


def test_answers_of_drivers_and_nodes_are_understood() -> None:
    class Answer:
        success = False
        message = 'too heavy'

    assert rejection(Answer()) == 'too heavy'
    Answer.success = True
    assert rejection(Answer()) == ''
