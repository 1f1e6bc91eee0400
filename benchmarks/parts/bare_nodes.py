"""The parties of the latency benchmark that do no work while it runs.

source, echo: publish and subscribe with nothing between, what the middleware and rclpy alone take; player:
the plant's run, simulated and encoded beforehand. Use: bare_nodes.py ROLE RATE [SECONDS]
"""

from __future__ import annotations

import sys
import time
from contextlib import suppress

import rclpy
from geometry_msgs.msg import InertiaStamped
from rclpy.node import Node
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState

from flexmanip_ros.io import cdr
from flexmanip_ros.parameters import ExcitationParameters, PlantParameters, configure
from flexmanip_ros.ros import qos
from flexmanip_ros.ros.conversions import time_message, to_message
from flexmanip_ros.ros.rclpy_workarounds import make_executor, spin, with_info
from flexmanip_ros.simulation import excitation, simulator

EVERY = 20
"""Samples to an estimate: 50 Hz at 1 kHz."""


class Source(Node):
    """A clock that publishes a joint state."""

    def __init__(self, rate: float) -> None:
        super().__init__('bare_source')
        self.message = JointState(
            name=['joint1', 'joint2', 'link1_bend', 'link2_bend'], position=[0.0] * 4, velocity=[0.0] * 4,
            effort=[0.0] * 4)
        self.states = self.create_publisher(JointState, 'joint_states', qos.sensor_output())
        self.create_timer(1.0 / rate, self.tick)

    def tick(self) -> None:
        """Publish one."""
        self.message.header.stamp = self.get_clock().now().to_msg()
        self.states.publish(self.message)


class Echo(Node):
    """Takes the bytes of every sample, answers some."""

    def __init__(self) -> None:
        super().__init__('rpbsid_identifier')
        self.count = 0
        self.answers = self.create_publisher(InertiaStamped, '~/payload', qos.latched())
        self.create_subscription(
            JointState, 'joint_states', with_info(self.take), qos.sensor_input(), raw=True)

    def take(self, raw: bytes, info: object) -> None:
        """Count a sample."""
        self.count += 1
        if self.count % EVERY == 0:
            answer = InertiaStamped()
            answer.header.stamp = time_message(cdr.stamp_ns(raw))
            self.answers.publish(answer)


class Player(Node):
    """Publishes a run made beforehand, at its own pace."""

    def __init__(self, rate: float, seconds: float) -> None:
        super().__init__('player')
        plant = configure(PlantParameters, {'rate': rate})
        torque = excitation.sequence(configure(ExcitationParameters, {'rate': rate}), round(seconds * rate))
        made = simulator.simulate(plant, torque, (), 0)
        self.messages = [serialize_message(to_message(item)) for item in simulator.records(made)]
        self.sent, self.rate = 0, rate
        self.began: float | None = None
        self.states = self.create_publisher(JointState, 'joint_states', qos.sensor_output())
        self.create_timer(1.0 / rate, self.tick)

    def tick(self) -> None:
        """Publish what is due by now: a timer of 4 kHz does not keep every turn."""
        if self.began is None:
            self.began = time.perf_counter()
        due = int((time.perf_counter() - self.began) * self.rate) + 1
        for message in self.messages[self.sent:due]:
            self.states.publish(message)
        self.sent = max(self.sent, due)


def main() -> None:
    """Run one of the two until a signal."""
    rclpy.init()
    role, rate = sys.argv[1], float(sys.argv[2])
    node: Node = Echo() if role == 'echo' else Source(rate) if role == 'source' else Player(
        rate, float(sys.argv[3]))
    executor = make_executor()
    executor.add_node(node)
    with suppress(KeyboardInterrupt):
        spin(executor)
    executor.shutdown()


if __name__ == '__main__':
    main()
