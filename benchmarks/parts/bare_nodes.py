"""Publish and subscribe with nothing between: what the middleware and rclpy alone take. Use: ROLE RATE"""

from __future__ import annotations

import sys

import rclpy
from geometry_msgs.msg import InertiaStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState

from flexmanip_ros.io import cdr
from flexmanip_ros.ros import qos
from flexmanip_ros.ros.conversions import time_message
from flexmanip_ros.ros.node import with_info
from flexmanip_ros.ros.spin import Interrupt, make_executor, spin

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
        self.count += 1
        if self.count % EVERY == 0:
            answer = InertiaStamped()
            answer.header.stamp = time_message(cdr.stamp_ns(raw))
            self.answers.publish(answer)


def main() -> None:
    """Run one of the two until a signal."""
    interrupt = Interrupt()
    rclpy.init()
    node = Source(float(sys.argv[2])) if sys.argv[1] == 'source' else Echo()
    executor = make_executor()
    interrupt.install()
    executor.add_node(node)
    spin(executor, None, interrupt)
    executor.shutdown()


if __name__ == '__main__':
    main()
