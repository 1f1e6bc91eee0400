"""Managed life in any order and many times over, with the real nodes: nothing is left behind or breaks."""

from __future__ import annotations

import random
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from joint_states import START_NS, joint_state
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from ros_harness import Ros, overrides
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

from flexmanip_ros.parameters import leaves
from flexmanip_ros.ros import qos
from flexmanip_ros.ros.conversions import to_message
from flexmanip_ros.ros.nodes import rpbsid_identifier
from flexmanip_ros.ros.nodes.capture_trigger import CaptureTrigger
from flexmanip_ros.ros.nodes.excitation import Excitation
from flexmanip_ros.ros.nodes.live_view import LiveView
from flexmanip_ros.ros.nodes.payload_adapter import PayloadAdapter
from flexmanip_ros.ros.nodes.payload_controller import PayloadController
from flexmanip_ros.ros.nodes.plant_simulator import PlantSimulator
from flexmanip_ros.ros.nodes.rpbsid_identifier import RpbsidIdentifier
from flexmanip_ros.types import CaptureEvent, EventKind

TRANSITIONS = (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_CLEANUP, Transition.TRANSITION_ACTIVATE,
               Transition.TRANSITION_DEACTIVATE)
ALLOWED = {('unconfigured', 0): 'inactive', ('inactive', 1): 'unconfigured', ('inactive', 2): 'active',
           ('active', 3): 'inactive'}
NODES = {
    PlantSimulator: {'rate': 100.0, 'noise': 'none', 'arm__modes': 1}, Excitation: {}, CaptureTrigger: {},
    PayloadController: {'arm__modes': 1}, PayloadAdapter: {'target_node': 'nobody'},
    RpbsidIdentifier: {'payload_method': 'none', 'checkpoint_period': 0.1}, LiveView: {'port': 0},
}


def entities(node: Any) -> tuple[int, ...]:
    """Return how many of each kind a node holds."""
    return (len(list(node.publishers)), len(list(node.subscriptions)), len(list(node.services)),
            len(list(node.clients)), len(list(node.timers)))


@pytest.mark.parametrize('cls', NODES)
def test_transitions_in_any_order_do_what_they_may_and_leave_nothing_behind(
        ros: Ros, cls: Any, tmp_path: Path) -> None:
    given = NODES[cls] | ({'checkpoint_file': str(tmp_path / 'state')} if cls is RpbsidIdentifier else {})
    node = ros.managed(cls(context=ros.context, overrides=overrides(**given)))
    states = ros.helper.create_publisher(JointState, 'joint_states', qos.sensor_output())
    change = ros.helper.create_client(ChangeState, f'{node.get_name()}/change_state')
    ask = ros.helper.create_client(GetState, f'{node.get_name()}/get_state')
    ros.wait(lambda: change.service_is_ready() and ask.service_is_ready())
    rng, state, held, sample = random.Random(4), 'active', set(), 0
    for _ in range(80):
        number = rng.choice((0, 1, 2, 3, *(n for s, n in ALLOWED if s == state) ))
        request = ChangeState.Request()
        request.transition.id = TRANSITIONS[number]
        answer = change.call_async(request)
        ros.wait(answer.done, what='the answer to a transition')
        assert answer.result().success == ((state, number) in ALLOWED)
        state = ALLOWED.get((state, number), state)
        for _ in range(5):
            sample += 1
            states.publish(joint_state(sample))
        said = ask.call_async(GetState.Request())
        ros.wait(said.done, what='the state')
        assert said.result().current_state.label == state
        if state != 'active':
            held.add(entities(node))
    assert len(held) == 1
    assert threading.active_count() <= 5  # this one, the executor, and what computes or saves meanwhile


@pytest.mark.parametrize('cls', NODES)
def test_every_parameter_that_may_change_may_change_in_every_state(ros: Ros, cls: Any) -> None:
    node = ros.add(cls(context=ros.context, overrides=overrides(**NODES[cls], autostart=False)))
    changes = [node.get_parameter(leaf.name) for leaf in leaves(type(node.config)) if leaf.live]
    answers: list[Any] = []

    def change() -> None:
        answers.extend(node.set_parameters(changes))

    for step in (change, node.trigger_configure, change, node.trigger_activate, change, node.trigger_deactivate, change,
                 node.trigger_cleanup, change):
        ros.run(node, step)
    assert [answer.reason for answer in answers if not answer.successful] == []
    assert len(answers) == 5 * len(changes)


@pytest.mark.parametrize('cls', [RpbsidIdentifier, LiveView])
def test_a_latched_event_that_comes_between_configure_and_activate_is_known_once_active(ros: Ros, cls: Any) -> None:
    """A lifecycle manager leaves time between the two, and the middleware sends a latched event only once."""
    event = CaptureEvent(START_NS - 10**9, EventKind.CAPTURE)
    events = ros.helper.create_publisher(Header, 'capture_event', qos.latched())
    events.publish(to_message(event))
    node = ros.add(cls(context=ros.context, overrides=overrides(**NODES[cls], autostart=False)))
    ros.run(node, node.trigger_configure)
    ros.wait(lambda: node._unheard, what='the event')
    ros.run(node, node.trigger_activate)
    events.publish(to_message(event._replace(kind=EventKind.RELEASE)))  # taken after the first
    known = (lambda: node.state.early) if cls is RpbsidIdentifier else (lambda: tuple(node._screen._known))
    ros.wait(lambda: len(known()) == 2)
    assert [item.kind for item in known()] == [EventKind.CAPTURE, EventKind.RELEASE]


@pytest.mark.parametrize(('cls', 'values'), [
    (PlantSimulator, {'rate': 200.0, 'noise': 'none', 'arm__modes': 1}), (Excitation, {'rate': 200.0})])
def test_a_node_that_keeps_its_rate_does_not_warn_of_the_second_in_which_it_was_activated(
        ros: Ros, cls: Any, values: dict[str, Any]) -> None:
    heard = ros.listen(DiagnosticArray, '/diagnostics')
    node = ros.add(cls(context=ros.context, overrides=overrides(**values, autostart=False)))
    ros.run(node, node.trigger_configure)
    ros.wait(lambda: heard)
    limit = time.monotonic() + 0.5  # in the middle of a second
    ros.wait(lambda: time.monotonic() > limit)
    ros.run(node, node.trigger_activate)
    ros.wait(lambda: {'active': 'True'} in [{v.key: v.value for v in m.status[0].values if v.key == 'active'}
                                            for m in heard])
    assert [message.status[0].message for message in heard if 'a second' in message.status[0].message] == []


def test_two_nodes_of_one_name_say_so(ros: Ros) -> None:
    heard = ros.listen(DiagnosticArray, '/diagnostics')
    first, second = (ros.managed(CaptureTrigger(context=ros.context)) for _ in range(2))
    ros.wait(lambda: sum('another node' in message.status[0].message for message in heard) > 1)
    assert (first.active, second.active) == (True, True)


def test_a_node_listens_once_it_is_ready_to(ros: Ros, monkeypatch: pytest.MonkeyPatch) -> None:
    """What came while kernels were loaded would be a backlog, and what did not fit into the queue a gap."""
    node = RpbsidIdentifier(context=ros.context, overrides=overrides(payload_method='none'))

    def readers() -> int:
        return int(node.count_subscribers('joint_states'))

    before: list[int] = []
    monkeypatch.setattr(rpbsid_identifier, 'warm_up', lambda config: before.append(readers()))
    ros.managed(node)
    ros.wait(lambda: readers() == 1)
    assert before == [0]
