"""Node ``rpbsid_identifier``: model, modes and payload of the arm, one recursive step per joint state.

subscribes  joint_states      sensor_msgs/JointState  best effort, depth 1000; matched by name
            capture_event     std_msgs/Header         an event commanded or known
            capture_detected  std_msgs/Header         an event inferred from the signals
publishes   ~/model           std_msgs/Float64MultiArray  [[A, B, K], [C, D, I]]; latched
            ~/modes           std_msgs/Float64MultiArray  damped frequency [Hz], damping ratio
            ~/payload_mass    std_msgs/Float64            kg
            ~/payload_estimate std_msgs/Float64MultiArray mass, std, 95 % interval, consistency; latched
            ~/payload         geometry_msgs/InertiaStamped at the stamp of the sample that gave it; latched
            /diagnostics      diagnostic_msgs/DiagnosticArray  1 Hz
services    rpbsid_identifier/reset   std_srvs/Trigger   forget everything
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from functools import partial

from geometry_msgs.msg import InertiaStamped
from rclpy.context import Context
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray, Header
from std_srvs.srv import Trigger

from flexmanip_ros import estimator, messages, pipeline, schedule
from flexmanip_ros.errors import CheckpointError, FlexmanipError, SignalError
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.ros import qos
from flexmanip_ros.ros.conversions import JointStateReader, capture_event
from flexmanip_ros.ros.diagnostics import ERROR, STALE, WARN, LossCounter, Meter, Report
from flexmanip_ros.ros.encoding import Encoder
from flexmanip_ros.ros.estimate_report import report_estimate
from flexmanip_ros.ros.keeper import Keeper, too_old
from flexmanip_ros.ros.model_reader import ModelReader
from flexmanip_ros.ros.node import FlexmanipNode, sequence_number, with_info
from flexmanip_ros.ros.spin import run
from flexmanip_ros.ros.warm_up import warm_up
from flexmanip_ros.ros.worker import Worker
from flexmanip_ros.types import CaptureEvent, Estimate, JointRecord

NAME = 'rpbsid_identifier'
_TOPICS = (
    (messages.MODEL, Float64MultiArray, qos.latched), (messages.MODES, Float64MultiArray, qos.output),
    (messages.PAYLOAD_MASS, Float64, qos.output), (messages.PAYLOAD_ESTIMATE, Float64MultiArray, qos.latched),
    (messages.PAYLOAD, InertiaStamped, qos.latched),
)


class RpbsidIdentifier(FlexmanipNode[IdentifierParameters]):
    """Converts, takes one step of the pipeline, publishes."""

    THREAD_PRIORITY, WAKE_LATENCY = 20, 0

    def __init__(self, *, context: Context | None = None, overrides: list[Parameter] | None = None,
                 namespace: str | None = None, cli_args: list[str] | None = None) -> None:
        super().__init__(NAME, IdentifierParameters, context=context, overrides=overrides,
                         namespace=namespace, cli_args=cli_args)
        self.state = pipeline.init()
        self._read: Estimate | None = None
        self._followed: pipeline.Due | None = None
        self.refused = 0
        self.published = 0
        self.losses = LossCounter()
        self.meter = Meter()
        self._reader = JointStateReader()
        self._encoded = Encoder()
        self._keeper: Keeper | None = None
        self._resumed = False
        self._worker: Worker | None = None
        self._models: ModelReader | None = None

    def make_entities(self) -> None:
        """Publishers, subscriptions and the reset service."""
        self.outputs = {
            name: self.publisher(kind, f'~/{name}', profile()) for name, kind, profile in _TOPICS}
        self._joint_states = self.subscription(
            JointState, 'joint_states', with_info(self._on_joint_states), qos.sensor_input(), raw=True)
        for topic in ('capture_event', 'capture_detected'):
            self.subscription(Header, topic, partial(self._on_event, topic), qos.latched_input())
        self.create_service(Trigger, '~/reset', self._on_reset)

    def start(self) -> None:
        """Compile or load every kernel before the first sample; begin with nothing known."""
        warm_up(self.config)
        self._forget()
        self._keeper = Keeper(self.config) if self.config.checkpoint_file else None
        if self._keeper is not None:
            self._resume(self._keeper)

    def _resume(self, keeper: Keeper) -> None:
        """Go on from the saved state, or say why not."""
        try:
            state = keeper.resume(self.config)
        except CheckpointError as error:
            self.get_logger().warning(str(error))
            return
        if state is not None:
            self.state, self._resumed = state, True
            self.get_logger().info(f'resumed after {state.counters.accepted} samples')

    def activated(self) -> None:
        """Have a thread for the fits and one for reading models, and cores that are awake."""
        self._worker, self._models = Worker(), ModelReader(self.real_time.join)
        self.real_time.stay_awake()

    def deactivated(self) -> None:
        """Save what is known."""
        self.real_time.stay_awake(False)
        try:
            self._conclude()
        finally:
            for helper in (self._worker, self._models):
                if helper is not None:
                    helper.close()
            self._worker = self._models = None
            if self._keeper is not None:
                self._keeper.finish()
                self._keeper.save(self.config, self.state)

    def configuration_changed(self, config: IdentifierParameters) -> None:
        """Go on with what may change at run time."""
        self._conclude()
        self.state = pipeline.reconfigure(config, self.state)

    def _forget(self) -> None:
        self._conclude()
        self.state = pipeline.init()
        self._read = self._followed = None

    def _on_joint_states(self, raw: bytes, info: object) -> None:
        if not self.active:
            return
        with self.meter:
            self.losses.note(sequence_number(info))
            try:
                record = self._reader(raw)
            except SignalError as error:
                self._refuse('encoding', str(error))
                return
            if self._resumed:
                self._first_after_resume(record.stamp_ns)
            self._take(record)
            if self._keeper is not None and self._keeper.due():
                self._keeper.save_meanwhile(self.config, self.state)

    def _first_after_resume(self, stamp_ns: int) -> None:
        """Drop a saved state that is too old for these samples: the arm may hold something else by now."""
        self._resumed = False
        if too_old(self.config, self.state, stamp_ns):
            self.get_logger().warning('the saved state is older than checkpoint_max_age; it starts anew')
            self._forget()

    def _on_event(self, topic: str, message: Header) -> None:
        if not self.active:
            return
        try:
            event = capture_event(message)
        except FlexmanipError as error:
            self._refuse(topic, str(error))
            return
        self.get_logger().info(f'{topic}: {event.kind.value} at {event.stamp_ns * 1e-9:.6f}')
        self._take(event)

    def _take(self, item: JointRecord | CaptureEvent) -> None:
        """One step; whatever is wrong with the message is said and counted, and the node goes on."""
        self._conclude(item)
        dropped = self.state.counters.dropped
        try:
            self.state, due = pipeline.take(self.config, self.state, item)
        except FlexmanipError as error:
            self._refuse('configuration', str(error))
            return
        refusal = self.state.sampling.refusal
        if refusal is not None and self.state.counters.dropped > dropped:
            self.complain(refusal.reason, f'message dropped: {refusal.problem}; {refusal.remedy}')
        for one in due:  # the payload first: nobody should wait for it while a model is read
            self._publish(messages.outgoing_payload(one.payload, one.stamp_ns, self.config.payload_frame))
            self._conclude()
            if self._models is not None and schedule.is_read_anew(self.state, one):
                self._models.ask(self.state, one, self._model_is_there)
            elif one.payload is None:
                self.state, estimate = pipeline.read(self.state, one)
                self._tell(estimate)
            else:
                self._followed = one  # all there is to say of it has been said
        if not due and schedule.is_next_due(self.state):
            self._rehearse()
        if self._worker is not None:
            self.state = self._worker.attend(self.state, published=bool(due))

    def _rehearse(self) -> None:
        """Work out what is to be said of the payload a sample ahead, and say it to nobody.

        What runs at the publishing rate alone is in no cache when somebody waits for it, and takes ten times
        as long as in a loop: 0.03 ms of the time from a sample to its estimate.
        """
        payload, stamp_ns = pipeline.payload(self.state)
        for _, value in messages.outgoing_payload(payload, stamp_ns, self.config.payload_frame):
            self._encoded(value)

    @property
    def is_reading(self) -> bool:
        """Whether a model has still to be published."""
        return self._models is not None and self._models.ready(self.state, None)

    def _model_is_there(self) -> None:
        """Have the executor publish it; on the thread of the reader."""
        if self.executor is not None:
            self.executor.create_task(self._conclude_done)

    def _conclude_done(self) -> None:
        if self._models is not None and self._models.done:
            self._conclude()

    def _conclude(self, before: JointRecord | CaptureEvent | None = None) -> None:
        """Take the model under way, if there is one and it is ready, or must be taken before that."""
        if self._models is not None and self._models.ready(self.state, before):
            self.state, estimate = self._models.take(self.state)
            self._tell(estimate)

    def _tell(self, estimate: Estimate) -> None:
        """Publish what is new in an estimate and has not gone out ahead of it."""
        if self.config.payload_method == 'block':
            self._publish(messages.outgoing_payload(
                estimate.payload, estimate.stamp_ns, self.config.payload_frame))
        self._publish(messages.outgoing_model(estimate))
        self._read, self._followed = estimate, None

    @property
    def estimate(self) -> Estimate | None:
        """The latest estimate, put together when it is asked for."""
        last, due, reading = self._read, self._followed, self.state.reading
        if last is None and reading is not None:
            last = reading.estimate  # of before it was resumed
        if last is None or due is None:
            return last
        return estimator.follow(self.config, due.stamp_ns, last, due.payload)

    def _publish(self, values: Iterable[tuple[str, messages.Value]]) -> None:
        for name, value in values if self.context.ok() else ():  # nobody hears the last words of a context
            self.outputs[name].publish(self._encoded(value))
            self.published += 1

    def _refuse(self, reason: str, words: str) -> None:
        self.refused += 1
        self.complain(reason, words)

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._forget()
        response.success, response.message = True, 'everything identified so far is forgotten'
        return response

    def report(self, report: Report) -> None:
        """Rate, losses, drops by reason, and what the latest estimate is worth."""
        values, counters = report.values, self.state.counters
        values.update(self.meter.window())
        several = self.count_publishers(self._joint_states.topic_name) > 1
        values['lost'] = 'unknown (several publishers)' if several else self.losses.lost
        values.update(counters._asdict())
        values['dropped'] = counters.dropped
        values['refused'] = self.refused
        if self._keeper is not None:
            values['checkpoints'] = self._keeper.saves
            if self._keeper.problem:
                report.worse(ERROR, self._keeper.problem)
        line = self.state.timeline
        if line is not None:
            values.update(late_events=line.late_events, repeated_events=line.repeated_events,
                          rewinds=line.rewinds, outliers=estimator.outliers(line.core))
        silent = values['rate_hz'] == 0.0
        self.real_time.stay_awake(self.active and not silent)
        if self.active and silent:
            report.worse(STALE, 'no joint_states')
        if self.refused:
            report.worse(ERROR, f'{self.refused} messages refused')
        if counters.dropped:
            report.worse(WARN, f'{counters.dropped} messages dropped')
        if not several and self.losses.lost:
            report.worse(WARN, f'{self.losses.lost} messages lost')
        report_estimate(report, self.estimate, self.config.order)


def main(argv: list[str] | None = None) -> int:
    """Run the node."""
    return run(RpbsidIdentifier, NAME, __doc__, IdentifierParameters, argv)


if __name__ == '__main__':
    sys.exit(main())
