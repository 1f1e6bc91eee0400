"""The identifier under test: what it is fed with and what it says."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from ros_harness import Ros, overrides
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

from flexmanip_ros import pipeline
from flexmanip_ros.parameters import ExcitationParameters, PlantParameters
from flexmanip_ros.ros import conversions, qos
from flexmanip_ros.ros.demo import outgoing
from flexmanip_ros.ros.nodes.rpbsid_identifier import TOPICS, RpbsidIdentifier
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, EventKind, JointRecord

START_NS = 1_700_000_000_000_000_000
CAPTURE = CaptureEvent(START_NS + 400_000_000, EventKind.CAPTURE)


@lru_cache
def recording(count: int = 700) -> tuple[JointRecord, ...]:
    """Return joint states of the simulated arm that catches its object after 0.4 s."""
    run = simulator.simulate(PlantParameters(), excitation.sequence(ExcitationParameters(), count),
                             (CAPTURE,), START_NS)
    return tuple(item for item in simulator.records(run) if isinstance(item, JointRecord))


class Live:
    """The identifier, what it is fed with and what it says."""

    def __init__(self, ros: Ros, **values: Any) -> None:
        self.ros = ros
        self.said: dict[str, list[Any]] = {}
        for name, kind in TOPICS.items():
            self.said[name] = ros.listen(kind, f'/rpbsid_identifier/{name}')
        self.diagnostics = ros.listen(DiagnosticArray, '/diagnostics', 10)
        self.node = ros.managed(RpbsidIdentifier(context=ros.context, overrides=overrides(**values)))
        self.joint_states = ros.publisher(JointState, 'joint_states', qos.sensor_output())
        self.events = ros.publisher(Header, 'capture_event', qos.latched())
        ros.wait(lambda: all(item.get_subscription_count() for item in self.node.outputs.values()))

    def send(self, *records: JointRecord) -> None:
        """Publish records and wait until they are taken, in portions that no queue overflows at."""
        for first in range(0, len(records), 200):
            part = records[first:first + 200]
            before = self.node.state.counters.received
            for record in part:
                self.joint_states.publish(conversions.to_message(record))
            self.ros.wait(lambda before=before, part=part:
                          self.node.state.counters.received >= before + len(part), what='samples to be taken')

    def finish(self) -> None:
        """Deactivate the node: it publishes the model under way."""
        request = ChangeState.Request()
        request.transition.id = Transition.TRANSITION_DEACTIVATE
        assert self.ros.call(ChangeState, 'rpbsid_identifier/change_state', request).success

    def values(self) -> dict[str, str]:
        """Return the latest diagnostic values."""
        for message in reversed(self.diagnostics):
            for status in message.status:
                if status.name == '/rpbsid_identifier: status':
                    return {item.key: item.value for item in status.values}
        return {}


def replayed(live: Live, items: list[JointRecord | CaptureEvent]) -> dict[str, list[Any]]:
    return outgoing(pipeline.run(live.node.config, items), live.node.config.payload_frame)
