"""Quality of service of every topic, each open to the standard ``qos_overrides`` parameters."""

from __future__ import annotations

from functools import partial

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

SENSOR_DEPTH = 1000
"""Keeps a second of samples at 1 kHz: a stall of the reader loses nothing (5-10 lost 5-30 %)."""


def _profile(depth: int, reliability: ReliabilityPolicy,
             durability: DurabilityPolicy = DurabilityPolicy.VOLATILE) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=reliability, durability=durability)


# Each makes a new profile, since an override changes the one that it is given.
sensor_output = partial(_profile, SENSOR_DEPTH, ReliabilityPolicy.RELIABLE)
"""Published joint states: reliable, so that both kinds of reader match."""
sensor_input = partial(_profile, SENSOR_DEPTH, ReliabilityPolicy.BEST_EFFORT)
"""Read joint states: best effort, so that both kinds of publisher match."""
command = partial(_profile, 10, ReliabilityPolicy.RELIABLE)
"""Efforts."""
latched = partial(_profile, 1, ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL)
"""Events, models and payloads: a subscriber that comes late still gets the last one."""
latched_input = partial(_profile, 10, ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL)
"""Read what is latched, deeper than it is written: two events in quick succession both arrive."""
output = partial(_profile, 10, ReliabilityPolicy.RELIABLE)
"""Everything else that the identifier publishes."""


def overridable() -> QoSOverridingOptions:
    """Declare the policies of a topic as parameters (``qos_overrides.<topic>.<entity>.<policy>``)."""
    return QoSOverridingOptions([
        QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY,
        QoSPolicyKind.DEADLINE, QoSPolicyKind.LIVELINESS, QoSPolicyKind.LIVELINESS_LEASE_DURATION,
    ])
