"""Node ``excitation``: a torque source that moves the arm so that its payload shows.

subscribes  joint_states                sensor_msgs/JointState  only with `clock: joint_states`
publishes   effort_controller/commands  std_msgs/Float64MultiArray  one torque per joint [N m], at `rate`
            /diagnostics                diagnostic_msgs/DiagnosticArray  1 Hz

Sample k of the torque belongs k / rate seconds after activation, or after the first joint state (`clock`).
When the node is deactivated or stopped it sends zero torque once.
"""

import sys
from functools import partial
from typing import Any

import numpy as np
from std_msgs.msg import Float64MultiArray

from flexmanip_ros.parameters import ExcitationParameters
from flexmanip_ros.ros import qos
from flexmanip_ros.ros.conversions import doubles
from flexmanip_ros.ros.diagnostics import CLOCK, WARN, Report
from flexmanip_ros.ros.node import NO_STAMP, FlexmanipNode, SampleGrid, run
from flexmanip_ros.simulation import excitation
from flexmanip_ros.types import Array

NAME = 'excitation'


class Excitation(FlexmanipNode[ExcitationParameters]):
    """Publishes the torque that belongs to the present instant."""

    def __init__(self, **options: Any) -> None:
        super().__init__(NAME, ExcitationParameters, **options)
        self._last = -1
        self._first_ns: int | None = None
        self.skipped = 0

    def make_entities(self) -> None:
        """Create the publisher, and the timer or the subscription whose callback sends each torque."""
        self.commands = self.publisher(Float64MultiArray, 'effort_controller/commands', qos.output())
        self._grid: SampleGrid | None = None
        if self.config.clock == 'joint_states':
            self.each_joint_state(self._on_joint_state)
        else:
            self._grid = SampleGrid(self, self.config.rate, self._begin, self._tick)

    def start(self) -> None:
        """Compute one sample, so that the first one is not late; log the payload accuracy that a design will reach."""
        excitation.torque(self.config, 0)
        if self.config.allowed_angle or self.config.shape in ('multisine', 'prbs', 'chirp'):
            self.get_logger().info(excitation.describe(self.config))

    def check_change(self, config: ExcitationParameters) -> None:
        """Reject amplitudes and offsets that ``allowed_angle`` does not allow; fit the others before they are used."""
        excitation.amplitude(config)

    def summary(self) -> str:
        """Say which torque it is."""
        config = self.config
        peaks = ' and '.join(f'{peak:g}' for peak in config.amplitude)
        is_simulated = self._grid is not None and self._grid.is_simulated
        clock = f'{CLOCK} (use_sim_time is true)' if is_simulated else config.clock
        return f'{config.shape} of {peaks} N m at {config.rate:g} Hz, clock {clock}'

    def activated(self) -> None:
        """Begin the sequence: sample 0 is now, or with ``clock: joint_states`` at the first joint state."""
        self._first_ns = None
        if self._grid is not None:
            self._grid.start()

    def deactivated(self) -> None:
        """Stop the timer and send zero torque once."""
        if self._grid is not None:
            self._grid.stop()
        self._send(np.zeros(len(self.config.amplitude)))

    def _begin(self) -> None:
        self._last = -1

    def _tick(self, latest: int) -> None:
        with self.meter.timed():
            self._instant(latest)

    def _on_joint_state(self, raw: bytes) -> None:
        """Send the torque that the arm needs at the sample after this one."""
        stamp = self.stamp_of(raw)
        if stamp is None or stamp == NO_STAMP:
            return
        if self._first_ns is None or stamp < self._first_ns:
            self._first_ns, self._last = stamp, 0
        self._instant(round((stamp - self._first_ns) * 1e-9 * self.config.rate) + 1)

    def _instant(self, latest: int) -> None:
        if latest == self._last:
            return
        self.skipped += max(latest - self._last - 1, 0)
        self._last = latest
        self._send(excitation.torque(self.config, latest))

    def _send(self, torque: Array) -> None:
        self.commands.publish(Float64MultiArray(data=doubles(torque)))

    def report(self, report: Report) -> None:
        """Report the rate and the number of instants that passed without a command."""
        report.values.update(skipped_instants=self.skipped, shape=self.config.shape)
        if self.active and self.config.clock == 'joint_states' and report.values['rate_hz'] == 0.0:
            report.silent('joint_states')
        elif self.active and self._grid is not None and not self._grid.is_running:
            report.silent(CLOCK)
        elif self.active and report.values['rate_hz'] < 0.9 * self.config.rate:
            report.worse(WARN, f'{report.values["rate_hz"]:.0f} of {self.config.rate:.0f} commands a second')


main = partial(run, Excitation, NAME, __doc__, ExcitationParameters)

if __name__ == '__main__':
    sys.exit(main())
