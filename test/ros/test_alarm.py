"""An alarm runs its callback once for each time that was asked for, and disturbs no timer."""

from __future__ import annotations

import time
from itertools import pairwise
from statistics import median

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from identifier_harness import Live, recording
from rclpy.node import Node
from ros_harness import Ros

from flexmanip_ros.ros import conversions, diagnostics
from flexmanip_ros.ros.rclpy_workarounds import Alarm


def test_it_comes_once_after_the_time_that_was_set_last_and_never_once_closed(ros: Ros) -> None:
    node = ros.add(Node('sleeper', context=ros.context))
    came: list[float] = []
    alarm = Alarm(node, lambda: came.append(time.monotonic()))
    began = time.monotonic()
    alarm.after(60.0)
    alarm.after(0.05)
    ros.wait(lambda: came)
    assert came[0] - began >= 0.05
    alarm.after(0.001)
    ros.wait(lambda: len(came) == 2)
    alarm.after(0.01)
    alarm.close()
    alarm._thread.join(10.0)
    assert not alarm._thread.is_alive()
    assert len(came) == 2


def test_what_it_raises_ends_the_executor_as_what_a_timer_raises(ros: Ros) -> None:
    def fail() -> None:
        raise LookupError('seen')

    alarm = Alarm(ros.add(Node('sleeper', context=ros.context)), fail)
    alarm.after(0.001)
    with pytest.raises(LookupError, match='seen'):
        ros.wait(lambda: False)
    alarm.close()


def test_diagnostics_come_once_a_second_while_samples_are_taken(ros: Ros) -> None:
    live = Live(ros, payload_method='none')
    samples, began = recording(), time.monotonic()
    for k, record in enumerate(samples * 6):
        live.joint_states.publish(conversions.to_message(record._replace(
            stamp_ns=samples[0].stamp_ns + 1_000_000 * k)))
        if k % 5 == 0:
            time.sleep(max(began + 1e-3 * k - time.monotonic(), 0.0))
    ros.wait(lambda: len(_own(live.diagnostics)) >= 4)
    stamps = [conversions.stamp_ns(message.header.stamp) for message in _own(live.diagnostics)]
    # the median: after a stall of the machine the late one and the next come together, once
    assert 0.5e9 < median(b - a for a, b in pairwise(stamps)) < 1.5e9


def test_samples_that_come_faster_than_they_are_computed_are_a_warning(
    ros: Ros, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(diagnostics, 'BUSY', 1e-6)  # this machine may be fast
    live = Live(ros, payload_method='none')
    live.send(*recording()[:200])
    ros.wait(lambda: any(diagnostics.TOO_SLOW in message.status[0].message for message in _own(live.diagnostics)))


def _own(heard: list[DiagnosticArray]) -> list[DiagnosticArray]:
    return [message for message in heard if message.status[0].name == '/rpbsid_identifier: status']
