"""A network that loses or delays joint states, and a node that stands for it between plant and identifier.

It reads sent/joint_states and publishes joint_states, best effort, in the order in which they were sent, as one
publisher's messages arrive over DDS. Use: lossy_relay.py CASE [SEED]
"""

from __future__ import annotations

import sys
import time
from collections import deque
from contextlib import suppress
from typing import Any

import numpy as np
import rclpy
from rclpy.node import Node
from sensor_msgs.msg import JointState

from flexmanip_ros.io import cdr
from flexmanip_ros.ros import qos
from flexmanip_ros.ros.rclpy_workarounds import make_executor, spin

CASES = ('none', '1 %', '5 %', 'bursts', 'jitter')
SHARES = {'1 %': 0.01, '5 %': 0.05}
BURST_S = (0.01, 0.1)
"""Shortest and longest burst; one begins at a random time of every second."""
JITTER_S = 0.1
"""Messages wait up to so long and come together."""
TICK_S = 0.002


class Losses:
    """Which messages are lost, by their stamps."""

    def __init__(self, case: str, seed: int) -> None:
        self.case, self.rng = case, np.random.default_rng(seed)
        self.second, self.burst = -1, (0.0, 0.0)

    def takes(self, stamp_ns: int) -> bool:
        """Return whether this message is lost."""
        if self.case in SHARES:
            return bool(self.rng.random() < SHARES[self.case])
        if self.case != 'bursts':
            return False
        second, rest = divmod(stamp_ns, 1_000_000_000)
        if second != self.second:
            length = self.rng.uniform(*BURST_S)
            begin = self.rng.uniform(0.0, 1.0 - length)
            self.second, self.burst = second, (begin, begin + length)
        return self.burst[0] <= rest * 1e-9 < self.burst[1]


class Relay(Node):
    """Passes on what is not lost, at once or late."""

    def __init__(self, case: str, seed: int, **options: Any) -> None:
        super().__init__('lossy_relay', **options)
        self.losses, self.late = Losses(case, seed), case == 'jitter'
        self.rng = np.random.default_rng(seed)
        self.held: deque[bytes] = deque()
        self.release = 0.0
        self.heard = self.passed = 0
        self.states = self.create_publisher(JointState, 'joint_states', qos.sensor_input())
        self.create_subscription(JointState, 'sent/joint_states', self.take, qos.sensor_input(), raw=True)
        if self.late:
            self.create_timer(TICK_S, self.tick)

    def take(self, raw: bytes) -> None:
        """Lose a message, pass it on, or hold it."""
        self.heard += 1
        if self.losses.takes(cdr.stamp_ns(raw)):
            return
        self.held.append(raw)
        if not self.late:
            self.pass_on()

    def tick(self) -> None:
        """Pass on what was held, and draw when to do it again."""
        now = time.monotonic()
        if now < self.release:
            return
        self.pass_on()
        self.release = now + self.rng.uniform(0.0, JITTER_S)

    def pass_on(self) -> None:
        """Publish what is held, in its order."""
        while self.held:
            self.states.publish(self.held.popleft())
            self.passed += 1


def main() -> None:
    """Run the relay until a signal."""
    rclpy.init()
    executor = make_executor()
    executor.add_node(Relay(sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 1))
    with suppress(KeyboardInterrupt):
        spin(executor)
    executor.shutdown()


if __name__ == '__main__':
    main()
