"""A network that loses joint states or holds them back, live: the bits of a replay, and estimates to be trusted."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest
from identifier_harness import CAPTURE, Live, recording, replayed
from ros_harness import Ros
from sensor_msgs.msg import JointState

from flexmanip_ros import messages
from flexmanip_ros.ros import conversions, qos
from flexmanip_ros.ros.demo import compare

SETTLED_NS = CAPTURE.stamp_ns + 600_000_000
"""From here on the payload is to be trusted."""
PORTION = 200
"""Messages that are under way at a time: what a busy machine has not read yet is not lost too."""


@pytest.mark.parametrize('case', ['bursts', 'jitter'])
def test_live_over_a_lossy_network_the_payload_is_trusted_and_a_replay_gives_the_same_bits(
        ros: Ros, monkeypatch: pytest.MonkeyPatch, case: str) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / 'benchmarks'))
    lossy = importlib.import_module('parts.lossy_relay')
    live = Live(ros)
    relay = ros.add(lossy.Relay(case, 1, context=ros.context))
    sent = ros.publisher(JointState, 'sent/joint_states', qos.sensor_output())
    ros.wait(lambda: live.node.losses.publishers == 2, what='the relay at the identifier')
    live.events.publish(conversions.to_message(CAPTURE))
    samples = recording(1600)
    for first in range(0, len(samples), PORTION):
        for record in samples[first:first + PORTION]:
            sent.publish(conversions.to_message(record))
        ros.wait(lambda first=first: relay.heard >= first + PORTION and not relay.held
                 and live.node.state.counters.received >= relay.passed, what='samples to be taken')
    live.finish()
    losses = lossy.Losses(case, 1)
    expected = replayed(live, [CAPTURE, *(record for record in samples if not losses.takes(record.stamp_ns))])
    ros.wait(lambda: all(len(live.said[name]) >= len(values) for name, values in expected.items()))
    assert compare({name: values for name, values in live.said.items() if values}, expected) == ''
    found = [entry for message in map(conversions.diagnostics, live.said[messages.STATUS])
             if message.stamp_ns >= SETTLED_NS for entry in message.statuses if entry.name == 'payload']
    assert len(found) > 25
    assert sum(dict(entry.values)['status'] == 'TRACKING' for entry in found) >= 0.95 * len(found)
