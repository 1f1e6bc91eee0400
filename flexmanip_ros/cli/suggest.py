"""What a recording holds, and the parameter file that suits it: ``identify_bag --suggest``."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from flexmanip_ros import pipeline
from flexmanip_ros.cli import console
from flexmanip_ros.errors import BagError, ParameterError
from flexmanip_ros.io import bag
from flexmanip_ros.io.outputs import check_place, write_text
from flexmanip_ros.io.parameter_file import parse_overrides, read
from flexmanip_ros.parameters import IdentifierParameters, configure
from flexmanip_ros.parameters.document import yaml_text
from flexmanip_ros.parameters.field import check, leaves
from flexmanip_ros.parameters.identifier import FIELDS
from flexmanip_ros.samples import sampling
from flexmanip_ros.samples.sample_log import Signals
from flexmanip_ros.studies import suggestion
from flexmanip_ros.types import Array, CaptureEvent, JointBlock

NODE = 'rpbsid_identifier'
STILL = 1e-9
"""Ratio of standard deviation to largest magnitude below which a signal counts as standing still."""
MOST_OUTPUTS = 8
"""Largest number of outputs chosen: the computing time of the identifier grows with its square."""
DEFAULTS = IdentifierParameters()


@dataclass(frozen=True)
class Found:
    """One signal of a recording. low, high: its range; std: standard deviation; rate: samples a second [Hz]."""

    name: str
    low: float
    high: float
    std: float
    rate: float
    broken: int
    """Number of values that are not finite."""
    count: int
    """Number of values."""

    @property
    def varies(self) -> bool:
        """Whether its finite values vary."""
        return self.std > STILL * max(abs(self.low), abs(self.high))

    @property
    def finite(self) -> bool:
        """Whether most of its values are finite; messages with another value are left out."""
        return 2 * self.broken < self.count

    @property
    def moves(self) -> bool:
        """Whether it can be an input or an output."""
        return self.finite and self.varies

    def text(self) -> str:
        """Return the signal as a line to print."""
        what = (f'{self.low:.4g} .. {self.high:.4g}, standard deviation {self.std:.3g}'
                if self.varies else f'stands still at {self.low:.4g}')
        broken = f'; {self.broken} of {self.count} values are not finite' if self.broken else ''
        return f'{self.name:28s} {self.rate:.4g} Hz   {what}{broken}'


def given_values(path: str | None, overrides: list[str]) -> dict[str, Any]:
    """Return what --params and --set say, each value checked on its own. Raises ParameterError."""
    values = {**({} if path is None else read(path, NODE)), **parse_overrides(overrides)}
    declared = {leaf.name: leaf for leaf in leaves(IdentifierParameters)}
    for name in values:
        if name not in declared:
            configure(IdentifierParameters, {name: values[name]})
    return {name: check(declared[name], value) for name, value in values.items()}


def suggest(source: str, place: str, given: Mapping[str, Any], topics: bag.Topics, until_s: float | None,
            horizon_s: float, events_s: Sequence[float] = ()) -> tuple[IdentifierParameters, list[str]]:
    """Look at a recording and write the parameters to identify it with; return them and the lines to print.

    given: parameters that stay as they are; until_s: time from which on samples are not looked at [s]; events_s:
    captures and releases beside those recorded, seconds after the first sample.
    Raises FlexmanipError where the recording tells too little, and where the file cannot be written.
    """
    check_place(place, '.yaml', '.yml')
    with console.progress('looking at the signals', 'messages') as shown:
        blocks, events = _recording(source, topics, until_s, shown)
    signals = observe(blocks)
    chosen, reasons = choose_signals(signals, given)
    config = configure(IdentifierParameters, {**given, **chosen})
    collected, dt = _collect(config, blocks, events, events_s)
    for name, values in (('inputs', collected.u), ('outputs', collected.y)):
        if not np.any(np.ptp(values, axis=0) > 0.0):
            raise ParameterError(f'no signal of {name} moves: {", ".join(getattr(config, name))}',
                                 f'name others with --set {name}=[NAME/FIELD, ...]')
    with console.progress('trying models', 'steps') as shown:
        found, more = suggestion.suggest({**given, **chosen}, collected, dt, horizon_s, shown)
    words = [f'{name}: {why}' for name, why in (*reasons, *more)]
    heading = f'Suggested by identify_bag --suggest for {Path(source).resolve().name}.'
    write_text(place, file_text(heading, words, found))
    lines = [*(f'signal       {signal.text()}' for signal in signals), *(f'suggested    {line}' for line in words),
             f'written      {place}']
    return configure(IdentifierParameters, found), lines


def file_text(heading: str, words: Sequence[str], values: Mapping[str, Any]) -> str:
    """Return a parameter file for any node name, with the reasons in front."""
    return '\n'.join([f'# {heading}', *(f'# * {line}' for line in words), yaml_text(NODE, values)])


def _recording(source: str, topics: bag.Topics, until_s: float | None, progress: bag.Progress
               ) -> tuple[list[JointBlock], list[int]]:
    """Return the blocks of a recording up to a time, and the stamps of its events [ns].

    The time counts from the first message with any of the same joints. Of a damaged recording they are what comes
    before the damage.
    """
    starts: dict[str, int] = {}
    blocks: list[JointBlock] = []
    events: list[int] = []
    is_cut = until_s is None
    try:
        for item in bag.read_blocks(source, topics, progress):
            if isinstance(item, CaptureEvent):
                events.append(item.stamp_ns)
                continue
            start = int(item.stamp_ns[0])
            first = min((starts.setdefault(name, start) for name in item.names), default=start)
            used = np.full(len(item.stamp_ns), True) if until_s is None else (
                item.stamp_ns < first + round(until_s * 1e9))
            is_cut |= not used.all()
            if used.any():
                blocks.append(item if used.all() else item.part(used))
    except BagError:
        if not blocks:
            raise
    if not blocks:
        raise ParameterError(f'the recording has no sample before {until_s:g} s', 'choose a later time')
    if not is_cut:
        raise ParameterError(f'the recording has no sample to score from {until_s:g} s on', 'choose an earlier time')
    return blocks, events


def observe(blocks: list[JointBlock]) -> list[Found]:
    """Return every signal of a recording, in the order of the messages."""
    parts: dict[str, list[Array]] = {}
    """Stamps and values (2, N) of each signal in each block."""
    for block in blocks:
        for kind in FIELDS:
            values = getattr(block, kind)
            for k, joint in enumerate(block.names) if values.shape[1] == len(block.names) else ():
                parts.setdefault(f'{joint}/{kind}', []).append(np.stack([block.stamp_ns, values[:, k]]))
    found = []
    for name, tables in parts.items():
        at, values = np.hstack(tables)
        good = values[np.isfinite(values)]
        interval = float(np.median(np.diff(at))) * 1e-9 if len(at) > 1 else 0.0
        found.append(Found(
            name, *((float(good.min()), float(good.max()), float(good.std())) if len(good) else (0.0, 0.0, 0.0)),
            1.0 / interval if interval > 0.0 else 0.0, len(values) - len(good), len(values)))
    return found


def choose_signals(signals: list[Found], given: Mapping[str, Any]
                   ) -> tuple[dict[str, Any], list[tuple[str, str]]]:
    """Return inputs, outputs, angles and payload_method, and why. Raises ParameterError where nothing serves."""
    moving = [signal.name for signal in signals if signal.moves]
    chosen: dict[str, Any] = {}
    reasons: list[tuple[str, str]] = []
    for name in ('inputs', 'outputs'):
        if name in given:
            _check_there(name, given[name], signals)
            names, why = given[name], 'given'
        else:
            names, why = _inputs(moving) if name == 'inputs' else _outputs(moving, chosen['inputs'])
        if not names:
            bad = ', '.join(signal.name for signal in signals if not signal.finite)
            why += f'; most values are not finite of {bad}' if bad else ''
            still = [signal.name for signal in signals if signal.finite and not signal.varies]
            still = [signal for signal in still if signal.endswith('/effort')] if name == 'inputs' else still
            why += f'; where it was looked at, these stand still: {", ".join(still)}' if still else ''
            raise ParameterError(f'nothing in the recording serves for {name}: they would be {why}',
                                 f'name them with --set {name}=[NAME/FIELD, ...]')
        chosen[name] = names
        reasons.append((name, f'{", ".join(names)}: {why}'))
    is_arm = any(name.startswith('arm.') for name in given)
    chosen['payload_method'] = given.get('payload_method', DEFAULTS.payload_method if is_arm else 'none')
    chosen['angles'] = given.get('angles', DEFAULTS.angles if chosen['payload_method'] != 'none' else ())
    reasons.append(('payload_method', chosen['payload_method'] + (
        ': given' if 'payload_method' in given else ': the parameters arm.* are given' if is_arm
        else ': a recording does not tell the parameters arm.*')))
    return chosen, reasons


def _inputs(moving: list[str]) -> tuple[tuple[str, ...], str]:
    there = set(moving)
    if set(DEFAULTS.inputs) <= there and not there.isdisjoint(DEFAULTS.outputs):  # many robots have joint1 and joint2
        return DEFAULTS.inputs, 'the names say it'
    return tuple(name for name in moving if name.endswith('/effort')), 'every effort that moves'


def _outputs(moving: list[str], inputs: tuple[str, ...]) -> tuple[tuple[str, ...], str]:
    if inputs == DEFAULTS.inputs:
        kept = tuple(name for name in DEFAULTS.outputs if name in moving)
        if kept:
            return kept, 'the names say it'
    joints = dict.fromkeys(name.rpartition('/')[0] for name in moving)
    kinds = [next((f'{joint}/{kind}' for kind in ('position', 'velocity') if f'{joint}/{kind}' in moving), '')
             for joint in joints]
    kept = tuple(name for name in kinds if name and name not in inputs)
    why = 'every position that moves, else the velocity'
    if len(kept) <= MOST_OUTPUTS:
        return kept, why
    return kept[:MOST_OUTPUTS], f'{why}; the first {MOST_OUTPUTS} of {len(kept)}'


def _check_there(group: str, names: tuple[str, ...], signals: list[Found]) -> None:
    there = {signal.name for signal in signals}
    missing = [name for name in names if name not in there]
    if missing:
        raise ParameterError(f"'{missing[0]}' of parameter '{group}' is not in the messages",
                             f'the signals there are: {", ".join(sorted(there))}')


def _collect(config: IdentifierParameters, blocks: list[JointBlock], events: list[int], events_s: Sequence[float]
             ) -> tuple[Signals, float]:
    """Return the signals of the longest time between two events, and the sample time [s]."""
    clock, log = sampling.Clock(), sampling.EMPTY
    for block in blocks:
        clock, log, _ = sampling.push_whole(config, clock, log, block)
    clock, log, _ = sampling.flush(config, clock, log)
    pipeline.check_used(pipeline.State(clock))
    whole = sampling.signals(config, clock, log)
    if len(whole.stamp_ns) < 2:
        raise ParameterError(f'{len(whole.stamp_ns)} samples are too few to choose parameters from',
                             'record for longer')
    events = [*events, *(int(whole.stamp_ns[0]) + round(at * 1e9) for at in events_s)]
    borders = np.searchsorted(whole.stamp_ns, sorted(events)).tolist()
    a, b = max(pairwise([0, *borders, len(whole.stamp_ns)]), key=lambda pair: pair[1] - pair[0])
    return replace(whole, stamp_ns=whole.stamp_ns[a:b], u=whole.u[a:b], y=whole.y[a:b], angles=whole.angles[a:b],
                   gap=whole.gap[a:b], missing=whole.missing[a:b], with_friction=None), clock.dt
