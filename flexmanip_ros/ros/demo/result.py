"""What the demonstration came to: live against replay, estimate against truth, the picture."""

from __future__ import annotations

import struct
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from flexmanip_ros import messages, pipeline
from flexmanip_ros.arm.linearization import frequencies, vibration_model
from flexmanip_ros.io import bag
from flexmanip_ros.io.plots import Truth, collect, overview_figure
from flexmanip_ros.messages import Inertia, LabelledArray, Value
from flexmanip_ros.parameters import DemoParameters, IdentifierParameters, PlantParameters, flatten
from flexmanip_ros.parameters.document import yaml_text
from flexmanip_ros.types import CaptureEvent, Estimate, JointRecord

DIFFERENT = 1


@dataclass(frozen=True)
class Facts:
    """What was measured while the nodes ran; ``live``: per topic, what the identifier said, in order."""

    identifier: IdentifierParameters
    plant: PlantParameters
    seconds: float
    wall_s: float
    samples: int
    lost: int
    callback_p99_us: float
    live: Mapping[str, Sequence[Value]]
    problem: str = ''


def finish(config: DemoParameters, facts: Facts, folder: Path, console: Console) -> int:
    """Replay the bag, compare, draw and print; return the exit code."""
    if facts.problem:
        console.print(f"recording: {facts.problem}\nbag      {folder / 'bag'}")
        return DIFFERENT
    began = time.monotonic()
    items = list(bag.read(folder / 'bag'))
    estimates = list(pipeline.run(facts.identifier, items))
    different = compare(facts.live, outgoing(estimates, facts.identifier.payload_frame))
    replay_s = time.monotonic() - began
    truth = known_truth(config, facts.plant, items)
    picture = folder / 'overview.png'
    # The two lowest modes are those whose change a payload shows; with the next at 50 Hz they were one line.
    shown = [estimate._replace(modes=estimate.modes[:len(truth.before)]) for estimate in estimates]
    overview_figure(collect(facts.identifier, items, shown, truth), picture, _title(config))
    console.print(f'\n{facts.samples} samples in {facts.wall_s:.2f} s, {facts.lost} lost; '
                  f'identifier callback p99 {facts.callback_p99_us:.0f} us')
    console.print(_table(config, estimates, items, truth))
    if different:
        console.print(f'replay: {different}')
    else:
        count = sum(len(values) for values in facts.live.values())
        console.print(f'replay of the bag ({replay_s:.1f} s): all {count} live messages of the identifier, '
                      'bit for bit')
    settings = folder / 'identifier.yaml'
    settings.write_text(yaml_text('rpbsid_identifier', flatten(facts.identifier),
                                  'The identifier as it ran in this demonstration.'), encoding='utf-8')
    console.print(f"\nbag      {folder / 'bag'}\npicture  {picture}\n"
                  f"again    identify_bag {folder / 'bag'} --params {settings}")
    return DIFFERENT if different else 0


def outgoing(estimates: Iterable[Estimate], frame_id: str) -> dict[str, list[Value]]:
    """Return everything that estimates publish, per topic, in order."""
    said: dict[str, list[Value]] = {}
    for estimate in estimates:
        for name, value in messages.outgoing(estimate, frame_id):
            said.setdefault(name, []).append(value)
    return said


def compare(live: Mapping[str, Sequence[Value]], replayed: Mapping[str, Sequence[Value]]) -> str:
    """Return in words where two sets of messages differ in any bit; empty when they do not."""
    for name in sorted({*live, *replayed}):
        ours, theirs = live.get(name, ()), replayed.get(name, ())
        if len(ours) != len(theirs):
            return f'~/{name} has {len(ours)} messages live and {len(theirs)} replayed'
        for k, (one, other) in enumerate(zip(ours, theirs, strict=True)):
            if bits(one) != bits(other):
                return f'message {k} of ~/{name} differs between live and replay'
    return ''


def bits(value: Value) -> bytes:
    """Return a published value as bytes, equal only when every bit is."""
    if isinstance(value, LabelledArray):
        return repr(value.dimensions).encode() + np.asarray(value.data, dtype=np.float64).tobytes()
    if isinstance(value, Inertia):
        numbers = struct.pack('<10d', value.mass, *value.com, *value.inertia)
        return f'{value.stamp_ns} {value.frame_id} '.encode() + numbers
    return struct.pack('<d', value)


def known_truth(config: DemoParameters, plant: PlantParameters,
                items: Sequence[JointRecord | CaptureEvent]) -> Truth:
    """Return what the simulation knows: the payload, and the frequencies of the arm.

    It moves, and memory grows from the start and from the capture on: its mean configuration since counts.
    """
    records = [item for item in items if isinstance(item, JointRecord)]
    first_ns, end_ns = records[0].stamp_ns, records[-1].stamp_ns
    caught_ns = min((item.stamp_ns for item in items if isinstance(item, CaptureEvent)), default=end_ns)

    def lowest(mass: float, from_ns: int, until_ns: int) -> tuple[float, ...]:
        seen = [np.cumsum(record.position[:2]) for record in records
                if from_ns <= record.stamp_ns <= until_ns]
        found = frequencies(vibration_model(plant.arm, np.mean(seen, axis=0), mass)[0])
        return tuple(float(f) for f in found[:2])

    caught = config.capture_time >= 0.0
    return Truth(config.payload_mass if caught else None, lowest(0.0, first_ns, caught_ns),
                 lowest(config.payload_mass, min(caught_ns, end_ns), end_ns))


def _title(config: DemoParameters) -> str:
    if config.capture_time < 0.0:
        return 'Two flexible links, identified live'
    return (f'Two flexible links catch {config.payload_mass:g} kg after {config.capture_time:g} s, '
            'identified live')


def _table(config: DemoParameters, estimates: Sequence[Estimate],
           items: Sequence[JointRecord | CaptureEvent], truth: Truth) -> Table:
    """Return estimates beside the truth, before and after the capture."""
    table = Table('', 'estimate', '95 % interval', 'true')
    capture_ns = min((item.stamp_ns for item in items if isinstance(item, CaptureEvent)), default=None)
    before = [e for e in estimates if e.modes and (capture_ns is None or e.stamp_ns < capture_ns)]
    after = [e for e in estimates if e.modes and capture_ns is not None and e.stamp_ns >= capture_ns]
    for words, found, known in (('before', before, truth.before), ('after', after, truth.after)):
        for k, mode in enumerate(found[-1].modes[:len(known)] if found else ()):
            band = 1.96 * mode.frequency_std_hz
            low, high = mode.frequency_hz - band, mode.frequency_hz + band
            table.add_row(
                f'frequency {k + 1} {words} [Hz]', f'{mode.frequency_hz:.3f}',
                f'{low:.3f} .. {high:.3f}' if np.isfinite(band) else '-',
                f'{known[k]:.3f}' if k < len(known) else '-')
    held = [e.payload for e in estimates if e.payload is not None]
    if held and truth.payload is not None:
        last = held[-1]
        released = config.release_time >= 0.0
        table.add_row('payload [kg]', f'{last.mass:.3f}', f'{last.lower:.3f} .. {last.upper:.3f}',
                      f'{0.0 if released else truth.payload:.3f}')
        table.add_row('residual power / noise', f'{last.consistency:.2f}', '', '1')
        table.add_row('status', last.status.value, '', '')
    return table
