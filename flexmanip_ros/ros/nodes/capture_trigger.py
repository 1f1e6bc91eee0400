"""Node ``capture_trigger``: says when the arm took or let go of an object.

mode service  `capture_trigger/capture` and `capture_trigger/release` announce an event `service_delay` later
mode time     the first sample starts the count; events come at `capture_time` and `release_time`, each
              announced `lead_time` ahead, so that everybody applies it at the same stamp
mode auto     events are found in the signals and go out on `capture_detected` (the services work too)

subscribes  joint_states      sensor_msgs/JointState  best effort, depth 1000; its stamps are the clock
publishes   capture_event     std_msgs/Header         stamp: the instant, frame_id: capture | release
            capture_detected  std_msgs/Header         the same, for what mode auto inferred (both latched)
            /diagnostics      diagnostic_msgs/DiagnosticArray  1 Hz
services    capture_trigger/capture, capture_trigger/release   std_srvs/Trigger
"""

from __future__ import annotations

import sys
import time

from rclpy.context import Context
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from flexmanip_ros.errors import SignalError
from flexmanip_ros.parameters import TriggerParameters
from flexmanip_ros.ros import qos
from flexmanip_ros.ros.auto_mode import Watcher, rehearse
from flexmanip_ros.ros.conversions import JointStateReader, header
from flexmanip_ros.ros.diagnostics import STALE, Meter, Report
from flexmanip_ros.ros.node import FlexmanipNode
from flexmanip_ros.ros.spin import run
from flexmanip_ros.types import CaptureEvent, EventKind

NAME = 'capture_trigger'
LOOPED_NS = 1_000_000_000
"""Stamps that go back further than this are a new recording, and the count begins again."""


class Told:
    """How many events were told, and the latest of them."""

    def __init__(self) -> None:
        self.count = 0
        self.latest: CaptureEvent | None = None

    def note(self, event: CaptureEvent) -> None:
        """One more."""
        self.count, self.latest = self.count + 1, event


class CaptureTrigger(FlexmanipNode[TriggerParameters]):
    """Announces events on the clock of the joint states."""

    def __init__(self, *, context: Context | None = None, overrides: list[Parameter] | None = None,
                 namespace: str | None = None, cli_args: list[str] | None = None) -> None:
        super().__init__(NAME, TriggerParameters, context=context, overrides=overrides,
                         namespace=namespace, cli_args=cli_args)
        self._meter = Meter()
        self._first_ns: int | None = None
        self._last_ns: int | None = None
        self._before_ns: int | None = None
        """Stamp before the last."""
        self._arrived = -1.0
        self._pending: tuple[CaptureEvent, ...] = ()
        self._watcher: Watcher | None = None
        self._reader = JointStateReader()
        self.detected = Told()
        self.announced = Told()

    def make_entities(self) -> None:
        """Publishers, subscription and services."""
        self.events_publisher = self.publisher(Header, 'capture_event', qos.latched())
        self.detected_publisher = self.publisher(Header, 'capture_detected', qos.latched())
        self.subscription(JointState, 'joint_states', self._on_joint_states, qos.sensor_input(), raw=True)
        self.create_service(Trigger, '~/capture', self._on_capture)
        self.create_service(Trigger, '~/release', self._on_release)

    def start(self) -> None:
        """Compile or load what mode auto needs, before the first sample."""
        if self.config.mode == 'auto':
            rehearse(self.config)

    def activated(self) -> None:
        """Count from the next sample, and watch from there on."""
        self._watcher = Watcher(self.config) if self.config.mode == 'auto' else None
        self._first_ns = self._last_ns = self._before_ns = None
        self._pending = ()

    def _on_joint_states(self, raw: bytes) -> None:
        if not self.active:
            return
        with self._meter:
            stamp = self.stamp_of(raw)
            if stamp is None:
                return
            self._arrived = time.monotonic()
            if self._first_ns is None or self._is_anew(stamp):
                self._begin(stamp)
            self._before_ns, self._last_ns = self._last_ns, stamp
            while self._pending and stamp >= self._pending[0].stamp_ns - int(self.config.lead_time * 1e9):
                self._announce(self._pending[0])
                self._pending = self._pending[1:]
            if self._watcher is not None:
                self._watch(self._watcher, raw)

    def _is_anew(self, stamp: int) -> bool:
        """Say whether stamps went back to a new recording, and not from one wrong stamp to the right ones."""
        if self._last_ns is None or stamp >= self._last_ns - LOOPED_NS:
            return False
        return self._before_ns is None or not 0 <= stamp - self._before_ns <= LOOPED_NS

    def _watch(self, watcher: Watcher, raw: bytes) -> None:
        """Mode auto: tell what the sample reveals."""
        dropped = watcher.counters.dropped
        try:
            record = self._reader(raw)
        except SignalError as error:
            self.log_throttled('encoding', f'message dropped: {error}')
            return
        for event in watcher.take(record):
            self.detected_publisher.publish(header(event))
            self.detected.note(event)
            self.get_logger().info(f'{event.kind.value} detected at {event.stamp_ns * 1e-9:.6f}')
        if watcher.counters.dropped > dropped and watcher.rejection is not None:
            self.log_throttled(watcher.rejection.reason,
                          f'message dropped: {watcher.rejection.problem}; {watcher.rejection.remedy}')

    def _begin(self, stamp: int) -> None:
        """Plan the events of mode time from the first stamp."""
        self._first_ns = stamp
        self._pending = ()
        if self.config.mode != 'time':
            return
        plan = ((self.config.capture_time, EventKind.CAPTURE), (self.config.release_time, EventKind.RELEASE))
        self._pending = tuple(sorted(
            (CaptureEvent(stamp + round(seconds * 1e9), kind) for seconds, kind in plan if seconds >= 0.0),
            key=lambda event: event.stamp_ns))

    def _announce(self, event: CaptureEvent) -> None:
        self.events_publisher.publish(header(event))
        self.announced.note(event)
        self.get_logger().info(f'{event.kind.value} at {event.stamp_ns * 1e-9:.6f}')

    def _on_capture(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        return self._requested(EventKind.CAPTURE, response)

    def _on_release(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        return self._requested(EventKind.RELEASE, response)

    def _requested(self, kind: EventKind, response: Trigger.Response) -> Trigger.Response:
        silent = time.monotonic() - self._arrived
        if not self.active:
            response.success, response.message = False, f'{NAME} is not active'
        elif self._last_ns is None:
            response.success = False
            response.message = 'no joint_states came yet, so the instant has no stamp; start the arm first'
        elif silent > self.config.stale_after:
            response.success = False
            response.message = f'no joint_states for {silent:.1f} s; is the driver alive?'
        else:
            event = CaptureEvent(self._last_ns + round(self.config.service_delay * 1e9), kind)
            self._announce(event)
            response.success, response.message = True, f'{kind.value} at {event.stamp_ns * 1e-9:.6f}'
        return response

    def report(self, report: Report) -> None:
        """Rate of the joint states and what was announced."""
        report.values.update(self._meter.window())
        report.values['mode'] = self.config.mode
        report.values['announced'] = self.announced.count
        report.values['pending'] = len(self._pending)
        if self._watcher is not None:
            report.values['detected'] = self.detected.count
            report.values['dropped'] = self._watcher.counters.dropped
            report.values['statistic'], report.values['threshold'] = self._watcher.statistic
        if self.active and report.values['rate_hz'] == 0.0:
            report.worse(STALE, 'no joint_states')


def main(argv: list[str] | None = None) -> int:
    """Run the node."""
    return run(CaptureTrigger, NAME, __doc__, TriggerParameters, argv)


if __name__ == '__main__':
    sys.exit(main())
