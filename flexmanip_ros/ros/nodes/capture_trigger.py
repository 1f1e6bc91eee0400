"""Node ``capture_trigger``: publishes when the arm took or let go of an object.

mode service  `capture_trigger/capture` and `capture_trigger/release` announce an event `service_delay` later
mode time     the first sample starts the count; events come at `capture_time` and `release_time`, each
              announced `lead_time` ahead, so that every node applies it at the same stamp
mode auto     events are found in the signals and go out on `capture_detected` (the services work too)

subscribes  joint_states      sensor_msgs/JointState  best effort, depth 5000; its stamps are the clock
publishes   capture_event     std_msgs/Header         stamp: the instant, frame_id: capture | release
            capture_detected  std_msgs/Header         the same, for what mode auto inferred (both latched)
            /diagnostics      diagnostic_msgs/DiagnosticArray  1 Hz
services    capture_trigger/capture, capture_trigger/release   std_srvs/Trigger
"""

import math
import sys
import time
from functools import partial
from typing import Any

import numpy as np
from rclpy.publisher import Publisher
from std_msgs.msg import Header

from flexmanip_ros.errors import SignalError
from flexmanip_ros.parameters import IdentifierParameters, TriggerParameters
from flexmanip_ros.payload import capture_detection, structured
from flexmanip_ros.ros import qos
from flexmanip_ros.ros.conversions import JointStateReader, to_message
from flexmanip_ros.ros.diagnostics import RECENT_S, WARN, JointStateFaults, Recent, Report, number
from flexmanip_ros.ros.node import NO_STAMP, FlexmanipNode, run
from flexmanip_ros.samples.signals import joints
from flexmanip_ros.types import LOOPED_NS, CaptureEvent, EventKind, JointRecord, events_at

NAME = 'capture_trigger'
MOST_REQUESTS = 1000
"""Number of requests since a joint state that have stamps of their own, 1 ns apart: at one stamp the identifier takes a
release before a capture."""
WARM_UP_SAMPLES = 200
"""Number of made-up samples: the detector begins, and its fit takes a few steps. No arm swings as they do, so a fit
that goes on until its horizon closes takes up to 10 s."""


def warm_up(config: TriggerParameters) -> None:
    """Run the detector once on made-up samples, so that nothing is compiled or loaded while real ones come."""
    watch, names = capture_detection.watching(config), joints(config)
    for k in range(WARM_UP_SAMPLES):
        wave = np.array([math.sin(0.05 * k * (i + 1)) for i in range(len(names))]) * 1e-3
        watch, _ = capture_detection.look(watch, JointRecord(k * 1_000_000, names, wave, wave * 0.0, wave * 1e3))
    if watch.state is not None:  # judges the fit, as the detector does before it begins one again
        structured.estimate(watch.state.identifier, watch.state.filter)


def _began(watch: capture_detection.Watch) -> int | None:
    """Return the row at which the detection began, or began again after a gap; None before it does."""
    return None if watch.state is None else watch.state.since


class CaptureTrigger(FlexmanipNode[TriggerParameters]):
    """Announces captures and releases, with times from the stamps of the joint states."""

    def __init__(self, **options: Any) -> None:
        super().__init__(NAME, TriggerParameters, **options)
        self._first_ns: int | None = None
        self._last_ns: int | None = None
        self._before_ns: int | None = None
        """Stamp of the joint state before the last one [ns]."""
        self._arrived = -1.0
        self._pending: tuple[CaptureEvent, ...] = ()
        self._watch: capture_detection.Watch | None = None
        self._reader = JointStateReader()
        self.detected = self.announced = 0
        """Number of events published on capture_detected, and on capture_event."""
        self.latest: CaptureEvent | None = None
        self.faults = JointStateFaults(joints(self.config), self.resolve_topic_name('joint_states'))
        self._restarts = Recent()
        """How often the detection began again, after a gap or a jump of the stamps."""

    def make_entities(self) -> None:
        """Create the publishers, the subscription and the services."""
        self.events_publisher = self.publisher(Header, 'capture_event', qos.latched())
        self.detected_publisher = self.publisher(Header, 'capture_detected', qos.latched())
        self.each_joint_state(self._on_joint_state, self.faults.losses)
        for kind in EventKind:
            self.trigger_service(f'~/{kind.value}', partial(self._requested, kind))

    def start(self) -> None:
        """Compile or load what mode auto needs, before the first sample."""
        if self.config.mode == 'auto':
            warm_up(self.config)

    def summary(self) -> str:
        """Say how events are found."""
        config = self.config
        if config.mode == 'time':
            plan = (('capture', config.capture_time), ('release', config.release_time))
            times = ''.join(f', {name} after {seconds:g} s' for name, seconds in plan if seconds >= 0.0)
            return f'mode time{times or ", no event: capture_time and release_time are negative"}'
        return f'mode {config.mode}' + (f', signals {", ".join(config.outputs)}' if config.mode == 'auto' else '')

    def activated(self) -> None:
        """Count time from the next sample on; in mode auto, look for events from there on."""
        self._watch = capture_detection.watching(self.config) if self.config.mode == 'auto' else None
        self._first_ns = self._last_ns = self._before_ns = self.latest = None
        self._pending = ()

    def _on_joint_state(self, raw: bytes) -> None:
        stamp = self.stamp_of(raw)
        if stamp is None:
            return
        self._arrived = time.monotonic()
        if stamp != NO_STAMP:
            self._keep_time(stamp)
        if self._watch is not None:
            self._watch = self._detect(self._watch, raw)

    def _keep_time(self, stamp: int) -> None:
        """Announce the events that are due at a stamp [ns]."""
        if self._first_ns is None or self._is_new_recording(stamp):
            self._begin(stamp)
        self._before_ns, self._last_ns = self._last_ns, stamp
        while self._pending and stamp >= self._pending[0].stamp_ns - int(self.config.lead_time * 1e9):
            self._announce(self._pending[0])
            self._pending = self._pending[1:]

    def _is_new_recording(self, stamp: int) -> bool:
        """Return whether the stamp went back to a new recording, not from a single wrong stamp to the right ones."""
        if self._last_ns is None or stamp >= self._last_ns - LOOPED_NS:
            return False
        return self._before_ns is None or not 0 <= stamp - self._before_ns <= LOOPED_NS

    def _detect(self, before: capture_detection.Watch, raw: bytes) -> capture_detection.Watch:
        """Publish the events that the sample reveals (mode auto)."""
        try:
            record = self._reader(raw)
        except SignalError as error:
            self.log_throttled('encoding', f'message dropped: {error}')
            return before
        watch, events = capture_detection.look(before, record)
        for event in events:
            self._publish(self.detected_publisher, event, 'detected ')
            self.detected += 1
        self.log_dropped(self.faults.note(before.clock, watch.clock, record.names))
        began = _began(before)
        if began is not None and _began(watch) != began:
            self._log_restart(watch.clock.counters.resets > before.clock.counters.resets)
        return watch

    def _log_restart(self, jumped: bool) -> None:
        """Warn that the detection began again. jumped: after a jump of the stamps, otherwise after a gap."""
        self._restarts.add(1)
        words = (f'with an empty arm: {self.faults.jumped()}' if jumped else
                 'after a gap in the joint states: a capture or release in the gap, or within '
                 f'{capture_detection.SETTLE:g} s after it, is not found')
        self.log_throttled('restart', f'the detection begins again {words}', is_error=False)

    def _begin(self, stamp: int) -> None:
        """Plan the events of mode time from the first stamp."""
        self._first_ns = stamp
        self._pending, self.latest = (), None
        if self.config.mode != 'time':
            return
        planned = events_at(stamp, self.config.capture_time, self.config.release_time)
        self._pending = tuple(sorted(planned, key=lambda event: event.stamp_ns))

    def _announce(self, event: CaptureEvent) -> None:
        self._publish(self.events_publisher, event, '')
        self.announced += 1

    def _publish(self, publisher: Publisher, event: CaptureEvent, how: str) -> None:
        publisher.publish(to_message(event))
        note = self._after_the_last(event)
        self.latest = event
        self.get_logger().info(f'{event.kind.value} {how}at {event.stamp_ns * 1e-9:.6f}{note}')

    def _after_the_last(self, event: CaptureEvent) -> str:
        """Return the words for an event of the same kind as the last one; empty for any other event."""
        if self.latest is None or self.latest.kind is not event.kind:
            return ''
        words = ''
        if event.kind is EventKind.CAPTURE:
            words = ': the arm holds an object already, a second one is added (call release first if it let go)'
        merge_s = IdentifierParameters.event_merge_time
        if abs(event.stamp_ns - self.latest.stamp_ns) <= merge_s * 1e9:
            words += (f'; an identifier takes this {event.kind.value} and the one before for one, as they are within '
                      f'its event_merge_time (default {merge_s:g} s)')
        return words

    def _requested(self, kind: EventKind) -> tuple[bool, str]:
        silent = time.monotonic() - self._arrived
        if not self.active:
            return False, f'{NAME} is not active'
        if self._last_ns is None:
            return False, 'no joint_states with a stamp came yet, so the instant has no stamp; start the arm first'
        if silent > self.config.stale_after:
            return False, f'no joint_states for {silent:.1f} s; is the driver alive?'
        stamp = self._last_ns + round(self.config.service_delay * 1e9)
        if self.latest is not None and 0 <= self.latest.stamp_ns - stamp < MOST_REQUESTS:  # since the same joint state
            stamp = self.latest.stamp_ns + 1
        event = CaptureEvent(stamp, kind)
        words = f'{kind.value} at {event.stamp_ns * 1e-9:.6f}{self._after_the_last(event)}'
        self._announce(event)
        return True, words

    def report(self, report: Report) -> None:
        """Report the rate of the joint states, losses, faults and restarts of the detection, and the events."""
        report.values.update(mode=self.config.mode, announced=self.announced, pending=len(self._pending))
        self.report_faults(report, self.faults)
        report.busy('publish joint states less often, or end other programs')
        if self._watch is not None:
            statistic, threshold = self._watch.statistic
            counters, restarts = self._watch.clock.counters, self._restarts.count()
            report.values.update(counters._asdict(), dropped=counters.dropped, detected=self.detected,
                                 statistic=statistic, threshold=threshold)
            if restarts:
                report.worse(WARN, f'{number(restarts, "restart")} of the detection in the last {RECENT_S:.0f} s: '
                             'a capture or release may have been missed')
        if self.active and report.values['rate_hz'] == 0.0:
            report.silent('joint_states')


main = partial(run, CaptureTrigger, NAME, __doc__, TriggerParameters)

if __name__ == '__main__':
    sys.exit(main())
