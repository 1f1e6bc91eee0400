"""The replay of a recording: its messages through the pipeline to a result, a table or recording, and a report."""

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from flexmanip_ros import estimator, pipeline
from flexmanip_ros.cli.console import Report
from flexmanip_ros.errors import BagError, FlexmanipError, MissingSignalError, ModelError, ParameterError, SignalError
from flexmanip_ros.event_replay import FAR_EVENT_NS, distinct
from flexmanip_ros.identification import parameter_varying
from flexmanip_ros.io import bag
from flexmanip_ros.io.bag import Topics
from flexmanip_ros.io.outputs import Output, check_apart, check_output, check_place, write_rows, write_text
from flexmanip_ros.numerics.background import REPLAY_THREADS, Threads, read_ahead
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.parameters.document import yaml_text
from flexmanip_ros.payload import capture_detection
from flexmanip_ros.payload.arm_parameters import as_parameters
from flexmanip_ros.samples import sampling
from flexmanip_ros.samples.sample_log import Signals
from flexmanip_ros.samples.signals import joints
from flexmanip_ros.studies import whole_recording
from flexmanip_ros.studies.results import Summary, payload_bound, summarize
from flexmanip_ros.types import Array, CaptureEvent, Estimate, EventKind, JointBlock, Mode, Status
from flexmanip_ros.view.screen import Screen, embedded, of_identifier


@dataclass(frozen=True)
class Request:
    """The options of one run of identify_bag. Times count from the first stamp [s]."""

    bag: str | Path
    config: IdentifierParameters
    topics: Topics = field(default_factory=Topics)
    capture_time: float | None = None
    release_time: float | None = None
    detect: bool | None = None
    """Whether to look for captures and releases in the signals; None: where the recording has no topic of events, no
    time is given, and the signals can show one."""
    validate_from: float | None = None
    horizon: float = whole_recording.HORIZON_S
    """How far ahead the held-out samples are predicted [s]."""
    smooth: bool = False
    """Whether each stretch between events is also fitted with all of its samples."""
    output: str | None = None
    report: str | None = None
    save_arm: str | None = None
    """Path of the parameter file for the arm parameters that the recording gave; None: none is written."""
    configurations: str | None = None
    """Path of the table of the frequencies of every configuration; None: none is written."""


def places(given: Any) -> dict[str, str | None]:
    """Return option and path of each file that a run writes, None where it does not. given: Request or arguments."""
    names = ('output', 'report', 'save_arm', 'configurations')
    return {f'--{name.replace("_", "-")}': getattr(given, name) for name in names}


def check_places(given: Any) -> None:
    """Raise FlexmanipError where one of these files cannot be written, or has a wrong ending. given: see ``places``."""
    for place, endings in ((given.report, ('.html', '.htm')), (given.save_arm, ('.yaml', '.yml')),
                           (given.configurations, ('.csv',))):
        if place is not None:
            check_place(place, *endings)
    if given.output is not None:
        check_output(given.output)


def check_possible(request: Request) -> None:
    """Raise FlexmanipError where the parameters say that a file which is asked for would have nothing in it."""
    config = request.config
    if request.configurations is not None and (len(config.angles) != 2 or parameter_varying.roles(config) is None):
        raise _no_configurations()
    if request.save_arm is not None and config.payload_method != 'structured':
        raise _no_arm()


@dataclass(frozen=True, eq=False)
class Result:
    """The result of a run.

    fault: what was wrong with the recording, whose sound messages were used all the same, and which of the things asked
    for it does not give.
    """

    summary: Summary
    modes: tuple[Mode, ...]
    config: IdentifierParameters
    """The configuration, with the outputs that the messages really carry."""
    written: tuple[str, ...]
    fault: FlexmanipError | None
    interrupted: bool = False
    events: str = ''
    """The events found in the signals, or why they were not looked for, as text; empty where events are known."""
    remark: str = ''
    """One line about messages that were left out and events that were not applied at their stamp; empty if none."""


def identify(request: Request, progress: Report | None = None) -> Result:
    """Replay a recording through the identifier; write the output and the report that are asked for.

    Raises FlexmanipError when no message can be used, and when a file cannot be written, is to be written twice, is in
    the recording, or could not have anything in it. Where only the end tells this, the result has it as its fault.
    """
    started = time.perf_counter()
    check_apart(places(request), None, str(request.bag))
    check_places(request)
    check_possible(request)
    progress = progress or Report()
    screen = None if request.report is None else Screen(of_identifier(request.config, Path(request.bag).name))
    messages = Messages(request, progress, screen)
    state, kept, interrupted = _run(request, messages)
    progress.phase('fitting the last samples')
    last, config = pipeline.current(state), state.config or request.config
    summary = summarize(state, last, time.perf_counter() - started)
    signals = messages.signals(state.friction) if messages.is_kept else None
    events, merged = distinct(config, messages.events)
    faults: list[FlexmanipError | None] = [messages.fault or _dropped(state)]
    scores, found = None, None
    if signals is not None and request.validate_from is not None:
        progress.phase('scoring the model')
        scores, fault = _scored(request, last, signals)
        faults.append(fault)
        summary = summary if scores is None else _with_scores(summary, scores, request.horizon)
    if signals is not None and request.smooth:
        summary = replace(summary, smoothed=whole_recording.smooth(
            config, signals, [event.stamp_ns for event in events], state.clock.dt, request.validate_from))
    if signals is not None:
        found = whole_recording.sweep(state, messages.angles_held(signals))
    written = {request.output, request.report}
    if request.save_arm is not None and _save_arm(request.save_arm, Path(request.bag).name, config, state, last):
        written.add(request.save_arm)
    elif request.save_arm is not None:
        faults.append(_no_arm())
    if request.configurations is not None and found is not None:
        write_rows(request.configurations, found.rows())
        written.add(request.configurations)
    elif request.configurations is not None:
        faults.append(_no_configurations())
    result = Result(
        summary, () if last is None else last.modes, config,
        tuple(place for place in places(request).values() if place is not None and place in written),
        _joined([fault for fault in faults if fault is not None]), interrupted, messages.search(summary.status),
        '; '.join((*messages.far_events(), *_merged_events(config, merged, messages.first_ns or 0),
                   *_remarks(state, messages.foreign))))
    if request.report is not None and signals is not None and screen is not None:
        progress.phase('drawing the report')
        if last is not None and kept and last.stamp_ns > kept[-1].stamp_ns:
            kept.append(last)  # so that pictures and replay end with the numbers of the answer
        _report(request, result, state, signals, messages.events, last, kept, scores, found, embedded(screen, kept))
    return result


def _run(request: Request, messages: 'Messages') -> tuple[pipeline.State, list[Estimate], bool]:
    """Return the state after all messages, the estimates for the report, and whether the run was interrupted.

    The output that is asked for is written meanwhile. Raises FlexmanipError where no message can be used.
    """
    kept: list[Estimate] = []
    state, interrupted = pipeline.init(), False
    output = None if request.output is None else Output(request.output, request.config.payload_frame)
    with (output or nullcontext(), closing(Threads(REPLAY_THREADS)) as background,
          closing(read_ahead(messages)) as items):
        try:
            if output is None and request.report is None:  # only the last estimate is needed
                for now in pipeline.absorb(request.config, items, background):
                    state = now
            else:
                for now, estimate in pipeline.replay(request.config, items, background):
                    if now.counters.resets > state.counters.resets:
                        kept.clear()  # the report shows what the result is of
                    state = now
                    if estimate is not None and output is not None:
                        output.write(estimate)
                    if estimate is not None and request.report is not None:
                        kept.append(estimate)
        except MissingSignalError as err:
            raise MissingSignalError(
                err.problem, f"{err.remedy}, or let 'identify_bag {request.bag} --suggest FILE.yaml' choose") from err
        except KeyboardInterrupt:
            background.close(wait=False)
            state, interrupted = pipeline.taken(state), True
            messages.fault = BagError('interrupted', 'the messages until then are reported')
        if interrupted and state.counters.accepted == 0:
            raise KeyboardInterrupt
        if messages.fault is not None and state.counters.accepted == 0:  # an existing output file stays
            raise messages.fault
        if output is not None:
            output.start_ns = messages.first_ns
    return state, kept, interrupted


def _scored(request: Request, last: Estimate | None, signals: Signals
            ) -> tuple[whole_recording.Scores | None, ModelError | None]:
    """Return the scores of the last model on the samples held out, or why there are none."""
    model, constant = (None, None) if last is None else (last.model, last.constant)
    try:
        return whole_recording.score(
            model, signals, request.validate_from or 0.0, factor=request.config.decimation,
            horizon_s=request.horizon, constant=constant), None
    except ModelError as err:  # there is none yet
        return None, err


def _with_scores(summary: Summary, scores: whole_recording.Scores, horizon: float) -> Summary:
    return replace(
        summary, vaf_simulation_percent=tuple(scores.simulation.tolist()),
        vaf_prediction_percent=tuple(scores.prediction.tolist()), vaf_horizon_percent=tuple(scores.horizon.tolist()),
        horizon_reason=_horizon_reason(scores, horizon))


def _report(request: Request, result: Result, state: pipeline.State, signals: Signals,
            events: Sequence[CaptureEvent], last: Estimate | None, kept: Sequence[Estimate],
            scores: whole_recording.Scores | None, found: whole_recording.Sweep | None, player: str) -> None:
    """Write the report. kept: the estimates; found: frequencies of every configuration; player: page of the replay."""
    from flexmanip_ros.io import plots, report

    summary, config = result.summary, result.config
    bound, mass = None, summary.payload_mass_kg
    if summary.capture_time_s is not None and mass is not None:
        bound = payload_bound(config, signals, summary.capture_time_s, mass, state.clock.dt)
    report.identification_report(
        str(request.report), Path(request.bag).name, config, summary, plots.run(config, signals, kept, events),
        last, scores, {**state.counters._asdict(), 'dropped': state.counters.dropped}, bound=bound,
        fault='; '.join(str(words) for words in (result.fault, result.remark) if words), events=result.events,
        player=player, configurations=found)


class Messages:
    """Iterates over the messages of a recording up to its fault; keeps the signals for scores and figures.

    screen: takes the joint states, held-out ones included, and the events.
    """

    def __init__(self, request: Request, progress: Report, screen: Screen | None = None) -> None:
        self.fault: FlexmanipError | None = None
        self.foreign = 0
        """Messages that hold none of the configured joints."""
        self.first_ns: int | None = None
        """Stamp of the first message that can become a sample."""
        self.events: list[CaptureEvent] = []
        self.recorded: list[CaptureEvent] = []
        """The events that are neither given nor found in the signals."""
        self.is_kept = (request.smooth or request.validate_from is not None or request.report is not None
                        or request.configurations is not None)
        self._given: list[CaptureEvent] = []
        """The events of --capture-time and --release-time that are still to come."""
        self._blocks: list[JointBlock] = []
        """The joint states, where they are kept."""
        self._findings = capture_detection.Findings()
        self._looked = False
        self._search = ''
        """Text on why events were not looked for in the signals; else empty."""
        self._screen = screen
        self._request = request
        self._progress = progress
        self._joints = set(joints(request.config))

    def __iter__(self) -> Iterator[pipeline.Item]:
        request = self._request
        watch = self._watch()
        try:
            items: Iterable[JointBlock | CaptureEvent] = self._noted(
                bag.read_blocks(request.bag, request.topics, self._progress))
            if watch is not None:
                items = capture_detection.with_detected(watch, items, self._findings)
            for item in items:
                if not isinstance(item, CaptureEvent):
                    yield from self._joint_states(item)
                elif item.stamp_ns < self._limit_ns():
                    yield from self._due(item.stamp_ns)
                    yield from self._event(item)
        except BagError as error:
            self.fault = error
        yield from self._due(math.inf)

    def _noted(self, items: Iterable[JointBlock | CaptureEvent]) -> Iterator[JointBlock | CaptureEvent]:
        for item in items:
            if isinstance(item, CaptureEvent):
                self.recorded.append(item)
            yield item

    def far_events(self) -> list[str]:
        """Return what is wrong with each recorded event whose stamp is long before the first sample, and what to do."""
        first_ns = self.first_ns or 0
        return [f'the stamp of a {event.kind.value} is {event.stamp_ns * 1e-9:.6f}, '
                f'{(first_ns - event.stamp_ns) * 1e-9:.0f} s before the first sample: stamp an event with the time of '
                f'its samples, or give --{event.kind.value}-time'
                for event in self.recorded if first_ns - event.stamp_ns > FAR_EVENT_NS]

    def _watch(self) -> capture_detection.Watch | None:
        """Return the detector where events are to be looked for in the signals; say why where they are not.

        Detection costs about as much time as the payload estimate, so where events are announced it needs --detect.
        """
        request = self._request
        given = request.capture_time is not None or request.release_time is not None
        if request.detect is None and (request.config.payload_method == 'none' or given):
            return None
        if request.detect is False:
            self._search = 'none recorded, and not looked for (--no-detect)'
            return None
        try:
            watch = capture_detection.watch(request.config)
        except ParameterError as error:
            if request.detect:
                raise
            self._search = f'none recorded, and {error.problem}'
            return None
        announced = bag.event_topics(request.bag, request.topics) if request.detect is None else ()
        if announced:
            self._search = f'none on {", ".join(announced)}; --detect looks for them in the signals'
            return None
        self._looked = True
        return watch

    def search(self, status: str) -> str:
        """Return what was found in the signals, or why nothing was looked for; empty where events are known.

        status: name of the status of the last estimate.
        """
        found = [event for event in self._findings.events if event.stamp_ns < self._limit_ns()]
        if found:
            first_ns = self.first_ns or 0
            listed = ', '.join(f'{event.kind.value} at {(event.stamp_ns - first_ns) * 1e-9:.3f} s' for event in found)
            doubt = '' if status == Status.TRACKING.name else '; while the status is not TRACKING this is a guess'
            return f'found in the signals: {listed}{doubt}'
        if self._looked and not self._findings.watched:
            return ('the signals cannot tell: the empty arm does not move as its parameters say, or moves too '
                    'shortly; check the parameters arm.*, give those that --save-arm wrote of it, or --capture-time')
        if self._looked:
            return ('none found in the signals, so the arm is taken as empty' if not self.events else
                    'no others found in the signals') + '; give --capture-time if it caught something'
        return '' if self.events else self._search

    def _due(self, stamp_ns: float) -> Iterator[CaptureEvent]:
        """Yield the given events up to a stamp, in order among the recorded ones, so that the last one is the latest.

        One within event_merge_time of a recorded one comes before it and counts in its place.
        """
        while self._given and self._given[0].stamp_ns - self._request.config.event_merge_time * 1e9 <= stamp_ns:
            yield from self._event(self._given.pop(0))

    def _event(self, event: CaptureEvent) -> Iterator[CaptureEvent]:
        self.events.append(event)
        if self._screen is not None:
            self._screen.event(event)
        yield event

    def _joint_states(self, block: JointBlock) -> Iterator[pipeline.Item]:
        self.foreign += len(block.stamp_ns) * self._joints.isdisjoint(block.names)
        if self.is_kept:
            self._blocks.append(block)
        if self._screen is not None:
            self._screen.joint_states(block)
        if self.first_ns is None:
            self.first_ns = sampling.first_usable_ns(self._request.config, block)
            self._given = sorted(
                (CaptureEvent(self.first_ns + round(at * 1e9), kind)
                 for at, kind in ((self._request.capture_time, EventKind.CAPTURE),
                                  (self._request.release_time, EventKind.RELEASE))
                 if at is not None and self.first_ns is not None), key=lambda event: event.stamp_ns)
        yield from self._due(int(block.stamp_ns.max()))
        used = block.stamp_ns < self._limit_ns()
        if used.any():
            yield block if used.all() else block.part(used)

    def signals(self, friction: tuple[float, ...] | None = None) -> Signals:
        """Return the samples of the recording, held-out ones included. friction: see ``pipeline.State.friction``."""
        return sampling.collect(self._request.config, self._blocks, friction)

    def angles_held(self, signals: Signals) -> Array:
        """Return the identified angles since the last event (N, 2) [rad]; (0, 2) where none were read."""
        since = max((event.stamp_ns for event in self.events), default=0)
        used = (signals.stamp_ns >= since) & (signals.stamp_ns < self._limit_ns())
        return signals.angles[used] if signals.angles.shape[1] == 2 else np.zeros((0, 2))

    def _limit_ns(self) -> float:
        """Return the stamp from which on messages are held out of the identification [ns]."""
        limit = self._request.validate_from
        if limit is None or self.first_ns is None:
            return math.inf
        return self.first_ns + round(limit * 1e9)


def _no_configurations() -> FlexmanipError:
    return ModelError('the model is not one of every configuration, so --configurations has nothing to write',
                      'it needs over 1024 samples, decimation 1, two angles (with payload_method none only those that '
                      'are given) and, as outputs, half as many positions as the order; see docs/moving_arm.md')


def _no_arm() -> FlexmanipError:
    return SignalError('the recording taught nothing of the arm, so --save-arm has nothing to write',
                       'it needs payload_method structured, torques, angles and some 0.1 s of samples')


def _joined(faults: Sequence[FlexmanipError]) -> FlexmanipError | None:
    """Return the faults as one; None without any."""
    if len(faults) < 2:
        return faults[0] if faults else None
    return FlexmanipError('; '.join([*map(str, faults[:-1]), faults[-1].problem]), faults[-1].remedy)


def _save_arm(place: str, recording: str, config: IdentifierParameters, state: pipeline.State, last: Estimate | None
              ) -> bool:
    """Write the arm parameters that the recording gave as a file for every node; return False where it gave none."""
    found = () if state.payload is None else estimator.arm_parameters(config, state.payload.estimator)
    if not found:
        return False
    status = 'unknown' if last is None else last.status.name
    deviations = ', '.join(f'{one.name} {one.value:.6g} +- {one.std:.2g}' for one in found)
    heading = (f"What the arm taught in the recording '{recording}', status {status}. "
               f'Values and standard deviations: {deviations}.')
    write_text(place, yaml_text('rpbsid_identifier', as_parameters(config, found), heading))
    return True


def _horizon_reason(scores: whole_recording.Scores, horizon: float) -> str:
    """Return why the prediction ``horizon`` [s] ahead has no score; empty where there is one, or no score at all."""
    if not np.isnan(scores.horizon).all() or np.isnan(scores.prediction).all():
        return ''
    until = ' until the first gap' if scores.until_gap else ''
    return (f'unknown: {scores.time[-1] - scores.time[0]:.3f} s are held out{until}, too short for the --horizon of '
            f'{horizon:g} s; give a shorter one')


def _dropped(state: pipeline.State) -> FlexmanipError | None:
    """Return an error on messages with unusable numbers; None without such messages."""
    counters, rejection = state.counters, state.clock.rejection
    faulty = counters.not_finite + counters.unequal_sizes
    if not faulty or rejection is None:
        return None
    what = ' or '.join(words for count, words in (
        (counters.not_finite, 'NaN or infinity in a configured signal'),
        (counters.unequal_sizes, 'arrays of unequal sizes')) if count)
    words = f'{faulty} of {counters.received} messages hold {what} and were left out'
    if rejection.reason not in ('not_finite', 'unequal_sizes'):  # the latest one was left out for another reason
        return BagError(words, 'look at the publisher of the joint states')
    return BagError(f'{words}; the last of them: {rejection.problem}', rejection.remedy)


def _merged_events(config: IdentifierParameters, merged: Sequence[tuple[CaptureEvent, CaptureEvent]], first_ns: int
                   ) -> list[str]:
    """Return what is to be said of events that were taken for an earlier one (``distinct``) though their stamps differ.

    Not of one that was commanded and detected. first_ns: stamp of the first sample [ns].
    """
    apart = [(event, same) for event, same in merged if event.stamp_ns != same.stamp_ns and event.std_s == same.std_s]
    if not apart:
        return []
    (event, same), limit = apart[0], config.event_merge_time
    kind, at, before = event.kind.value, (event.stamp_ns - first_ns) * 1e-9, (same.stamp_ns - first_ns) * 1e-9
    more = f' (so were {len(apart) - 1} more)' if len(apart) > 1 else ''
    return [f'the {kind} at {at:.3f} s was taken for the one at {before:.3f} s, as event_merge_time is {limit:g} s'
            f'{more}: lower event_merge_time if it is another {kind}']


def _remarks(state: pipeline.State, foreign: int) -> list[str]:
    """Return what is to be said of messages left out and of events not applied at their stamp.

    foreign: number of messages of other publishers on the same topic, which are left out of this line.
    """
    counters, events = state.counters, state.payload
    left_out = [f'{count} {why}' for count, why in (
        (counters.missing_signal - foreign, 'without a configured signal'),
        (counters.late_stamp, 'with a stamp older than the one before'),
        (counters.repeated_stamp, 'with the stamp of the one before')) if count]
    parts = [f'of {counters.received} messages {", ".join(left_out)} were left out'] if left_out else []
    if counters.resets:
        parts.append(f'the stamps jumped back or changed their rate {counters.resets} times; '
                    'the result is of the samples after that')
    if events is not None:
        parts += [f'a {event.kind.value} has a stamp after the last sample and was not applied'
                 for event in events.pending]
        if events.late_events:
            one = events.late_events == 1
            parts.append(f'{events.late_events} {"event" if one else "events"} arrived more than rewind_time after '
                         f'{"its stamp and was" if one else "their stamps and were"} applied on arrival, or not at all '
                         'where a later one was known: the samples between were estimated as if nothing had been '
                         'caught or released; raise rewind_time, or announce events earlier')
    return parts
