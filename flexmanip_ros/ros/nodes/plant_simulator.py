"""Node ``plant_simulator``: the flexible two-link arm, stepped in real time.

subscribes  effort_controller/commands  std_msgs/Float64MultiArray  one torque per joint [N m], held
            capture_event               std_msgs/Header  the object is taken or let go at this stamp
publishes   joint_states                sensor_msgs/JointState  joint1, joint2, link1_bend, link2_bend
            /diagnostics                diagnostic_msgs/DiagnosticArray  1 Hz
services    plant_simulator/reset       std_srvs/Trigger  back to the start, at rest, empty, without torque

Stamps form the uniform grid activation + k / rate: after a late timer the node catches up and none is lost.
A command of the wrong size or with a value that is not finite is dropped whole.
"""

import math
import sys
from functools import partial
from typing import Any

import numpy as np
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, Header

from flexmanip_ros.errors import FlexmanipError
from flexmanip_ros.parameters import PlantParameters
from flexmanip_ros.ros import qos
from flexmanip_ros.ros.conversions import capture_event, to_message
from flexmanip_ros.ros.diagnostics import CLOCK, ERROR, WARN, LossCounter, Recent, Report, number
from flexmanip_ros.ros.node import FlexmanipNode, SampleGrid, run
from flexmanip_ros.simulation import simulator
from flexmanip_ros.types import CaptureEvent, EventKind

NAME = 'plant_simulator'
CATCH_UP = 5
"""Largest number of samples made in one timer callback, so that commands are taken between two callbacks."""
MOST_EVENTS = 100
"""Largest number of events that wait for their stamps."""


class PlantSimulator(FlexmanipNode[PlantParameters]):
    """Steps the plant along the grid of stamps and publishes every sample."""

    def __init__(self, **options: Any) -> None:
        super().__init__(NAME, PlantParameters, **options)
        self.state: simulator.PlantState
        self.efforts = np.zeros(len(self.config.arm.link_length))
        self.dropped_commands = 0
        self._drops = Recent()
        self.lost_commands = LossCounter()
        self.late_events = 0
        self.rejected_events = 0
        self.samples = 0
        self.published = 0
        """Number of samples that were published: those made, without those that ``sensors.drop_probability`` lost."""
        self.backlog = 0
        self._restarted_ns = 0
        self._pending: tuple[CaptureEvent, ...] = ()
        self.fault: FlexmanipError | None = None
        """What stopped the simulation; None while it runs."""

    def make_entities(self) -> None:
        """Create the publisher, the subscriptions, the service and the timer."""
        self.joint_states = self.publisher(JointState, 'joint_states', qos.sensor_output())
        self.subscription(Float64MultiArray, 'effort_controller/commands', self._on_command, qos.output(),
                          losses=self.lost_commands)
        self.subscription(Header, 'capture_event', self._on_event, qos.latched_input())
        self.trigger_service('~/reset', self._on_reset)
        self._grid = SampleGrid(self, self.config.rate, self._begin, self._advance)
        self._more = self.alarm(self._grid.tick) if self._grid.is_simulated else None

    def start(self) -> None:
        """Simulate a step, a capture and a release, so that nothing is compiled while the clock runs."""
        self.state = simulator.init(self.config)
        self._noise_std = self.state.noise_std
        state = simulator.attach(self.config, self.state)
        state, _ = simulator.step(self.config, state, np.zeros(len(self.config.arm.link_length)))
        simulator.release(self.config, state)

    def summary(self) -> str:
        """Say what is simulated."""
        return f'{self.config.rate:g} samples a second, object of {self.config.payload_mass:g} kg'

    def activated(self) -> None:
        """Begin the grid of stamps at sample 0."""
        self._grid.start()

    def deactivated(self) -> None:
        """Stop the grid of stamps, so that the arm stands still."""
        self._grid.stop()

    def _begin(self) -> None:
        self.samples = 0
        self._restart()

    def _restart(self) -> None:
        """Put the arm at its initial state from the next stamp on."""
        self._restarted_ns = self._stamp(self.samples)
        self.state = simulator.init(self.config, self._restarted_ns, self._noise_std)
        self._pending, self.fault, self.efforts = (), None, np.zeros(len(self.config.arm.link_length))

    def _stamp(self, index: int) -> int:
        return self._grid.start_ns + round(index * 1e9 / self.config.rate)

    def _advance(self, latest: int) -> None:
        """Make the samples up to the latest instant, at most ``CATCH_UP``."""
        self.backlog = latest + 1 - self.samples
        for _ in range(min(self.backlog, CATCH_UP)):
            if self.fault is not None:
                return
            with self.meter.timed():
                self._step()
        if self._more is not None and self.backlog > CATCH_UP:  # /clock, and with it the timer, may be slow
            self._more.after(0.0)

    def _step(self) -> None:
        try:
            self._apply_events(simulator.stamp(self.config, self.state))
            self.state, record = simulator.step(self.config, self.state, self.efforts)
        except FlexmanipError as error:
            self.fault = error
            self.get_logger().error(f'the simulation stopped: {error}; call {NAME}/reset to start again')
            return
        self.samples += 1
        if record is not None:  # None: lost on its way (sensors.drop_probability)
            self.joint_states.publish(to_message(record))
            self.published += 1

    def _apply_events(self, stamp: int) -> None:
        """Take or let go of the object before the first sample that is not older than the event."""
        while self._pending and self._pending[0].stamp_ns <= stamp:
            event, self._pending = self._pending[0], self._pending[1:]
            change = simulator.attach if event.kind is EventKind.CAPTURE else simulator.release
            self.state = change(self.config, self.state)

    def _on_command(self, message: Float64MultiArray) -> None:
        efforts = np.array(message.data)
        links = len(self.config.arm.link_length)
        if efforts.size != links:
            self._drop(f'a command has {efforts.size} values; send one torque for each of the {links} joints')
        elif not all(map(math.isfinite, efforts.tolist())):
            self._drop('a command has a value that is not finite; look at the controller')
        else:
            self.efforts = efforts

    def _drop(self, words: str) -> None:
        self.dropped_commands += 1
        self._drops.add(1)
        self.log_throttled('command', words)

    def _on_event(self, message: Header) -> None:
        try:
            event = capture_event(message)
        except FlexmanipError as error:
            self._reject_event(str(error))
            return
        if not self.active or event.stamp_ns < self._restarted_ns:
            self.get_logger().info(f'{event.kind.value} from before the start is ignored')
            return
        if len(self._pending) >= MOST_EVENTS:
            self._reject_event(f'{MOST_EVENTS} events wait for their stamps already; one more was rejected')
            return
        if self.samples and event.stamp_ns <= self._stamp(self.samples - 1):
            self.late_events += 1
            late_ms = (self._stamp(self.samples) - event.stamp_ns) * 1e-6
            self.log_throttled(
                'late event', f'{event.kind.value} came {late_ms:.1f} ms late and is applied now; raise lead_time or '
                'service_delay of capture_trigger', is_error=False)
        self._pending = tuple(sorted((*self._pending, event), key=lambda item: item.stamp_ns))

    def _reject_event(self, words: str) -> None:
        self.rejected_events += 1
        self.log_throttled('event', words)

    def _on_reset(self) -> tuple[bool, str]:
        if not self.active:
            return False, f'{NAME} is not active'
        if self._grid.is_running:
            if self.fault is not None:  # the samples since the fault are not made up for
                self.samples = max(self.samples, self._grid.latest() + 1)
            self._restart()
        words = 'the arm is at its start, at rest and empty'
        self.get_logger().info(f'reset: {words}')
        return True, words

    def report(self, report: Report) -> None:
        """Report the rate, the backlog, dropped commands and events that came late."""
        values = report.values
        values.update(samples=self.samples, backlog=self.backlog, dropped_commands=self.dropped_commands,
                      late_events=self.late_events, rejected_events=self.rejected_events)
        if self.fault is not None:
            report.worse(ERROR, str(self.fault))
        elif self.active and not self._grid.is_running:
            report.silent(CLOCK)
        elif self.active and values['rate_hz'] < 0.9 * self.config.rate:
            report.worse(WARN, f'{values["rate_hz"]:.0f} of {self.config.rate:.0f} samples a second')
        self._drops.report(report, 'command', 'dropped')
        self.lost_commands.report(report, 'lost_commands', 'command')
        if self.rejected_events:
            report.worse(WARN, f'{number(self.rejected_events, "event")} rejected')


main = partial(run, PlantSimulator, NAME, __doc__, PlantParameters)

if __name__ == '__main__':
    sys.exit(main())
