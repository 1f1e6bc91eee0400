"""All nodes of the demonstration in one process, on one executor, over DDS."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rclpy.context import Context
from rclpy.executors import Executor
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.node import Node

from flexmanip_ros.errors import FlexmanipError
from flexmanip_ros.parameters import leaves
from flexmanip_ros.parameters.document import NODES, written
from flexmanip_ros.parameters.simulation import DemoParameters, settings
from flexmanip_ros.ros.demo.recorder import Recorder
from flexmanip_ros.ros.demo.result import Facts
from flexmanip_ros.ros.node import FlexmanipNode
from flexmanip_ros.ros.nodes.capture_trigger import CaptureTrigger
from flexmanip_ros.ros.nodes.excitation import Excitation
from flexmanip_ros.ros.nodes.plant_simulator import PlantSimulator
from flexmanip_ros.ros.nodes.rpbsid_identifier import RpbsidIdentifier
from flexmanip_ros.ros.spin import make_executor

READERS = 4
"""Who reads joint_states here: identifier, trigger, excitation, recorder."""
DISCOVERY_TIMEOUT = 20.0
DRAIN_TIMEOUT = 30.0
"""A busy machine works off its backlog; an idle one needs milliseconds."""


class CompositionError(FlexmanipError):
    """The nodes cannot work together as they should."""


class Composition:
    """Plant, excitation, trigger, identifier and recorder; made, started, and ended as one."""

    def __init__(self, config: DemoParameters, bag: Path, context: Context | None = None) -> None:
        """Create every node; nothing runs and nothing is written yet."""
        self.config = config
        self._nodes: list[Node] = []
        self._bag, self._context = bag, context
        self._recorder: Recorder | None = None
        self._started = 0.0
        self.executor: Executor = make_executor(context)
        try:
            self.plant = self._add(PlantSimulator(context=context))
            self.excitation = self._add(Excitation(context=context))
            self.trigger = self._add(CaptureTrigger(context=context))
            self.identifier = self._add(RpbsidIdentifier(context=context))
        except BaseException:
            self.close()
            raise

    @property
    def managed(self) -> tuple[FlexmanipNode[Any], ...]:
        """The nodes with a managed life, in the order in which they start."""
        return self.identifier, self.trigger, self.excitation, self.plant

    def _add(self, node: Any) -> Any:
        self._nodes.append(node)
        self.executor.add_node(node)
        return node

    def configure(self) -> None:
        """Build states and compile kernels: the slow part, before any clock runs."""
        for node in self.managed:
            if node.trigger_configure() != TransitionCallbackReturn.SUCCESS:
                raise CompositionError(f'{node.get_name()} could not be configured', 'see its log above')

    @property
    def recorder(self) -> Recorder:
        """The recorder; there is one from ``connect`` on."""
        assert self._recorder is not None
        return self._recorder

    def connect(self, interrupted: Callable[[], bool]) -> None:
        """Open the bag, wait until every reader is matched with its writer, and that nobody else is there."""
        self._recorder = self._add(Recorder(self._bag, context=self._context))
        limit = time.monotonic() + DISCOVERY_TIMEOUT
        while not self._matched():
            if interrupted():
                return
            if time.monotonic() > limit:
                raise CompositionError(
                    f'the nodes did not find each other within {DISCOVERY_TIMEOUT:.0f} s',
                    'unset ROS_AUTOMATIC_DISCOVERY_RANGE and ROS_STATIC_PEERS')
            self.executor.spin_once(timeout_sec=0.05)
        if foreign_arm(self.recorder, own_writers=1, own_readers=2):
            raise CompositionError('another arm or controller is on these topics',
                                   'run again, or set ROS_DOMAIN_ID to a free number')

    def _matched(self) -> bool:
        commands, events = self.excitation.commands, self.trigger.events_publisher
        outputs = self.identifier.outputs.values()
        return (self.plant.joint_states.get_subscription_count() >= READERS
                and commands.get_subscription_count() >= 2 and events.get_subscription_count() >= 3
                and all(item.get_subscription_count() >= 1 for item in outputs))

    def start(self) -> None:
        """Begin: who listens first, the plant's clock last."""
        gc.collect()
        self._started = time.monotonic()
        gc.freeze()  # what lives from here on is not looked through again while the clock runs
        for node in self.managed:
            node.trigger_activate()

    @property
    def elapsed(self) -> float:
        """Seconds of the run that are recorded."""
        recorder = self.recorder
        return 0.0 if recorder.first_ns is None else (recorder.last_ns - recorder.first_ns) * 1e-9

    @property
    def finished(self) -> bool:
        """Whether the last sample of the run was recorded."""
        return self.recorder.joint_states >= round(self.config.duration * self.config.rate)

    def drain(self) -> None:
        """Stop the plant and let everybody take what is still on the way."""
        self.plant.trigger_deactivate()
        self.excitation.trigger_deactivate()
        sent, recorder, identifier = self.plant.samples, self.recorder, self.identifier
        self._spin_until(lambda: recorder.joint_states + recorder.losses.lost >= sent
                         and identifier.state.counters.received + identifier.losses.lost >= sent)
        identifier.trigger_deactivate()  # publishes the last model
        self._spin_until(lambda: sum(map(len, recorder.said.values())) >= identifier.published)

    def _spin_until(self, condition: Callable[[], bool]) -> None:
        limit = time.monotonic() + DRAIN_TIMEOUT
        while time.monotonic() < limit and not condition():
            self.executor.spin_once(timeout_sec=0.02)

    def facts(self) -> Facts:
        """Return what the run came to."""
        identifier, recorder = self.identifier, self.recorder
        return Facts(
            identifier.config, self.plant.config, self.elapsed, time.monotonic() - self._started,
            recorder.joint_states, recorder.losses.lost + identifier.losses.lost,
            identifier.meter.worst_p99_us(),
            recorder.said,
            str(recorder.failure) if recorder.failure is not None else '')

    def close(self) -> None:
        """Finish the bag, stop and destroy every node. May be called at any moment, and again."""
        for node in self._nodes:
            if isinstance(node, (FlexmanipNode, Recorder)):
                node.close()
        self.executor.shutdown()
        for node in self._nodes:
            node.destroy_node()
        self._nodes = []


def foreign_arm(node: Node, own_writers: int, own_readers: int) -> bool:
    """Tell whether somebody else publishes joint states or listens to efforts on this domain."""
    return bool(node.count_publishers('joint_states') > own_writers
                or node.count_subscribers('effort_controller/commands') > own_readers
                or node.count_publishers('effort_controller/commands') > own_writers)


def arguments(config: DemoParameters) -> list[str]:
    """Return the nodes' parameters as ROS arguments; what the user gives after them wins."""
    given = ['--ros-args']
    for node, values in settings(config).items():
        for leaf in leaves(NODES[node]):
            if leaf.name in values:
                given += ['-p', f'{node}:{leaf.name}:={written(leaf, values[leaf.name])}']
    return [*given, '--']
