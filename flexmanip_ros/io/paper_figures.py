"""The figures of the paper's section 4, its method and ours in the same plots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from flexmanip_ros import paper
from flexmanip_ros.io import plots
from flexmanip_ros.paper_response import Response
from flexmanip_ros.plant.simulator import Trajectory
from flexmanip_ros.types import Array, EventKind

Tracks = Mapping[str, Sequence[paper.Track]]
"""Method -> one track a run."""


def colour(method: str) -> str:
    """Return the colour a method has in every figure."""
    return plots.COLOURS[[known.name for known in paper.METHODS].index(method) % len(plots.COLOURS)]


def stack(tracks: Sequence[paper.Track], what: str) -> tuple[Array, Array]:
    """Return time (T,) and one column a run (T, runs) of a quantity."""
    return tracks[0].time, np.column_stack([getattr(track, what) for track in tracks])


def torques(run: Trajectory) -> Figure:
    """Fig. 2."""
    drawn, axes = plots.figure(1, [2.2])
    time = (run.stamp_ns - run.stamp_ns[0]) * 1e-9
    plots.lines(axes[0], time, run.effort, ['joint 1', 'joint 2'], 'torque', 'N m')
    return drawn


def responses(run: Trajectory, capture: float, *, rates: bool = False) -> Figure:
    """Figs. 3, 17 and 18: angles from the working point and bends, or bends and their rates."""
    time = (run.stamp_ns - run.stamp_ns[0]) * 1e-9
    drawn, axes = plots.figure(2, [2.0, 2.0])
    bends, names = 1e3 * run.position[:, 2:], ['link 1', 'link 2']
    if rates:
        plots.lines(axes[0], time, bends, names, 'mid-span\ndisplacement', 'mm')
        plots.lines(axes[1], time, 1e3 * run.velocity[:, 2:], names, 'mid-span\nvelocity', 'mm/s')
    else:
        turned = np.degrees(run.position[:, :2] - run.position[0, :2])
        plots.lines(axes[0], time, turned, ['joint 1', 'joint 2'], 'angle from the\nworking point', 'deg')
        plots.lines(axes[1], time, bends, names, 'bend', 'mm')
    plots.events(axes, [(capture, EventKind.CAPTURE)])
    return drawn


def test_response(true: Response, found: Response | None) -> Figure:
    """Figs. 4, 5, 11 and 12: angles and bends of both models, and the error between them below."""
    drawn, axes = plots.figure(4, [1.8, 1.2, 1.8, 1.2])
    for row, (name, unit, scale) in enumerate((('angles', 'deg', np.degrees(1.0)), ('bends', 'mm', 1e3))):
        top, below = axes[2 * row], axes[2 * row + 1]
        exact = scale * getattr(true, name)
        for k in range(2):
            shade = plots.COLOURS[k]
            top.plot(true.time, exact[:, k], color='#9A9A9A', linewidth=2.4, label='true' if k == 0 else None)
            if found is not None:
                estimate = scale * getattr(found, name)[:, k]
                label = f'identified {name[:-1]} {k + 1}'
                top.plot(true.time, estimate, color=shade, linewidth=1.0, label=label)
                below.plot(true.time, np.abs(estimate - exact[:, k]), color=shade, linewidth=1.0)
        top.set_ylabel(f'{name}\n[{unit}]')
        below.set_ylabel(f'error\n[{unit}]')
        plots.legend(top)
    axes[-1].set_xlabel('time [s]')
    return drawn


def frequency_tracks(tracks: Tracks, before: Sequence[float], after: Sequence[float]) -> Figure:
    """Figs. 6 and 13: median and 5-95 % of the runs for the paper's settings and ours."""
    drawn, axes = plots.figure(2, [2.3, 2.3])
    for ax, method in zip(axes, ('paper', paper.BEST_MODEL), strict=True):
        for k in range(2):
            if tracks.get(method):
                time = tracks[method][0].time
                runs = np.column_stack([track.frequencies[:, k] for track in tracks[method]])
                band(ax, time, runs, plots.COLOURS[k], f'frequency {k + 1}')
            for begin, end, values in ((0.0, paper.CAPTURE_TIME, before), (paper.CAPTURE_TIME, 6.0, after)):
                ax.plot([begin, end], [values[k]] * 2, color=plots.TRUTH_COLOUR, linestyle=(0, (4, 3)),
                        linewidth=1.1, label='true' if k == 0 and begin == 0.0 else None)
        low, high = min(*before, *after), max(*before, *after)
        ax.set_ylim(low - 1.2 * (high - low), high + 1.2 * (high - low))
        ax.set_ylabel(f'{method}\nfrequency [Hz]')
        plots.legend(ax)
    plots.events(axes, [(paper.CAPTURE_TIME, EventKind.CAPTURE)])
    return drawn


def payload_tracks(cases: Sequence[paper.Case], tracks: Mapping[str, Tracks]) -> Figure:
    """Figs. 7, 14 and 19: median and 5-95 % of the runs between 4 and 6 s."""
    drawn, axes = plots.figure(len(cases), [2.2] * len(cases))
    for ax, case in zip(axes, cases, strict=True):
        for method, runs in tracks[case.name].items():
            if runs:
                band(ax, *stack(runs, 'mass'), colour(method), method)
        ax.axhline(case.payload, color=plots.TRUTH_COLOUR, linestyle=(0, (4, 3)), linewidth=1.1, label='true')
        ax.set_xlim(*paper.WINDOW)
        ax.set_ylim(0.0, 2.0 * case.payload)
        ax.set_ylabel('payload\n[kg]')
        ax.set_title(case.title, loc='left', fontsize=10)
        plots.legend(ax)
    return drawn


def error_tracks(cases: Sequence[paper.Case], tracks: Mapping[str, Tracks]) -> Figure:
    """Figs. 8 and 15: median absolute error from the capture on, logarithmic."""
    drawn, axes = plots.figure(len(cases), [2.2] * len(cases))
    for ax, case in zip(axes, cases, strict=True):
        for method, runs in tracks[case.name].items():
            if runs:
                time, masses = stack(runs, 'mass')
                middle = _quantile(np.abs(masses - case.payload), 0.5)
                ax.semilogy(time, middle, color=colour(method), label=method)
        ax.set_xlim(paper.CAPTURE_TIME, paper.WINDOW[1])
        ax.set_ylabel('median error\n[kg]')
        ax.set_title(case.title, loc='left', fontsize=10)
        plots.legend(ax)
    return drawn


def error_bars(cases: Sequence[paper.Case], errors: Mapping[tuple[str, str], float]) -> Figure:
    """Figs. 9 and 16: mean relative error of each method in each case, logarithmic."""
    drawn, axes = plots.figure(1, [2.8], share_time=False)
    width = 0.8 / len(paper.METHODS)
    for index, method in enumerate(paper.METHODS):
        values = [errors.get((case.name, method.name), np.nan) for case in cases]
        places = np.arange(len(cases)) + (index - (len(paper.METHODS) - 1) / 2) * width
        drawn_bars = axes[0].bar(places, values, width, color=colour(method.name), label=method.name)
        said = ['' if np.isnan(value) else f'{value:.3g}' for value in values]
        axes[0].bar_label(drawn_bars, said, fontsize=8)
    axes[0].set_yscale('log')
    axes[0].set_xticks(range(len(cases)), [case.title for case in cases])
    axes[0].set_ylabel('mean relative error,\n4 to 6 s [%]')
    plots.legend(axes[0])
    return drawn


def band(ax: Any, time: Array, runs: Array, shade: str, label: str) -> None:
    """Draw the median over the runs (T, runs) and the stretch that holds 90 % of them."""
    ax.fill_between(time, _quantile(runs, 0.05), _quantile(runs, 0.95), color=shade, alpha=0.2, linewidth=0)
    ax.plot(time, _quantile(runs, 0.5), color=shade, linewidth=1.4, label=label)


def _quantile(runs: Array, share: float) -> Array:
    """Quantile over the runs that have a value; nan where none has."""
    found = np.full(runs.shape[0], np.nan)
    for k, row in enumerate(runs):
        known = row[np.isfinite(row)]
        if known.size:
            found[k] = np.quantile(known, share)
    return found
