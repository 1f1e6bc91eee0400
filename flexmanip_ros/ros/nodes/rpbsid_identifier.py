"""Node ``rpbsid_identifier``: model, modes and payload of the arm, one recursive step per joint state.

subscribes  joint_states      sensor_msgs/JointState  best effort, depth 5000; matched by name
            capture_event     std_msgs/Header         an event commanded or known
            capture_detected  std_msgs/Header         an event inferred from the signals
publishes   ~/model           std_msgs/Float64MultiArray  [[A, B, K], [C, D, I]]; latched
            ~/modes           std_msgs/Float64MultiArray  damped frequency [Hz], damping ratio; order // 2 rows
            ~/modes_interval  std_msgs/Float64MultiArray  their lower and upper 95 %
            ~/payload_mass    std_msgs/Float64            kg; nothing while nothing is known
            ~/payload_estimate std_msgs/Float64MultiArray mass, std, 95 % interval, consistency; latched
            ~/payload_body     std_msgs/Float64MultiArray mass, centre of mass, inertia, and their covariance; latched
            ~/arm_parameters   std_msgs/Float64MultiArray what the empty arm taught: values, deviations; 1 Hz, latched
            ~/payload         geometry_msgs/InertiaStamped at the stamp of the sample that gave it; latched
            ~/arm             visualization_msgs/MarkerArray  25 Hz: links, object, its mass; only if somebody listens
            ~/status          diagnostic_msgs/DiagnosticArray stamp, status and numbers of payload or model; latched
            /diagnostics      diagnostic_msgs/DiagnosticArray  1 Hz
services    rpbsid_identifier/reset   std_srvs/Trigger   forget everything
"""

import math
import sys
import time
from collections.abc import Collection, Iterator
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import InertiaStamped
from numpy.typing import NDArray
from std_msgs.msg import Float64, Float64MultiArray, Header
from visualization_msgs.msg import MarkerArray

from flexmanip_ros import messages, pipeline
from flexmanip_ros.errors import CheckpointError, FlexmanipError, ParameterError, SignalError
from flexmanip_ros.event_replay import FAR_EVENT_NS, MOST_EVENTS
from flexmanip_ros.identification import batch_fit, recursive_fit
from flexmanip_ros.io.checkpoint import CheckpointWriter, too_old
from flexmanip_ros.numerics.background import Deferred
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.ros import diagnostics, qos
from flexmanip_ros.ros.arm_markers import ArmMarkers
from flexmanip_ros.ros.conversions import JointStateReader, capture_event, to_message
from flexmanip_ros.ros.node import FlexmanipNode, run
from flexmanip_ros.samples.signals import joints
from flexmanip_ros.types import CaptureEvent, Estimate, EventKind, JointBlock, JointRecord, Status

NAME = 'rpbsid_identifier'
TOPICS: dict[str, type[Any]] = {
    **dict.fromkeys((messages.MODEL, messages.MODES, messages.MODES_INTERVAL, messages.PAYLOAD_ESTIMATE,
                     messages.PAYLOAD_BODY, messages.ARM_PARAMETERS), Float64MultiArray),
    messages.PAYLOAD_MASS: Float64, messages.PAYLOAD: InertiaStamped, messages.STATUS: DiagnosticArray,
}
"""Message type of each output topic."""
ARM = 'arm'
ARM_RATE = 25.0
"""Rate at which the markers of the arm are published [Hz]."""
LONGEST_WAIT_S = 0.02
"""Longest time that messages wait until they are taken [s]: the time between two estimates at 50 Hz."""
MOST_AT_ONCE = 100
"""Largest number of messages that a callback takes, 0.1 s at 1 kHz, of up to 35 000 that may wait.

Signals and services wait for the end of the callback.
"""
LEAD_S = 0.003
"""Time before an estimate is due at which the messages so far are taken [s]: few are left, so it comes soon."""
SHORTEST_WAIT_S = 0.00025
"""Shortest time after which the queue is read again when an expected message has not come [s]."""

FASTER = ('publish joint states less often, end other programs, or name fewer parameters in payload.learn (small arms '
          'with Coulomb friction need many steps a sample)')
"""What a user can do where the callback is busy."""

WARM_UP_EVENT = 40
"""Number of samples before the event of the warm-up, more than are needed to learn the sample time."""
WARM_UP_SAMPLES = WARM_UP_EVENT + 3 * batch_fit.BLOCK + 2 * recursive_fit.CHUNK
"""Number of samples of the warm-up: it ends after the fits that follow the event, and one more block."""
WARM_UP_PAYLOAD = WARM_UP_EVENT + 100
"""Number of samples of the warm-up with a payload method that takes samples itself: its fit has taken steps by then,
and five estimates were read. No arm swings as these samples do, so a fit that goes on takes seconds."""
WARM_UP_STEP_NS = 1_000_000


def warm_up(config: IdentifierParameters) -> None:
    """Compile or load every kernel: run the pipeline on made-up samples of the configured signals and an event.

    Raises ParameterError when the configuration cannot work at all, before any message comes.
    """
    import scipy.special  # noqa: F401  the check of the frequencies would load it while messages come

    runs = [(config, WARM_UP_SAMPLES)]
    if config.payload_method == 'structured':
        runs = [(config, WARM_UP_PAYLOAD), (replace(config, payload_method='none'), WARM_UP_SAMPLES)]
    try:
        for some, count in runs:
            for _ in pipeline.run(some, _made_up(config, count)):
                pass
    except SignalError:  # a configured signal that even these messages, with every field filled, do not carry
        return


def _made_up(config: IdentifierParameters, count: int) -> Iterator[JointRecord | CaptureEvent]:
    """Yield joints that swing at two frequencies, driven by random torques, and a capture."""
    names = joints(config)
    rng = np.random.default_rng(0)
    step = np.exp(1j * np.array([0.1, 0.2]) - 0.01)
    shape = rng.standard_normal((2, len(names)))
    state = np.zeros(2, dtype=complex)
    for k in range(count):
        if k == WARM_UP_EVENT:
            yield CaptureEvent((k - 1) * WARM_UP_STEP_NS, EventKind.CAPTURE)
        effort = rng.standard_normal(len(names))
        noise = 1e-3 * rng.standard_normal((2, len(names)))
        yield JointRecord(k * WARM_UP_STEP_NS, names, 0.01 * (state.imag @ shape + noise[0]),
                          state.real @ shape + noise[1], effort)
        state = step * state + shape @ effort / math.sqrt(len(names))


class RpbsidIdentifier(FlexmanipNode[IdentifierParameters]):
    """Converts messages, takes a step of the pipeline and publishes its estimates.

    Waiting messages are taken together, which costs a third of one callback per message (see ``Batches``). They are
    taken 3 ms before an estimate is due, and when the message with which it is due is expected.

    A model is taken 5 ms (by the stamps) after the sample at which it was requested. Where no sample follows, the last
    model is published when the node is deactivated.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(NAME, IdentifierParameters, **options)
        self.state = pipeline.init()
        self.estimate: Estimate | None = None
        """The latest estimate: the last one published, or that of a saved state."""
        self.rejected = self.published = 0
        self.problem = ''
        """Why the latest message was rejected."""
        self.faults = diagnostics.JointStateFaults(joints(self.config), self.resolve_topic_name('joint_states'))
        self.losses = self.faults.losses
        self._reader = JointStateReader()
        self._background = Deferred()
        self._checkpoints: CheckpointWriter | None = None
        self._resumed = False
        """Whether the state is a saved one whose age is not known yet, as no joint state has come."""
        self._heard: list[CaptureEvent] = []
        """The events since then; they count whatever the age of the saved state is."""
        self._logged: dict[str, object] = {}
        """What was last logged, by kind: status, trusted payload, missing announcement and failed checkpoint."""
        self._latest: JointRecord | None = None
        """The latest joint state that is not drawn yet."""
        self._lag_ns: int | None = None
        """Median of arrival time minus stamp of the latest messages [ns]; the stamps may be those of any clock."""

    def make_entities(self) -> None:
        """Create the publishers, the subscriptions and the reset service."""
        self.outputs = {
            name: self.publisher(kind, f'~/{name}', qos.latched() if name in messages.LATCHED else qos.output())
            for name, kind in TOPICS.items()}
        self._joint_states = self.waiting_joint_states(self.losses)
        self._alarm = self.alarm(self._take)
        self._alarm.after(LONGEST_WAIT_S)
        self.each_event(self._on_event)
        self.trigger_service('~/reset', self._on_reset)
        self._markers = ArmMarkers(self.config)
        if self._markers.drawn:
            self.arm = self.publisher(MarkerArray, f'~/{ARM}', qos.output())
            self.create_timer(1.0 / ARM_RATE, self._draw, clock=self._steady)

    def start(self) -> None:
        """Compile or load every kernel before the first sample; begin with nothing known, or from a checkpoint.

        Raises ParameterError when ``checkpoint_file`` is a folder, or in none.
        """
        path = Path(self.config.checkpoint_file)
        if self.config.checkpoint_file and (path.is_dir() or not path.parent.is_dir()):
            wrong = f"'{path}' is a folder" if path.is_dir() else f"'{path.parent}' is no folder"
            raise ParameterError(f'checkpoint_file cannot be written: {wrong}', 'give a file in a folder that exists')
        warm_up(self.config)
        self._forget()
        self._checkpoints = CheckpointWriter(self.config) if self.config.checkpoint_file else None
        try:
            state = self._checkpoints.load(self.config) if self._checkpoints is not None else None
        except CheckpointError as error:
            self.get_logger().warning(str(error))
            return
        if state is not None:
            self.state, self._resumed, self._heard = state, True, []
            self.estimate = state.model.estimate if state.model is not None else None
            self.get_logger().info(f'resumed after {state.counters.accepted} samples')

    def summary(self) -> str:
        """Say what is identified from which signals."""
        config = self.config
        return (f'inputs {", ".join(config.inputs)}; outputs {", ".join(config.outputs)}; order {config.order}; '
                f'payload_method {config.payload_method}; {config.publish_rate:g} estimates a second')

    def activated(self) -> None:
        """Start the threads for fits and models; discard the messages that came before the activation."""
        self._waiting(None)
        self._background = Deferred()

    def deactivated(self) -> None:
        """Take at most ``MOST_AT_ONCE`` waiting messages, publish the model under way, and save the state."""
        self._take_samples()
        self.state, estimates = pipeline.finish(self.config, self.state, self._background)
        self._publish(estimates)
        self._background.close()
        if self._checkpoints is not None:
            self._checkpoints.join()
            self._checkpoints.save(self.config, self.state)
            if self._checkpoints.problem:
                self.get_logger().error(f'the last state was not saved: {self._checkpoints.problem}')

    def configuration_changed(self, config: IdentifierParameters, names: Collection[str]) -> None:
        """Continue with the changed parameters; the samples before the change are taken with the former ones."""
        if self.active:
            self._take_samples()
        self.state = pipeline.reconfigure(config, self.state, self._background)

    def _forget(self) -> None:
        self.state, self.estimate, self._resumed, self._logged = pipeline.init(), None, False, {}

    def _take(self) -> None:
        """Take the waiting messages; set the alarm to the next estimate, or to at once where messages are left."""
        due_ns = self.state.next_due_ns
        if self._take_samples() == MOST_AT_ONCE:
            self._alarm.after(SHORTEST_WAIT_S)
            return
        wait_s = self._wait_s()
        if wait_s > LEAD_S or self.state.next_due_ns != due_ns:
            self._background.begin()
        self._alarm.after(wait_s)

    def _take_samples(self) -> int:
        """Convert the waiting messages, step the pipeline and publish; return the number of messages taken."""
        raws, arrived_ns = self._waiting()
        if not self.active or not raws:
            return len(raws)
        with self.meter.timed(len(raws)):
            first = 0
            for block in self._reader.blocks(raws):
                count = 1 if isinstance(block, SignalError) else len(block.stamp_ns)
                if isinstance(block, SignalError):
                    self._reject('encoding', str(block))
                else:
                    self._take_block(block, arrived_ns[first:first + count])
                first += count
            if self._checkpoints is not None:
                self._checkpoints.save_when_due(self.config, self.state)
        return len(raws)

    def _take_block(self, block: JointBlock, arrived_ns: NDArray[np.int64]) -> None:
        if self._resumed:
            self._check_age(int(block.stamp_ns[0]))
        self._step(block)
        if self.state.clock.last_ns == block.stamp_ns[-1]:  # false for messages of another arm
            self._lag_ns = int(np.median(arrived_ns - block.stamp_ns))
            self._latest = block.record(-1)

    def _waiting(self, most: int | None = MOST_AT_ONCE) -> tuple[list[bytes], NDArray[np.int64]]:
        """Take at most ``most`` waiting messages (None: all); return them and their arrival times [ns].

        A node that is not active takes messages too, so that those it ignores do not count as lost.
        """
        raws, arrived_ns = [], []
        for raw, info in islice(self._joint_states.take(), most) if self.context.ok() else ():
            raws.append(raw)
            arrived_ns.append(info['received_timestamp'])
        return raws, np.array(arrived_ns, dtype=np.int64)

    def _wait_s(self) -> float:
        """Return the time until the message with which the next estimate is due [s], at first ``LEAD_S`` less."""
        longest_s = LONGEST_WAIT_S
        if self.state.clock.dt > 0.0:  # at most the time in which half of the queue fills
            longest_s = min(longest_s, 0.5 * self._joint_states.depth * self.state.clock.dt)
        due_ns = self.state.next_due_ns
        if due_ns is None or self._lag_ns is None:
            return longest_s
        wait_s = (due_ns + self._lag_ns - time.time_ns()) * 1e-9
        if wait_s > 2.0 * LEAD_S:
            wait_s -= LEAD_S
        elif wait_s < SHORTEST_WAIT_S:  # the message is late: wait for as long as it is late already
            wait_s = max(SHORTEST_WAIT_S, -wait_s)
        return min(wait_s, longest_s)

    def _on_event(self, topic: str, message: Header) -> None:
        is_latest = self._take_samples() < MOST_AT_ONCE  # else samples from before the event still wait
        try:
            event = capture_event(message).heard_on(topic)
        except FlexmanipError as error:
            self._reject(topic, str(error))
            return
        replay = self.state.payload
        if len(self.state.early if replay is None else replay.pending) >= MOST_EVENTS:
            self._reject(topic, f'{MOST_EVENTS} events wait for their stamps already; one more was rejected')
            return
        words = f'{topic}: {event.kind.value} at {event.stamp_ns * 1e-9:.6f}'
        last_ns = self.state.clock.last_ns
        known = replay is not None and event in replay.latest  # a latched one that is heard again
        if (last_ns is not None and abs(event.stamp_ns - last_ns) > FAR_EVENT_NS and not known
                and (is_latest or event.stamp_ns < last_ns)):
            where = 'before' if event.stamp_ns < last_ns else 'after'
            self.log_throttled('far event', f'{words}, {abs(event.stamp_ns - last_ns) * 1e-9:.0f} s {where} the last '
                               'sample: stamp an event with the time of its samples', is_error=False)
        else:
            self.get_logger().info(words)
        if self._resumed:
            self._heard.append(event)
        self._step(event)

    def _step(self, item: JointBlock | CaptureEvent) -> None:
        """Take one step of the pipeline and publish; a message that cannot be used is counted and logged."""
        before = self.state.clock
        try:
            self.state, estimates = pipeline.step(self.config, self.state, item, self._background)
        except FlexmanipError as error:
            self._reject('configuration', str(error), len(item.stamp_ns) if isinstance(item, JointBlock) else 1)
            return
        self._publish(estimates)
        if isinstance(item, JointBlock):
            self.log_dropped(self.faults.note(before, self.state.clock, item.names))
        if self.state.counters.resets > before.counters.resets:
            self.log_throttled('reset', f'everything identified is forgotten: {self.faults.jumped()}', is_error=False)

    def _publish(self, estimates: tuple[Estimate, ...]) -> None:
        """Publish what is new in each estimate."""
        for estimate in estimates:
            if not self.context.ok():  # a context that has ended publishes nothing
                return
            values = (messages.outgoing(estimate, self.config.payload_frame) if estimate.payload_is_new else
                      messages.outgoing_model(estimate))
            for name, value in values:  # publishes each before the next is made
                self.outputs[name].publish(to_message(value))
                self.published += 1
            self.estimate = estimate

    def _draw(self) -> None:
        """Publish the arm of the latest joint state, if the topic has a subscription."""
        record, self._latest = self._latest, None
        if not self.active or record is None or self.arm.get_subscription_count() == 0:
            return
        payload = None if self.estimate is None else self.estimate.payload
        markers = self._markers.message(record, payload)
        if markers is not None:
            self.arm.publish(markers)

    def _check_age(self, stamp_ns: int) -> None:
        """Drop a saved state that is too old for these samples: the arm may hold something else by now."""
        heard, self._resumed, self._heard = self._heard, False, []
        if too_old(self.config, self.state, stamp_ns):
            self.get_logger().warning(
                'the saved state is older than checkpoint_max_age; the identifier starts with nothing known')
            self._forget()
            for event in heard:
                self._step(event)

    def _reject(self, reason: str, words: str, count: int = 1) -> None:
        self.rejected += count
        self.problem = diagnostics.shortened(words)
        self.log_throttled(reason, words)

    def _on_reset(self) -> tuple[bool, str]:
        self._waiting(None)
        self._forget()
        words = 'everything identified so far is forgotten'
        self.get_logger().info(f'reset: {words}')
        return True, words

    def report(self, report: diagnostics.Report) -> None:
        """Report the rate, losses, drops by reason, and the quality of the latest estimate."""
        values, counters = report.values, self.state.counters
        self.report_faults(report, self.faults)
        values.update(counters._asdict(), dropped=counters.dropped, rejected=self.rejected)
        if self._checkpoints is not None:
            values['checkpoints'] = self._checkpoints.saves
            self._report_checkpoint(report, self._checkpoints.problem)
        events, identifier = self.state.payload, self.state.identifier
        if events is not None and identifier is not None:
            values.update(late_events=events.late_events, repeated_events=events.repeated_events,
                          rewinds=events.rewinds, outliers=identifier.estimator.outliers)
        if self.active and values['rate_hz'] == 0.0:
            if waiting := self._joint_states.fetch():  # the node, not the arm, was silent
                report.worse(diagnostics.WARN,
                             f'{diagnostics.number(waiting, "message")} of joint_states wait: {FASTER}')
            else:
                report.silent('joint_states')
        report.busy(FASTER)
        if self.rejected:
            report.worse(diagnostics.ERROR, f'{diagnostics.number(self.rejected, "message")} rejected: {self.problem}')
        diagnostics.report_estimate(report, self.estimate, self.config.order)
        if self.active and self.estimate is not None:
            self._log_estimate(self.estimate)

    def _report_checkpoint(self, report: diagnostics.Report, problem: str) -> None:
        """Report why the last state could not be saved, and log it once."""
        if problem:
            report.worse(diagnostics.ERROR, problem)
            if self._logged.get('checkpoint') != problem:
                self.get_logger().error(problem)
        self._logged['checkpoint'] = problem

    def _log_estimate(self, estimate: Estimate) -> None:
        """Log each change of the status, a payload when it is first trusted, and that a capture seems unannounced."""
        log = self.get_logger()
        if self._logged.get('status') is not estimate.status:
            self._logged['status'] = estimate.status
            log.info(diagnostics.status_line(self.config, estimate.status, estimate.status_reason))
        payload, since_ns = estimate.payload, self.state.stamp_of(EventKind.CAPTURE)
        if payload is None:
            return
        came = since_ns is None or estimate.stamp_ns >= since_ns  # an event may be announced before its stamp
        if (payload.status is Status.TRACKING and math.isfinite(payload.std) and came
                and ('payload' not in self._logged or self._logged['payload'] != since_ns)):
            self._logged['payload'] = since_ns
            log.info(f'payload {payload.mass:.4g} kg, 95 % interval {payload.lower:.4g} to {payload.upper:.4g} kg')
        known = payload.status in (Status.WARMING_UP, Status.UNOBSERVABLE) or math.isfinite(payload.upper)
        if not known and since_ns is None and 'unannounced' not in self._logged:
            self._logged['unannounced'] = True
            log.warning(diagnostics.UNANNOUNCED)


main = partial(run, RpbsidIdentifier, NAME, __doc__, IdentifierParameters)

if __name__ == '__main__':
    sys.exit(main())
