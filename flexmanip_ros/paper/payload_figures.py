"""The figures of the paper's section 4 that show the payload, every method in the same plot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from flexmanip_ros.io import plots
from flexmanip_ros.io.html import plain
from flexmanip_ros.paper import experiments
from flexmanip_ros.paper.case_run import Track
from flexmanip_ros.paper.figures import CAPTURE, LOOKS, TRUE, Tracks, band, quantile
from flexmanip_ros.types import Array

CLOSE = ('restart', 'known M_b', 'structured')
"""Methods whose own interval is looked at."""
LEAST_KG = 1e-5
"""Bottom of the logarithmic axes over the payload."""


def payload_tracks(cases: Sequence[experiments.Case], tracks: Mapping[str, Tracks]) -> Figure:
    """Figs. 7, 14 and 19: median and band of the runs in the paper's window."""
    drawn, axes = plots.figure(len(cases), [2.2] * len(cases))
    for ax, case in zip(axes, cases, strict=True):
        for method, runs in tracks[case.name].items():
            if runs:
                colour, marker = LOOKS[method]
                band(ax, runs[0].time, stack(runs, 'mass'), method, color=colour, marker=marker, markersize=4)
        ax.axhline(case.payload, **TRUE, label='true')
        ax.set_xlim(*experiments.WINDOW)
        ax.set_ylim(-0.05 * case.payload, 2.0 * case.payload)
        ax.set_ylabel('payload\n[kg]')
        ax.set_title(f'{case.title}, captured at {experiments.CAPTURE_TIME:g} s', loc='left', fontsize=10)
        plots.legend(ax)
    return drawn


def interval_tracks(cases: Sequence[experiments.Case], tracks: Mapping[str, Tracks]) -> Figure:
    """One run of each case: what two of ours say, with the 95 % interval they claim."""
    drawn, axes = plots.figure(len(cases), [2.2] * len(cases))
    for ax, case in zip(axes, cases, strict=True):
        widest = 0.0
        for method in CLOSE:
            for track in tracks[case.name].get(method, ())[:1]:
                late = track.time >= experiments.WINDOW[0]
                colour, marker = LOOKS[method]
                ax.fill_between(track.time, track.lower, track.upper, color=colour, alpha=0.25, linewidth=0,
                                label=f'{method}, 95 % interval')
                ax.plot(track.time, track.mass, color=colour, marker=marker, markersize=4, label=method)
                ends = np.abs(np.concatenate([track.lower[late], track.upper[late]]) - case.payload)
                known = ends[np.isfinite(ends)]
                widest = max(widest, float(np.median(known)) if known.size else 0.0)
        ax.axhline(case.payload, **TRUE, label='true')
        room = min(1.8 * widest, case.payload) or case.payload
        ax.set_xlim(experiments.CAPTURE_TIME - 0.1, experiments.WINDOW[1])
        ax.set_ylim(case.payload - room, case.payload + room)
        ax.set_ylabel('payload, close up\n[kg]')
        ax.set_title(case.title, loc='right', fontsize=10)  # the event is named at the left
        plots.legend(ax)
        _say_last(ax, tracks[case.name].get('structured', ()))
    plots.events(axes, CAPTURE)
    return drawn


def error_tracks(cases: Sequence[experiments.Case], tracks: Mapping[str, Tracks]) -> Figure:
    """Figs. 8, 15 and 19: median absolute error and band of the runs since the capture, logarithmic."""
    drawn, axes = plots.figure(len(cases), [2.4] * len(cases))
    for ax, case in zip(axes, cases, strict=True):
        for method, runs in tracks[case.name].items():
            if not runs:
                continue
            since = runs[0].time >= experiments.CAPTURE_TIME
            error = np.maximum(np.abs(stack(runs, 'mass') - case.payload), LEAST_KG * case.payload)[since]
            if np.isfinite(error).any():
                colour, marker = LOOKS[method]
                band(ax, runs[0].time[since], error, method, color=colour, marker=marker, markersize=4)
        ax.set_yscale('log')
        ax.set_xlim(experiments.CAPTURE_TIME - 0.1, experiments.WINDOW[1])
        ax.set_ylim(LEAST_KG * case.payload, 100.0 * case.payload)
        ax.set_ylabel('absolute error\n[kg]')
        ax.set_title(case.title, loc='right', fontsize=10)  # the event is named at the left
        plots.legend(ax)
    plots.events(axes, CAPTURE)
    return drawn


def error_points(
    cases: Sequence[experiments.Case], errors: Mapping[tuple[str, str], Sequence[float]],
) -> Figure:
    """Figs. 9, 16 and 19: mean relative error of each method, and the stretch that holds 95 % of the runs."""
    drawn, columns = plots.row(len(cases), 3.0)
    names = [method.name for method in experiments.METHODS]
    for ax, case in zip(columns, cases, strict=True):
        for place, name in enumerate(names):
            values = np.array(errors.get((case.name, name), ()), dtype=np.float64)
            if values.size == 0:
                continue
            colour, marker = LOOKS[name]
            low, high = np.quantile(values, [0.025, 0.975])
            ax.plot([low, high], [place, place], color=colour, linewidth=4.0, alpha=0.4)
            ax.plot(values.mean(), place, marker, markersize=8, color=colour)
            ax.annotate(f'{plain(values.mean())} %', (values.mean(), place), xytext=(0, 6),
                        textcoords='offset points', ha='center', fontsize=8)
        ax.set_xscale('log')
        ax.set_xlim(1e-3, 1e5)
        ax.set_ylim(len(names) - 0.4, -0.8)
        ax.set_yticks(range(len(names)), names if ax is columns[0] else [''] * len(names))
        ax.set_xlabel('mean relative error,\n4 to 6 s [%]')
        ax.set_title(case.title.replace(', ', ',\n'), loc='left', fontsize=10)
    return drawn


def stack(tracks: Sequence[Track], what: str) -> Array:
    """Return one column a run (T, runs) of a quantity."""
    return np.column_stack([getattr(track, what) for track in tracks])


def median_error(tracks: Sequence[Track], payload: float) -> Array:
    """Return the median over the runs of the absolute error (T,) [kg]."""
    return quantile(np.abs(stack(tracks, 'mass') - payload), 0.5)


def _say_last(ax: object, tracks: Sequence[Track]) -> None:
    """Write the last estimate of the first run, whose band may be thinner than the line."""
    if tracks and np.isfinite(tracks[0].mass[-1]):
        track = tracks[0]
        words = (f'structured at {track.time[-1]:.0f} s: {track.mass[-1]:.3f} kg, 95 %: '
                 f'{track.lower[-1]:.3f} to {track.upper[-1]:.3f} kg')
        ax.annotate(words, (1.0, 0.04), xycoords='axes fraction', ha='right',  # type: ignore[attr-defined]
                    fontsize=9, fontweight='bold', color=LOOKS['structured'][0])
