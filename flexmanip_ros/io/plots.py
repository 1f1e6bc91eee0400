"""Figures of a run: first the parts that all figures share, then the figures of one run.

Every axis has its unit, and every event is marked. The colours are those of ``view/screen.py``. matplotlib is imported
only here and in other modules that draw.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from flexmanip_ros.event_replay import distinct
from flexmanip_ros.io import outputs
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.samples.sample_log import Signals
from flexmanip_ros.studies.whole_recording import Scores, Smoothed, Sweep
from flexmanip_ros.types import QUANTILE, Array, CaptureEvent, Estimate, EventKind, Status
from flexmanip_ros.view import screen

LINES: tuple[Any, ...] = ('-', (0, (4, 1.2)), (0, (1.2, 1)), (0, (6, 1.2, 1.2, 1.2)))
"""Line styles, so that signals in one plot differ by more than their colour."""
TRUTH_COLOUR = '#000000'
SMOOTHED_COLOUR = '#404040'
WIDTH = 10.0
"""Width of a figure [inches], about that of a page."""
DPI = 120
POINTS = 2000
"""Number of points above which a line is thinned out."""

Event = tuple[float, EventKind]
Known = tuple[float, float, Sequence[float]]
"""Begin and end [s] of a stretch, and its true frequencies [Hz]."""


def figure(heights: Sequence[float], *, columns: int = 1, share_time: bool = True) -> tuple[Figure, list[Any]]:
    """Return a figure of the page's width and its axes, row by row. heights: those of the rows [inches].

    share_time: all axes share one time axis, labelled at the bottom.
    """
    made = Figure(figsize=(WIDTH, float(sum(heights)) + 0.6), dpi=DPI, layout='constrained')
    FigureCanvasAgg(made)
    axes = made.subplots(len(heights), columns, sharex=share_time, squeeze=False, height_ratios=list(heights)).ravel()
    for ax in axes:
        ax.grid(True, color='#E4E4E4', linewidth=0.7)
        ax.set_axisbelow(True)
        ax.spines[['top', 'right']].set_visible(False)
    if share_time:
        axes[-1].set_xlabel('time since the first sample [s]')
    return made, list(axes)


def lines(ax: Any, time: Array, columns: Array, labels: Sequence[str], title: str, unit: str) -> None:
    """Draw signals (N, k) over time."""
    rows = screen.thinned(np.column_stack([time, columns]), POINTS)
    for k, label in enumerate(labels):
        ax.plot(rows[:, 0], rows[:, 1 + k], color=screen.COLOURS[k % len(screen.COLOURS)],
                linestyle=LINES[k % len(LINES)], linewidth=1.1, label=label)
    ax.set_ylabel(f'{title}\n[{unit}]')
    legend(ax)


def legend(ax: Any) -> None:
    """Put the legend beside the plot, where it hides nothing."""
    if ax.get_legend_handles_labels()[0]:
        ax.legend(loc='upper left', bbox_to_anchor=(1.005, 1.0), frameon=False, fontsize=9, borderaxespad=0.0)


def events(axes: Iterable[Any], found: Sequence[Event]) -> None:
    """Mark captures and releases in every plot, named in the first; those outside of its times are not named."""
    for index, ax in enumerate(axes):
        for time, kind in found:
            ax.axvline(time, color=screen.EVENT_COLOUR, linestyle='--', linewidth=1.2)
            if index == 0:
                ax.annotate(f'{kind.value} {time:.2f} s', (time, 1.0), xycoords=('data', 'axes fraction'),
                            xytext=(3, 3), textcoords='offset points', color=screen.EVENT_COLOUR, fontsize=9,
                            annotation_clip=True)


def frequencies(ax: Any, estimates: Sequence[Estimate], start_ns: int, truth: Sequence[Known] = ()) -> None:
    """Draw the identified frequencies with their 95 % bands."""
    found = outputs.columns(estimates, start_ns)
    values, stds = found['frequency_hz'], found['frequency_std_hz']
    count = values.shape[1]
    for k in range(count):
        _band(ax, found['time_s'], values[:, k], stds[:, k], k)
    for index, (begin, end, known) in enumerate(truth):
        for k, frequency in enumerate(known):
            ax.plot([begin, end], [frequency] * 2, color=TRUTH_COLOUR, linestyle=(0, (4, 3)), linewidth=1.1,
                    label='true' if index == k == 0 else None)
    if count:
        known_all = [f for _, _, known in truth for f in known]
        if known_all:  # the true frequencies set the range, so that their change is visible
            room = max(max(known_all) - min(known_all), 0.1 * max(known_all))
            ax.set_ylim(min(known_all) - room, max(known_all) + room)
        else:
            trusted = np.array([estimate.model_status is Status.TRACKING for estimate in estimates])
            shown = _lowest(values, stds, trusted)
            known = shown[trusted][np.isfinite(shown[trusted])]
            limit(ax, shown, np.percentile(known, [2, 98]).tolist() if known.size else [])
            ax.set_ylim(bottom=max(ax.get_ylim()[0], 0.0))
        _note_beyond(ax, values[-1])
    ax.set_ylabel('frequency\n[Hz]')
    legend(ax)


def _band(ax: Any, x: Array, frequency: Array, std: Array, k: int) -> None:
    """Draw the frequency of mode k over x with its 95 % band."""
    colour, spread = screen.COLOURS[k % len(screen.COLOURS)], QUANTILE * std
    ax.fill_between(x, frequency - spread, frequency + spread, color=colour, alpha=0.2, linewidth=0)
    ax.plot(x, frequency, color=colour, linestyle=LINES[k % len(LINES)], linewidth=1.4,
            label=f'mode {k + 1}, 95 % band')


def _lowest(values: Array, stds: Array, trusted: NDArray[np.bool_]) -> Array:
    """Return the frequencies (T, k) that set the range of a plot; those far above the lowest known one are NaN.

    Noise gives modes far above those of the arm; a range that includes them would hide the change at a capture.
    trusted: (T,) rows in which the lowest mode is one of the arm, whatever it is later: a capture may quarter it.
    """
    settled, spread = values[values.shape[0] // 2:], stds[values.shape[0] // 2:]
    low = settled[np.isfinite(settled)]
    known = settled[QUANTILE * spread <= screen.KNOWN_BAND * settled]  # a drift of the sensors gives a mode near 0 Hz
    if known.size:
        low = known
    if low.size == 0:
        return values
    lowest = np.where(trusted, values[:, 0], np.percentile(low, 5))
    return np.where(values <= screen.MODES_APART * lowest[:, None], values, np.nan)


def _note_beyond(ax: Any, last: Array) -> None:
    """Write into a corner which modes of the last estimate lie outside the range."""
    low, high = ax.get_ylim()
    beyond = [f'{value:.1f}' for value in last if np.isfinite(value) and not low <= value <= high]
    if beyond:
        ax.annotate(f'outside: {", ".join(beyond)} Hz', (1.0, 0.97), ha='right', va='top', fontsize=9,
                    xycoords='axes fraction', color='#555555')


def payload(ax: Any, estimates: Sequence[Estimate], start_ns: int,
            truth: Sequence[tuple[float, float, float]] = (), *, zoom: bool = False) -> None:
    """Draw the payload with its 95 % interval.

    truth: (from [s], to [s], mass [kg]) of each stretch; zoom: show the range of the late estimates, without zero.
    """
    found = _with_payload(estimates, start_ns)
    time, table = found['time_s'], np.column_stack([found[f'payload_{name}_kg'] for name in ('mass', 'lower', 'upper')])
    ax.plot(time, table[:, 0], color=screen.PAYLOAD_COLOUR, linewidth=1.5, label='estimate')
    for index, (begin, end, mass) in enumerate(truth):
        ax.plot([begin, end], [mass, mass], color=TRUTH_COLOUR, linestyle=(0, (4, 3)), linewidth=1.2,
                label='true' if index == 0 else None)
    limit(ax, table, [mass for _, _, mass in truth[-1:]] if zoom else [0.0, *(mass for _, _, mass in truth)])
    shown = ax.get_ylim()
    ax.fill_between(time, table[:, 1], np.minimum(table[:, 2], shown[1]), color=screen.PAYLOAD_COLOUR, alpha=0.25,
                    linewidth=0, label='95 % interval')
    ax.set_ylim(shown)
    last = table[-1] if len(table) and np.isfinite(table[-1]).all() else None
    if last is not None and not zoom:
        width = max(float(last[2] - last[1]), 1e-6)
        digits = min(max(1 - math.floor(math.log10(width)), 0), 6)  # two significant digits of the interval's width
        words = f'{last[0]:.{digits}f} kg, 95 %: {last[1]:.{digits}f} to {last[2]:.{digits}f} kg'
        ax.annotate(words, (1.0, 0.03), ha='right', va='bottom', xycoords='axes fraction',
                    color=screen.PAYLOAD_COLOUR, fontsize=10, fontweight='bold')
    ax.set_ylabel('payload, close up\n[kg]' if zoom else 'payload\n[kg]')
    legend(ax)


def _with_payload(estimates: Sequence[Estimate], start_ns: int) -> dict[str, Array]:
    """Return the columns of the estimates that have a payload."""
    return outputs.columns([estimate for estimate in estimates if estimate.payload is not None], start_ns)


def limit(ax: Any, values: Array, known: Sequence[float]) -> None:
    """Set the vertical range by the second half of the values, so that a transient does not hide the rest."""
    late = values[values.shape[0] // 2:]
    late = late[np.isfinite(late)]
    every = np.concatenate([values[np.isfinite(values)], np.asarray(known, dtype=np.float64)])
    if late.size == 0 or every.size == 0:
        return
    settled = np.concatenate([np.percentile(late, [2, 98]), np.asarray(known, dtype=np.float64)])
    low, high = float(settled.min()), float(settled.max())
    middle = np.percentile(every, [5, 95])
    room = max(high - low, 0.02 * max(abs(high), abs(low)), 1e-6)
    low, high = max(low - 1.5 * room, min(low, middle[0])), min(high + 1.5 * room, max(high, middle[1]))
    ax.set_ylim(low - 0.15 * room, high + 0.15 * room)


def statuses(ax: Any, estimates: Sequence[Estimate], start_ns: int) -> None:
    """Draw the status over time."""
    time = outputs.columns(estimates, start_ns)['time_s']
    changes = [k for k in range(1, len(estimates)) if estimates[k].status is not estimates[k - 1].status]
    for begin, end in pairwise([0, *changes, len(estimates) - 1] if estimates else []):
        ax.axvspan(time[begin], time[end], **_status_look(estimates[begin].status))
    seen = dict.fromkeys(estimate.status for estimate in estimates)
    ax.set_yticks([])
    ax.set_ylabel('status', rotation=0, ha='right', va='center')
    ax.grid(False)
    names = [Patch(label=s.name.lower().replace('_', ' '), **_status_look(s)) for s in seen]
    ax.legend(handles=names, loc='upper left', bbox_to_anchor=(1.005, 1.2), frameon=False, fontsize=9,
              borderaxespad=0.0)


def _status_look(status: Status) -> dict[str, Any]:
    colour, hatch = screen.STATUS_LOOKS[status]
    return {'facecolor': colour, 'hatch': hatch, 'edgecolor': '#FFFFFF', 'linewidth': 0}


@dataclass(frozen=True)
class Truth:
    """The true values of a simulation, drawn beside the estimates.

    payload: mass of the object [kg]; before, after: frequencies [Hz] without and with it.
    """

    payload: float | None = None
    before: tuple[float, ...] = ()
    after: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class Run:
    """The signals, estimates and events of a run."""

    signals: Signals
    estimates: Sequence[Estimate]
    events: tuple[Event, ...]
    has_arm: bool
    """Whether the signals are those of an arm, so that positions of bends are in metres."""
    truth: Truth

    @property
    def start_ns(self) -> int:
        """Stamp of the first sample."""
        return int(self.signals.stamp_ns[0]) if self.signals.stamp_ns.size else 0

    @property
    def end(self) -> float:
        """Time of the last sample [s]."""
        return float(self.signals.time[-1]) if self.signals.stamp_ns.size else 0.0


def run(config: IdentifierParameters, signals: Signals, estimates: Sequence[Estimate],
        events: Iterable[CaptureEvent], truth: Truth | None = None) -> Run:
    """Return a run from its signals; of events that are taken for one (``event_replay.distinct``) the first is kept."""
    start = int(signals.stamp_ns[0]) if signals.stamp_ns.size else 0
    counted = sorted(distinct(config, events)[0], key=lambda event: event.stamp_ns)
    found = [((event.stamp_ns - start) * 1e-9, event.kind) for event in counted]
    return Run(signals, estimates, tuple(found), config.payload_method != 'none', truth or Truth())


def overview_figure(made: Run, path: str | Path, title: str) -> None:
    """Write one picture of a run as PNG: torques, bends, frequencies, payload, status over time."""
    groups = signal_groups(made)
    with_payload = any(estimate.payload is not None for estimate in made.estimates)
    heights = [1.5] * len(groups) + [2.2] + [2.2] * with_payload + [0.35]
    drawn, axes = figure(heights)
    for ax, group in zip(axes, groups, strict=False):
        lines(ax, made.signals.time, *group)
    _estimates(axes[len(groups):], made, with_payload)
    events(axes, made.events)
    drawn.suptitle(title, x=0.02, ha='left', fontsize=13, fontweight='bold')
    drawn.savefig(str(path), format='png')


def _estimates(axes: Sequence[Any], made: Run, with_payload: bool) -> None:
    frequency_truth, payload_truth = _stretches(made)
    frequencies(axes[0], made.estimates, made.start_ns, frequency_truth)
    if with_payload:
        payload(axes[1], made.estimates, made.start_ns, payload_truth)
    statuses(axes[-1], made.estimates, made.start_ns)
    axes[-1].set_xlim(0.0, made.end or 1.0)


def _stretches(made: Run) -> tuple[list[Known], list[tuple[float, float, float]]]:
    """Return the true frequencies and masses of each stretch between two events."""
    frequencies: list[Known] = []
    masses: list[tuple[float, float, float]] = []
    changes = [(time, kind is EventKind.CAPTURE) for time, kind in made.events]
    for (begin, is_loaded), (end, _) in pairwise([(0.0, False), *changes, (made.end, False)]):
        known = made.truth.after if is_loaded else made.truth.before
        if known:
            frequencies.append((begin, end, known))
        if made.truth.payload is not None:
            masses.append((begin, end, made.truth.payload if is_loaded else 0.0))
    return frequencies, masses


def signals_figure(made: Run) -> Figure:
    """Draw inputs and outputs over time."""
    groups = signal_groups(made)
    drawn, axes = figure([1.7] * len(groups))
    for ax, group in zip(axes, groups, strict=True):
        lines(ax, made.signals.time, *group)
    axes[-1].set_xlim(0.0, made.end or 1.0)
    events(axes, made.events)
    return drawn


def frequency_figure(made: Run, smoothed: Sequence[Smoothed]) -> Figure:
    """Draw the frequencies with their bands, and the status. smoothed: models of whole stretches, drawn in grey."""
    drawn, axes = figure([3.2, 0.35])
    _estimates(axes, made, with_payload=False)
    for part in smoothed:
        course = part.course or ((part.start_s, part.modes), (part.end_s, part.modes))
        for k in range(len(part.modes)):
            at = [(time, found[k]) for time, found in course if len(found) > k]
            times, middle = [time for time, _ in at], np.array([mode.frequency_hz for _, mode in at])
            wide = QUANTILE * np.array([mode.frequency_std_hz for _, mode in at])
            axes[0].fill_between(times, middle - wide, middle + wide, color=SMOOTHED_COLOUR, alpha=0.25, linewidth=0.0)
            axes[0].plot(times, middle, color=SMOOTHED_COLOUR, linewidth=1.0, linestyle=LINES[1])
    events(axes, made.events)
    return drawn


def configurations_figure(found: Sweep) -> Figure:
    """Draw the frequencies over the angle between the links with their bands, and the angles in the recording."""
    drawn, (ax,) = figure([3.2], share_time=False)
    angle = np.degrees(found.relative)
    ax.axvspan(*np.degrees(found.seen), color='#F0F0F0', linewidth=0, label='configurations\nof the recording')
    for k in range(found.frequency.shape[1]):
        _band(ax, angle, found.frequency[:, k], found.std[:, k], k)
    inside = (found.seen[0] <= found.relative) & (found.relative <= found.seen[1])
    limit(ax, found.frequency[inside] if inside.any() else found.frequency, found.frequency[np.isfinite(
        found.frequency)].tolist())
    ax.set(xlim=(0.0, 180.0), xticks=range(0, 181, 30), xlabel='angle between the links, to either side [degrees]',
           ylabel='frequency\n[Hz]')
    legend(ax)
    return drawn


def payload_figure(made: Run) -> Figure:
    """Draw the payload with its interval, whole and close up; the consistency of the residuals below."""
    drawn, axes = figure([2.0, 2.4, 1.3])
    payload(axes[0], made.estimates, made.start_ns, _stretches(made)[1])
    payload(axes[1], made.estimates, made.start_ns, _stretches(made)[1], zoom=True)
    found = _with_payload(made.estimates, made.start_ns)
    values = found['consistency']
    axes[2].plot(found['time_s'], values, color=screen.COLOURS[0], linewidth=1.2)
    axes[2].axhline(1.0, color='#555555', linewidth=1.0, linestyle=':')
    finite = values[np.isfinite(values)]
    if finite.size:
        axes[2].set_ylim(0.0, max(2.0, 1.2 * float(np.percentile(finite, 98))))
    axes[2].set_ylabel('residual power\n[-], noise = 1')
    axes[-1].set_xlim(0.0, made.end or 1.0)
    events(axes, made.events)
    return drawn


def validation_figure(scores: Scores, outputs: Sequence[str], *, has_arm: bool) -> Figure:
    """Draw the held-out outputs: measured, simulated by the model, and predicted one step ahead."""
    drawn, axes = figure([1.7] * len(outputs))
    for k, (ax, name) in enumerate(zip(axes, outputs, strict=True)):
        joint, _, field = name.rpartition('/')
        _, unit, scale = _quantity(joint, field, has_arm)
        for values, label, colour, width, line in (
                (scores.measured, 'measured', '#9A9A9A', 2.6, LINES[0]),
                (scores.simulated, 'simulated', screen.COLOURS[1], 1.1, LINES[0]),
                (scores.predicted, 'one step ahead', screen.COLOURS[0], 0.9, LINES[1])):
            rows = screen.thinned(np.column_stack([scores.time, scale * values[:, k]]), POINTS)
            ax.plot(rows[:, 0], rows[:, 1], color=colour, linewidth=width, linestyle=line, label=label)
        spread = scale * scores.measured[:, k]
        room = 0.3 * (float(spread.max() - spread.min()) or 1.0)
        ax.set(ylim=(float(spread.min()) - room, float(spread.max()) + room), ylabel=f'{joint}\n{field}\n[{unit}]')
        ax.set_title(f'VAF {scores.simulation[k]:.2f} % simulated, {scores.prediction[k]:.2f} % predicted',
                     loc='left', fontsize=9)
        if k == 0:
            legend(ax)
    return drawn


def signal_groups(made: Run) -> list[tuple[Array, list[str], str, str]]:
    """Return (columns, labels, title, unit) of the signals that belong in one plot."""
    found: dict[tuple[str, str, float], list[tuple[str, Array]]] = {}
    for names, table in ((made.signals.inputs, made.signals.efforts), (made.signals.outputs, made.signals.y)):
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
