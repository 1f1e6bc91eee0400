"""Whole pictures put together from the parts in ``plots``: one run at a glance, and one for each section."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from flexmanip_ros.io import plots
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.samples import sampling
from flexmanip_ros.samples.sample_log import Signals
from flexmanip_ros.studies.holdout import Scores
from flexmanip_ros.types import Array, CaptureEvent, Estimate, EventKind, JointRecord


@dataclass(frozen=True)
class Truth:
    """What a simulation knows, drawn beside the estimates.

    payload: mass held after a capture [kg]; before, after: frequencies [Hz] without and with it.
    """

    payload: float | None = None
    before: tuple[float, ...] = ()
    after: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class Run:
    """A run as the pictures need it."""

    signals: Signals
    estimates: Sequence[Estimate]
    events: tuple[plots.Event, ...]
    has_arm: bool
    """Bends are metres of a known arm; otherwise units are what the user's JointState has."""
    truth: Truth = Truth()

    @property
    def start_ns(self) -> int:
        """Stamp of the first sample."""
        return int(self.signals.stamp_ns[0]) if self.signals.stamp_ns.size else 0

    @property
    def end(self) -> float:
        """Time of the last sample [s]."""
        return float(self.signals.time[-1]) if self.signals.stamp_ns.size else 0.0


def collect(config: IdentifierParameters, items: Iterable[JointRecord | CaptureEvent],
            estimates: Sequence[Estimate], truth: Truth | None = None) -> Run:
    """Return a run from the messages that went in and the estimates that came out."""
    items = list(items)
    seen = [item for item in items if isinstance(item, CaptureEvent)]
    return run(config, sampling.collect(config, items), estimates, seen, truth)


def run(config: IdentifierParameters, signals: Signals, estimates: Sequence[Estimate],
        events: Iterable[CaptureEvent], truth: Truth | None = None) -> Run:
    """Return a run from its columns; events announced twice are drawn once."""
    start = int(signals.stamp_ns[0]) if signals.stamp_ns.size else 0
    found: list[plots.Event] = []
    for event in sorted(events, key=lambda item: item.stamp_ns):
        time = (event.stamp_ns - start) * 1e-9
        if not any(kind is event.kind and abs(time - at) <= config.event_merge_time for at, kind in found):
            found.append((time, event.kind))
    return Run(signals, estimates, tuple(found), config.payload_method != 'none', truth or Truth())


def overview_figure(made: Run, path: str | Path, title: str = '') -> None:
    """Write one picture of a run as PNG: torques, bends, frequencies, payload, status over time."""
    groups = signal_groups(made)
    with_payload = any(estimate.payload is not None for estimate in made.estimates)
    heights = [1.5] * len(groups) + [2.2] + [2.2] * with_payload + [0.35]
    drawn, axes = plots.figure(len(heights), heights)
    for ax, group in zip(axes, groups, strict=False):
        plots.lines(ax, made.signals.time, *group)
    _estimates(axes[len(groups):], made, with_payload)
    plots.events(axes, made.events)
    if title:
        drawn.suptitle(title, x=0.02, ha='left', fontsize=13, fontweight='bold')
    plots.save(drawn, path)


def _estimates(axes: Sequence[Any], made: Run, with_payload: bool) -> None:
    frequency_truth, payload_truth = _stretches(made)
    plots.frequencies(axes[0], made.estimates, made.start_ns, frequency_truth)
    if with_payload:
        plots.payload(axes[1], made.estimates, made.start_ns, payload_truth)
    plots.statuses(axes[-1], made.estimates, made.start_ns)
    axes[-1].set_xlim(0.0, made.end or 1.0)


def _stretches(made: Run) -> tuple[list[plots.Known], list[tuple[float, float, float]]]:
    """Return what is true from when to when: empty before the first capture, held until a release."""
    frequencies: list[plots.Known] = []
    masses: list[tuple[float, float, float]] = []
    changes = [(time, kind is EventKind.CAPTURE) for time, kind in made.events]
    for (begin, held), (end, _) in pairwise([(0.0, False), *changes, (made.end, False)]):
        known = made.truth.after if held else made.truth.before
        if known:
            frequencies.append((begin, end, known))
        if made.truth.payload is not None:
            masses.append((begin, end, made.truth.payload if held else 0.0))
    return frequencies, masses


def signals_figure(made: Run) -> Figure:
    """Draw inputs and outputs over time."""
    groups = signal_groups(made)
    drawn, axes = plots.figure(len(groups), [1.7] * len(groups))
    for ax, group in zip(axes, groups, strict=True):
        plots.lines(ax, made.signals.time, *group)
    axes[-1].set_xlim(0.0, made.end or 1.0)
    plots.events(axes, made.events)
    return drawn


def frequency_figure(made: Run) -> Figure:
    """Draw the frequencies with their bands, and the status."""
    drawn, axes = plots.figure(2, [3.2, 0.35])
    _estimates(axes, made, with_payload=False)
    plots.events(axes, made.events)
    return drawn


def payload_figure(made: Run) -> Figure:
    """Draw the payload with its interval, whole and close up; the consistency of the residuals below."""
    drawn, axes = plots.figure(3, [2.0, 2.4, 1.3])
    plots.payload(axes[0], made.estimates, made.start_ns, _stretches(made)[1])
    plots.payload(axes[1], made.estimates, made.start_ns, _stretches(made)[1], zoom=True)
    rows = [estimate for estimate in made.estimates if estimate.payload is not None]
    values = np.array([e.payload.consistency for e in rows if e.payload is not None], dtype=np.float64)
    axes[2].plot(plots.times(rows, made.start_ns), values, color=plots.COLOURS[0], linewidth=1.2)
    axes[2].axhline(1.0, color='#555555', linewidth=1.0, linestyle=':')
    finite = values[np.isfinite(values)]
    if finite.size:
        axes[2].set_ylim(0.0, max(2.0, 1.2 * float(np.percentile(finite, 98))))
    axes[2].set_ylabel('residual power\n[-], noise = 1')
    axes[-1].set_xlim(0.0, made.end or 1.0)
    plots.events(axes, made.events)
    return drawn


def validation_figure(scores: Scores, outputs: Sequence[str], *, has_arm: bool) -> Figure:
    """Draw what was measured after the identification, and what the model said."""
    drawn, axes = plots.figure(len(outputs), [1.7] * len(outputs))
    for k, (ax, name) in enumerate(zip(axes, outputs, strict=True)):
        joint, _, field = name.rpartition('/')
        _, unit, scale = _quantity(joint, field, has_arm)
        for values, label, colour, width, line in (
                (scores.measured, 'measured', '#9A9A9A', 2.6, plots.LINES[0]),
                (scores.simulated, 'simulated', plots.COLOURS[1], 1.1, plots.LINES[0]),
                (scores.predicted, 'one step ahead', plots.COLOURS[0], 0.9, plots.LINES[1])):
            ax.plot(*plots.envelope(scores.time, scale * values[:, k]), color=colour, linewidth=width,
                    linestyle=line, label=label)
        spread = scale * scores.measured[:, k]
        room = 0.3 * (float(spread.max() - spread.min()) or 1.0)
        ax.set_ylim(float(spread.min()) - room, float(spread.max()) + room)
        ax.set_ylabel(f'{joint}\n{field}\n[{unit}]')
        ax.set_title(f'VAF {scores.simulation[k]:.2f} % simulated, {scores.prediction[k]:.2f} % predicted',
                     loc='left', fontsize=9)
        if k == 0:
            plots.legend(ax)
    return drawn


def signal_groups(made: Run) -> list[tuple[Array, list[str], str, str]]:
    """Return (columns, labels, title, unit) of the signals that belong in one plot."""
    found: dict[tuple[str, str, float], list[tuple[str, Array]]] = {}
    for names, table in ((made.signals.inputs, made.signals.u), (made.signals.outputs, made.signals.y)):
        for k, name in enumerate(names):
            joint, _, field = name.rpartition('/')
            found.setdefault(_quantity(joint, field, made.has_arm), []).append((joint, table[:, k]))
    return [(scale * np.column_stack([values for _, values in group]), [label for label, _ in group],
             title, unit) for (title, unit, scale), group in found.items()]


def _quantity(joint: str, field: str, has_arm: bool) -> tuple[str, str, float]:
    if field == 'effort':
        return 'torque', 'N m', 1.0
    if not has_arm:
        return field, 'rad or m' if field == 'position' else 'rad/s or m/s', 1.0
    if 'bend' in joint:
        return ('bend', 'mm', 1e3) if field == 'position' else ('bend rate', 'mm/s', 1e3)
    return ('angle', 'rad', 1.0) if field == 'position' else ('rate', 'rad/s', 1.0)
