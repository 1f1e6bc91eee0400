"""QoS profiles of all topics. The standard ``qos_overrides`` parameters can change each of them."""

from functools import partial

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

SENSOR_DEPTH = 1000
"""Queue depth for joint states, a second at 1 kHz: a reader that stalls loses nothing (depths 5-10 lost 5-30 %)."""
GAPLESS_DEPTH = 5000
"""The same for a node that computes with each of them. Fast DDS keeps no more, whatever the depth (its default limit
``max_samples``). With Coulomb friction a fit computes for up to 6 s (docs/lab/payload.md, cost). With a queue of 1000
the identifier lost half of all messages, and after each gap the fits began again. Only messages that wait take memory.
"""


# Each of these is called for a new profile, because a QoS override changes the profile that it is given.
_reliable = partial(QoSProfile, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE)
sensor_output = partial(_reliable, depth=SENSOR_DEPTH)
"""Profile for publishing joint states: reliable, so that reliable and best-effort subscriptions match."""
sensor_input = partial(sensor_output, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Profile for subscribing to joint states: best effort, so that reliable and best-effort publishers match."""
gapless_input = partial(sensor_input, depth=GAPLESS_DEPTH)
"""The same for a node that needs each of them."""
output = partial(_reliable, depth=10)
"""Profile for effort commands, and for whatever has no other profile here."""
latched = partial(_reliable, depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Profile for publishing events, models and payloads: a late subscription still gets the last message."""
latched_input = partial(latched, depth=10)
"""Profile for subscribing to latched topics, deeper than ``latched``: two events in quick succession both arrive."""


def overridable() -> QoSOverridingOptions:
    """Declare the policies of a topic as parameters (``qos_overrides.<topic>.<entity>.<policy>``)."""
    return QoSOverridingOptions([
        QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY,
        QoSPolicyKind.DEADLINE, QoSPolicyKind.LIVELINESS, QoSPolicyKind.LIVELINESS_LEASE_DURATION,
    ])
