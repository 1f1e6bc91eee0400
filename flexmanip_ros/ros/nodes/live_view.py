"""Node ``live_view``: the arm, its signals, modes and payload live in a browser, on this machine alone.

It only listens: nothing on the page moves the arm or changes another node. The address of the page is in the log.

subscribes  joint_states      sensor_msgs/JointState  best effort, depth 5000; matched by name
            capture_event     std_msgs/Header         an event commanded or known
            capture_detected  std_msgs/Header         an event inferred from the signals
            rpbsid_identifier/status  diagnostic_msgs/DiagnosticArray  payload, modes, and what they are worth
publishes   /diagnostics      diagnostic_msgs/DiagnosticArray  1 Hz

A recording: live_view BAG [--params FILE.yaml] [--set name=value] [--speed 2] [--port 8765], without ROS.
"""

import sys
import time
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from std_msgs.msg import Header

from flexmanip_ros.errors import SignalError
from flexmanip_ros.parameters import ViewParameters
from flexmanip_ros.ros import qos
from flexmanip_ros.ros.conversions import JointStateReader, capture_event, diagnostics
from flexmanip_ros.ros.diagnostics import LossCounter, Report
from flexmanip_ros.ros.node import FlexmanipNode, run
from flexmanip_ros.view.screen import Screen, Source, encoded, page
from flexmanip_ros.view.server import BEAT_S, Server

NAME = 'live_view'


class LiveView(FlexmanipNode[ViewParameters]):
    """Takes the messages that wait at a rate of ``ViewParameters.rate``, and sends their content to the open pages."""

    server: Server | None = None
    """The web server of the page, which exists while the node is active."""

    def __init__(self, **options: Any) -> None:
        super().__init__(NAME, ViewParameters, **options)
        self.losses = LossCounter()
        self._reader = JointStateReader()

    def make_entities(self) -> None:
        """Create the subscriptions, and the timer whose callback takes their messages."""
        self._joint_states = self.waiting_joint_states(self.losses)
        self.subscription(DiagnosticArray, f'{self.config.identifier}/status', self._on_status, qos.sensor_input())
        self.each_event(self._on_event)
        self.create_timer(1.0 / self.config.rate, self._update, clock=self._steady)

    def summary(self) -> str:
        """Say where the page is."""
        return '' if self.server is None else self.server.invitation

    def activated(self) -> None:
        """Serve the page. Raises FlexmanipError when the port is not available."""
        self._screen = Screen(Source('Live', self.resolve_topic_name('joint_states'), self.config))
        self._counted = self._runs = self._reported = 0
        self._heard: float | None = None
        self._beaten = self._asked = time.monotonic()
        self.server = Server(page(self._screen.source), self.config.port, self._state)
        print(f'{NAME}: {self.server.invitation}', flush=True)

    def deactivated(self) -> None:
        """Close the server and its connections to the pages."""
        if self.server is not None:
            self.server.close()
            self.server = None

    def destroy_node(self) -> None:
        """Destroy the node and close its server, also where a signal came while the server was being made."""
        self.deactivated()
        super().destroy_node()

    def _state(self) -> dict[str, Any]:
        return {'samples': self._screen.samples, 'lost': self.losses.lost, 'runs': self._screen.runs}

    def _update(self) -> None:
        """Take every waiting message; send what is new to the pages."""
        with self.meter.timed():
            self._take()
            if self.server is None:
                return
            feed, now, screen = self.server.feed, time.monotonic(), self._screen
            if screen.runs != self._runs:
                self._runs = screen.runs
                feed.reset()
            frame = screen.frame()
            if 'events' in frame:
                feed.publish('frame', encoded({'events': frame.pop('events')}), lasting=True)
            if frame:
                feed.publish('frame', encoded(frame))
            if screen.samples != self._counted:
                self._counted, self._heard, self._beaten = screen.samples, now, now
            elif now - self._beaten >= BEAT_S / 2:
                self._beaten = now
                silent = None if self._heard is None else round(now - self._heard, 3)
                feed.publish('silence', encoded({'seconds': silent}))

    def _take(self) -> None:
        """Hand the waiting messages to the screen; a node that is not active drops them."""
        raws = [raw for raw, _ in self._joint_states.take()]
        if not self.active:
            return
        for block in self._reader.blocks(raws):
            if isinstance(block, SignalError):
                self.log_throttled('encoding', f'message dropped: {block}')
            else:
                self._screen.joint_states(block)

    def _on_status(self, message: DiagnosticArray) -> None:
        if self.active:
            self._screen.status(diagnostics(message))

    def _on_event(self, topic: str, message: Header) -> None:
        try:
            self._screen.event(capture_event(message))
        except SignalError as error:
            self.log_throttled('event', str(error))

    def report(self, report: Report) -> None:
        """Report the rate of the joint states, losses, and the number of open pages."""
        report.values['updates_hz'] = report.values['rate_hz']
        self.losses.report(report, 'lost', 'message')
        if self.server is None:
            return
        now, samples = time.monotonic(), self._screen.samples
        report.values['rate_hz'] = (samples - self._reported) / max(now - self._asked, 1e-3)
        self._reported, self._asked = samples, now
        report.values.update(samples=samples, pages=self.server.pages)
        if report.values['rate_hz'] == 0.0:
            report.silent('joint_states')


main = partial(run, LiveView, NAME, __doc__, ViewParameters)

if __name__ == '__main__':
    sys.exit(main())
