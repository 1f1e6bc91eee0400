"""Made-up joint states for tests."""

from __future__ import annotations

import math
from collections.abc import Sequence

from sensor_msgs.msg import JointState

from flexmanip_ros.ros.conversions import time_message

NAMES = ('joint1', 'joint2', 'link1_bend', 'link2_bend')
START_NS = 1_700_000_000_000_000_000
STEP_NS = 1_000_000


def joint_state(k: int, names: Sequence[str] = NAMES, start_ns: int = START_NS) -> JointState:
    """Return sample k of a smooth motion, stamped start + k ms."""
    message = JointState()
    message.header.stamp = time_message(start_ns + k * STEP_NS)
    message.name = list(names)
    order = [sum(map(ord, name)) % 7 + 1 for name in names]
    message.position = [0.01 * math.sin(0.03 * i * (k + 1)) for i in order]
    message.velocity = [0.3 * i * math.cos(0.03 * i * (k + 1)) for i in order]
    message.effort = [10.0 * math.copysign(1.0, math.sin(0.0063 * i * (k + 1))) for i in order]
    return message
