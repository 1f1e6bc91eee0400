"""Node ``payload_controller``: holds the joints and damps vibration, with gains that follow the payload.

subscribes  joint_states                        sensor_msgs/JointState  best effort; a torque for each sample
            rpbsid_identifier/payload_estimate  std_msgs/Float64MultiArray  mass, std, interval, consistency
            rpbsid_identifier/payload_body      std_msgs/Float64MultiArray  its centre of mass and inertia
            ~/added_efforts                     std_msgs/Float64MultiArray  torques to add (excitation) [N m]
publishes   effort_controller/commands          std_msgs/Float64MultiArray  one torque per joint [N m]
            /diagnostics                        diagnostic_msgs/DiagnosticArray  1 Hz

An estimate changes the gains only when it is trusted: in range, confident, consistent; the gains follow it no
faster than `payload_rate` and take over within `blend_time`. Without estimates the gains stay, and /diagnostics warns.
Without joint states for `stale_after`, and when the node is deactivated or stopped, it sends zero torque once. An
example of a consumer, not a safety controller.
"""

import sys
import time
from collections.abc import Collection, Iterable
from functools import partial
from typing import Any

import numpy as np
from std_msgs.msg import Float64MultiArray

from flexmanip_ros.control import controller, handover
from flexmanip_ros.control.handover import PayloadEstimate, Verdict
from flexmanip_ros.errors import SignalError
from flexmanip_ros.parameters import ControllerParameters
from flexmanip_ros.ros import qos
from flexmanip_ros.ros.conversions import JointStateReader, doubles
from flexmanip_ros.ros.diagnostics import ERROR, WARN, Recent, Report, Stamps
from flexmanip_ros.ros.node import FlexmanipNode, run
from flexmanip_ros.types import LOOPED_NS, Array, JointRecord

NAME = 'payload_controller'
LONG_GAP = 10
"""Longest gap, in sample times, that the filter bridges with its prediction; after a longer one it starts again."""
AT_LIMIT_S = 0.5
"""Time at the limits of the torque, less the time within them, after which the log warns [s]: no move takes that."""
LARGEST = 1e6
"""Bound on an angle, bend or rate, in SI units, that no arm exceeds; joint states beyond it are dropped."""
RATE_TOLERANCE = 0.2
"""Share by which the rate of the stamps may differ from ``rate``, and share of the joint states that may be missing."""
NOT_FINITE = ('a computed torque was not finite: zero torque was sent, and the control begins again at the present '
              'angles; check the parameters arm.*, setpoint and effort_limit')
"""What the log and /diagnostics say of such a torque."""


class PayloadController(FlexmanipNode[ControllerParameters]):
    """Publishes one torque per joint for every joint state."""

    def __init__(self, **options: Any) -> None:
        super().__init__(NAME, ControllerParameters, **options)
        self.state: controller.ControllerState
        self._estimate: PayloadEstimate | None = None
        self._arrivals = handover.Arrivals()
        self._body: tuple[float, ...] | None = None
        self.dropped = self.foreign = 0
        """Number of messages that could not be used, and of joint states with none of the joints and bends."""
        self._drops = Recent()
        self._came: set[bool] = set()
        """Of the joint states since the last report: whether they have any of the joints and bends."""
        self.not_finite = 0
        self.sent = 0
        self._added, self._added_at = np.zeros(len(self.config.joints)), -np.inf
        self._last_ns: int | None = None
        self._arrived = np.inf
        self._stamps = Stamps()
        self._reader = JointStateReader()
        self._goal: Array | None = None
        self._at_limit = 0
        self._too_heavy = False

    def make_entities(self) -> None:
        """Create the publisher, the subscriptions, and the timer that notices when joint states cease."""
        self._commands = self.publisher(Float64MultiArray, 'effort_controller/commands', qos.output())
        self.each_joint_state(self._on_joint_state)
        self.subscription(Float64MultiArray, 'rpbsid_identifier/payload_estimate', self._on_estimate,
                          qos.latched_input())
        self.subscription(Float64MultiArray, 'rpbsid_identifier/payload_body', self._on_body, qos.latched_input())
        self.subscription(Float64MultiArray, '~/added_efforts', self._on_added, qos.output())
        self.create_timer(self.config.stale_after / 4.0, self._watch, clock=self._steady)

    def start(self) -> None:
        """Design the first gains."""
        self.state = controller.init(self.config)

    def summary(self) -> str:
        """Say what is controlled."""
        names = ', '.join((*self.config.joints, *self.config.bends))
        return f'{names} at {self.config.rate:g} Hz'

    def activated(self) -> None:
        """Hold the joints from the next sample on, or go to the setpoint that was set while it was inactive."""
        self.state = controller.init(self.config)
        self._last_ns, self._arrived, self._too_heavy = None, np.inf, False
        if self._estimate is not None:
            self._judge(self._estimate)

    def deactivated(self) -> None:
        """Send zero torque once."""
        self._goal = None
        self._send(np.zeros(len(self.config.joints)))

    def configuration_changed(self, config: ControllerParameters, names: Collection[str]) -> None:
        """Go to a setpoint with the next sample, as a parameter may be set while another thread takes a sample."""
        if 'setpoint' in names:
            self._goal = np.asarray(config.setpoint)

    def _on_joint_state(self, raw: bytes) -> None:
        try:
            record = self._reader(raw)
        except SignalError as error:
            self._drop('encoding', f'a joint state was dropped: {error}')
            return
        measured = self._measured(record)
        if measured is None:
            self._not_measured(record)
            return
        self._came.add(True)
        if self._is_late(record.stamp_ns):
            return
        self._arrived = time.monotonic()
        longest_ns = LONG_GAP * 1e9 / self.config.rate
        if self._last_ns is not None and record.stamp_ns - self._last_ns > longest_ns:
            self.state = self.state._replace(x=None)
        self._last_ns = record.stamp_ns
        self._stamps.note(record.stamp_ns)
        goal, self._goal = self._goal, None
        if goal is not None:
            self.state = controller.goto(self.state, goal)
        self.state, torque = controller.step(self.config, self.state, measured)
        if not np.isfinite(torque).all():
            self.not_finite += 1
            self.log_throttled('not_finite', NOT_FINITE)
            self.state = self.state._replace(x=None, way=None)
            torque = np.zeros(len(torque))
        self._send(torque)
        self._watch_limits(torque)

    def _not_measured(self, record: JointRecord) -> None:
        """Drop a joint state that cannot be used; one of other joints, such as those of a gripper, is only counted."""
        wanted = (*self.config.joints, *self.config.bends)
        known = not set(wanted).isdisjoint(record.names)
        self._came.add(known)
        if not known:
            self.foreign += 1
            return
        self._drop('joint_states', 'a joint state was dropped: it lacks position and velocity '
                   f'(finite, below {LARGEST:g}) of {", ".join(wanted)}')

    def _watch_limits(self, torque: Array) -> None:
        """Warn when the torques are at their limits more often than not, counted over ``AT_LIMIT_S``."""
        limit = np.asarray(self.config.effort_limit)
        at_limit = bool(np.any((np.abs(torque) >= limit) & (limit > controller.NO_TORQUE)))
        self._at_limit = max(0, self._at_limit + (1 if at_limit else -1))
        if self._at_limit == round(AT_LIMIT_S * self.config.rate) and not self._shortage():
            self.get_logger().warning(
                'the torques stay at effort_limit: the arm is not held. Check rate and the parameters arm.*; an arm '
                'without damping (arm.damping_ratio 0) becomes unstable in its fastest modes')

    def _shortage(self) -> str:
        """Return what holding the arm needs where that is more than effort_limit, and log it once; else empty."""
        if self.state.way is None:
            return ''
        needed, limit = controller.hold_goal(self.config, self.state), np.asarray(self.config.effort_limit)
        before, self._too_heavy = self._too_heavy, bool(
            np.any((np.abs(needed) > limit) & (limit > controller.NO_TORQUE)))
        if not self._too_heavy:
            return ''
        goal = np.round(self.state.way.goal, 3) + 0.0  # no -0
        words = (f'holding the arm at {listed(goal)} rad needs {listed(np.abs(needed))} N m; '
                 f'effort_limit is {listed(limit)} N m')
        if not before:
            self.get_logger().error(f'{words}. There the arm falls: raise effort_limit as far as the joints allow, '
                                    'change setpoint, or correct arm.gravity and the masses arm.*')
        return words

    def _is_late(self, stamp_ns: int) -> bool:
        """Return whether a sample is not newer than the last, and drop it; a long step back counts as a new clock."""
        if self._last_ns is None or stamp_ns > self._last_ns:
            return False
        if stamp_ns < self._last_ns - LOOPED_NS:
            self.state = self.state._replace(x=None)
            return False
        self._drop('stamps', 'a joint state whose stamp does not advance was dropped')
        return True

    def _drop(self, reason: str, words: str) -> None:
        self.dropped += 1
        self._drops.add(1)
        self.log_throttled(reason, words)

    def _measured(self, record: JointRecord) -> controller.Measured | None:
        """Pick the angles and bends by name; None when one is missing, not finite, or far too large."""
        count, wanted = len(record.names), (*self.config.joints, *self.config.bends)
        if not set(wanted) <= set(record.names) or record.position.size != count or record.velocity.size != count:
            return None
        places = [record.names.index(name) for name in wanted]
        position, velocity = record.position[places], record.velocity[places]
        if not np.abs([position, velocity]).max() < LARGEST:  # false for NaN too
            return None
        fresh = time.monotonic() - self._added_at <= self.config.stale_after
        return controller.Measured(position, velocity, self._added if fresh else np.zeros(len(self.config.joints)))

    def _on_estimate(self, message: Float64MultiArray) -> None:
        if len(message.data) != 5:
            self._drop('payload_estimate', f'a payload estimate was dropped: it has {len(message.data)} values, not 5')
            return
        self._arrivals = self._arrivals.with_latest(time.monotonic())
        self._estimate = PayloadEstimate(*message.data)  # kept: a latched estimate may come before activation
        if self._judge(self._estimate) is None:
            self._body = None  # it is that of the object held before

    def _on_body(self, message: Float64MultiArray) -> None:
        if len(message.data) != 20:
            self._drop('payload_body', f'a body was dropped: it has {len(message.data)} values, not 20')
            return
        self._body = tuple(message.data)
        if self._estimate is not None:
            self._judge(self._estimate)

    def _judge(self, estimate: PayloadEstimate) -> PayloadEstimate | None:
        """Let the controller judge an estimate; return it with the body that belongs to it, None without a body."""
        body = None if self._body is None else estimate.having(self._body)
        before = self.state.verdict
        self.state = controller.estimate(self.config, self.state, body or estimate)
        if self.state.verdict is not before and self.state.verdict is not None:
            self.get_logger().info(f'payload {estimate.mass:.2f} kg: {self.state.verdict.value}')
        return body

    def _on_added(self, message: Float64MultiArray) -> None:
        if len(message.data) != len(self.config.joints) or not np.isfinite(message.data).all():
            self._drop('added_efforts', 'added torques were dropped: one finite value for each joint is needed')
            return
        self._added, self._added_at = np.array(message.data), time.monotonic()

    def _watch(self) -> None:
        """Send zero torque once when the joint states cease."""
        if not self.active or time.monotonic() - self._arrived <= self.config.stale_after:
            return
        self._arrived = np.inf
        self.state = self.state._replace(x=None)
        self._send(np.zeros(len(self.config.joints)))
        self.log_throttled('silence', f'no joint_states for {self.config.stale_after:g} s: zero torque was sent')

    def _send(self, torque: Array) -> None:
        self._commands.publish(Float64MultiArray(data=doubles(torque)))
        self.sent += 1

    def _report_rate(self, report: Report) -> None:
        """Report a rate of the stamps that is not the parameter, and joint states that did not come."""
        rate, missing = self._stamps.window()
        if abs(rate / self.config.rate - 1.0) > RATE_TOLERANCE:  # false for NaN
            report.worse(ERROR, f'{rate:.0f} joint states a second by their stamps, designed for '
                         f'{self.config.rate:.0f}; set rate')
        elif missing > RATE_TOLERANCE:
            report.worse(ERROR, f'{100.0 * missing:.0f} % of the joint states did not come: look for the load of this '
                         'computer and its network')

    def report(self, report: Report) -> None:
        """Report the rate, the payload that the gains follow, and the verdict on the latest estimate."""
        report.values.update(dropped=self.dropped, foreign=self.foreign)
        self._drops.report(report, 'message', 'dropped')
        came, self._came = self._came, set()
        if came == {False}:
            words = f'no joint state can be used: none has {", ".join((*self.config.joints, *self.config.bends))}'
            self.log_throttled('foreign', words)
            report.worse(ERROR, words)
        if self.active and report.values['rate_hz'] == 0.0:
            report.silent('joint_states')
        self._report_rate(report)
        if self.not_finite:
            report.worse(ERROR, f'{NOT_FINITE} ({self.not_finite} times)')
        if self.active and (words := self._shortage()):
            report.worse(ERROR, words)
        if self.state.failed_designs:
            report.worse(WARN, f'for {self.state.failed_designs} configurations or payloads no stable regulator was '
                         'found, and the gains designed before them stayed in use; change angle_scale, bend_scale or '
                         'effort_scale')
        verdict = self.state.verdict
        now = time.monotonic()
        age = self._arrivals.age(now)
        report.values.update(
            scheduled_payload_kg=float(self.state.payload[0]), trusted_payload_kg=float(self.state.trusted[0]),
            designs=self.state.designs, estimate='none' if verdict is None else verdict.value,
            estimate_age_s=age)
        if verdict not in (None, Verdict.TRUSTED):
            report.worse(WARN, f'payload estimate not trusted: {verdict.value}')
        if self.active and self.config.use_estimate and self._arrivals.have_ceased(now):
            report.worse(WARN, f'no payload estimate for {age:.0f} s: the gains stay those of '
                         f'{self.state.trusted[0]:.2f} kg')


def listed(values: Iterable[float]) -> str:
    """Return numbers as words, such as '970 and 362'."""
    return ' and '.join(f'{value:.4g}' for value in values)


main = partial(run, PayloadController, NAME, __doc__, ControllerParameters)

if __name__ == '__main__':
    sys.exit(main())
