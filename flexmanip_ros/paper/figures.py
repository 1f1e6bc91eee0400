"""The figures of the paper's section 4 that show the arm and its identified model.

Every method has one colour and one marker in all of them; links and frequencies differ by the line.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from flexmanip_ros.io import plots
from flexmanip_ros.paper import experiments
from flexmanip_ros.paper.case_run import Track
from flexmanip_ros.paper.model_response import Response
from flexmanip_ros.parameters import ArmParameters
from flexmanip_ros.simulation.simulator import Trajectory
from flexmanip_ros.types import Array, EventKind

Tracks = Mapping[str, Sequence[Track]]
"""Method -> one track a run."""
LOOKS: Mapping[str, tuple[str, str]] = {
    'paper': ('#0072B2', 'o'), 'restart': ('#D55E00', 's'), 'known M_b': ('#E69F00', '^'),
    'rigid RLS': ('#CC79A7', 'v'), 'algebraic': ('#7F7F7F', 'D'), 'algebraic, 1 link': ('#56B4E9', 'P'),
    'structured': (plots.PAYLOAD_COLOUR, 'X')}
"""Colour and marker of each method."""
SHARE = 0.95
"""Of the runs, inside a band."""
TRUE = {'color': plots.TRUTH_COLOUR, 'linestyle': (0, (4, 3)), 'linewidth': 1.1}
CAPTURE = ((experiments.CAPTURE_TIME, EventKind.CAPTURE),)


def torques(run: Trajectory) -> Figure:
    """Fig. 2."""
    drawn, axes = plots.figure(1, [2.2])
    plots.lines(axes[0], _time(run), run.effort, ['joint 1', 'joint 2'], 'torque', 'N m')
    plots.events(axes, CAPTURE)
    return drawn


def responses(run: Trajectory) -> Figure:
    """Fig. 3: angles from the working point, and bends."""
    drawn, axes = plots.figure(2, [2.0, 2.0])
    turned = np.degrees(run.position[:, :2] - run.position[0, :2])
    plots.lines(axes[0], _time(run), turned, ['joint 1', 'joint 2'], 'angle from the\nworking point', 'deg')
    plots.lines(axes[1], _time(run), 1e3 * run.position[:, 2:], ['link 1', 'link 2'], 'bend', 'mm')
    plots.events(axes, CAPTURE)
    return drawn


def mid_span(run: Trajectory) -> tuple[Array, Array]:
    """Deflection of the links' middles along X and Y: displacements and velocities (2, N, 2) [m, m/s]."""
    theta = run.position[0, :2]
    across = np.stack([-np.sin(theta), np.cos(theta)])  # (X and Y, link)
    return across[:, None] * run.position[:, 2:], across[:, None] * run.velocity[:, 2:]


def finite_element(run: Trajectory) -> Figure:
    """Figs. 17 and 18: displacements and velocities of the links' middles, along X and Y."""
    drawn, axes = plots.figure(4, [1.5] * 4)
    for row, (values, what, unit) in enumerate(zip(
            mid_span(run), ('displacement', 'velocity'), ('mm', 'mm/s'), strict=True)):
        for k, axis in enumerate('XY'):
            plots.lines(axes[2 * row + k], _time(run), 1e3 * values[k], ['link 1', 'link 2'],
                        f'{axis} {what}', unit)
        top = 1.1e3 * float(np.abs(values).max())
        for ax in axes[2 * row:2 * row + 2]:
            ax.set_ylim(-top, top)
    plots.events(axes, CAPTURE)
    return drawn


def arms(cases: Sequence[experiments.Case], arm: ArmParameters) -> Figure:
    """Fig. 10: the configurations, to scale."""
    drawn, columns = plots.row(len(cases), 2.6)
    reach = 1.08 * sum(arm.link_length)
    for ax, case in zip(columns, cases, strict=True):
        theta = np.radians(case.angles_deg)
        x = np.concatenate([[0.0], np.cumsum(arm.link_length * np.cos(theta))])
        y = np.concatenate([[0.0], np.cumsum(arm.link_length * np.sin(theta))])
        ax.plot(x, y, color='#444444', linewidth=3.0, solid_capstyle='round')
        for k, (marker, label) in enumerate((('s', 'joint 1'), ('o', 'joint 2'), ('*', 'payload'))):
            ax.plot(x[k], y[k], marker, markersize=10, color=plots.COLOURS[k], label=label)
        ax.set_xlim(-0.1 * reach, reach)
        ax.set_ylim(-0.55 * reach, 0.55 * reach)
        ax.set_aspect('equal')
        ax.set_title(f'{case.angles_deg[0]:g}/{case.angles_deg[1]:g} deg', loc='left', fontsize=10)
        ax.set_xlabel('X [m]')
    columns[0].set_ylabel('Y [m]')
    plots.legend(columns[-1])
    return drawn


def test_response(true: Response, found: Mapping[str, Response]) -> Figure:
    """Figs. 4, 5, 11 and 12: angles and bends of all models, and how far the identified ones are off."""
    drawn, axes = plots.figure(4, [1.9, 1.5, 1.9, 1.5])
    for row, (name, unit, scale) in enumerate((('angle', 'deg', np.degrees(1.0)), ('bend', 'mm', 1e3))):
        top, below = axes[2 * row], axes[2 * row + 1]
        exact = scale * getattr(true, f'{name}s')
        for k in range(2):
            top.plot(true.time, exact[:, k], color='#BBBBBB', linestyle=plots.LINES[0], linewidth=3.5,
                     label='true' if k == 0 else None)
            for method, response in found.items():
                estimate = scale * getattr(response, f'{name}s')[:, k]
                style = {'color': LOOKS[method][0], 'linestyle': plots.LINES[k], 'linewidth': 1.1,
                         'label': f'{method}, {name} {k + 1}'}
                top.plot(true.time, estimate, **style)
                below.semilogy(true.time[1:], np.abs(estimate - exact[:, k])[1:], **style)
        room = 1.2 * float(np.abs(exact).max())
        top.set_ylim(-room, room)  # of the true one: a model far off must not hide it
        below.set_ylim(1e-6 * room, 10.0 * room)
        top.set_ylabel(f'{name}\n[{unit}]')
        below.set_ylabel(f'error of\n{name} [{unit}]')
        plots.legend(top)
    axes[-1].set_xlabel('time since the start of the test [s]')
    return drawn


def frequency_tracks(tracks: Tracks, before: Sequence[float], after: Sequence[float]) -> Figure:
    """Figs. 6 and 13: both frequencies by the paper's settings and ours; below, how far they are off."""
    drawn, axes = plots.figure(3, [2.0, 2.0, 2.0])
    for ax, method in zip(axes, ('paper', experiments.BEST_MODEL), strict=False):
        for k in range(2):
            if tracks.get(method):
                time, runs = tracks[method][0].time, frequency(tracks[method], k)
                style = {'color': LOOKS[method][0], 'linestyle': plots.LINES[k]}
                band(ax, time, runs, f'frequency {k + 1}', **style)
                true = np.where(time < experiments.CAPTURE_TIME, before[k], after[k])
                off = quantile(100.0 * np.abs(runs / true[:, None] - 1.0), 0.5)
                axes[2].semilogy(time, off, linewidth=1.4, label=f'{method}, frequency {k + 1}', **style)
            for begin, end, values in ((0.0, experiments.CAPTURE_TIME, before),
                                       (experiments.CAPTURE_TIME, experiments.WINDOW[1], after)):
                ax.plot([begin, end], [values[k]] * 2, **TRUE,
                        label='true' if k == 0 and begin == 0.0 else None)
        low, high = min(*before, *after), max(*before, *after)
        ax.set_ylim(low - 0.7 * (high - low), high + 0.7 * (high - low))
        ax.set_ylabel(f'frequency [Hz],\n{method}')
        plots.legend(ax)
    for limit, words in ((5.0, 'the paper accepts 5 %'), (0.5, 'our target 0.5 %')):
        axes[2].axhline(limit, color='#555555', linewidth=1.0, linestyle=':')
        axes[2].annotate(words, (0.995, limit), xycoords=('axes fraction', 'data'), xytext=(0, 2), ha='right',
                         textcoords='offset points', fontsize=8, color='#555555',
                         bbox={'facecolor': 'white', 'edgecolor': 'none', 'alpha': 0.8, 'pad': 0.5})
    axes[2].set_ylim(1e-4, 50.0)
    axes[2].set_ylabel('median error\n[%]')
    plots.legend(axes[2])
    axes[2].set_xlim(0.0, experiments.WINDOW[1])
    plots.events(axes, CAPTURE)
    return drawn


def frequency(tracks: Sequence[Track], k: int) -> Array:
    """Return frequency k of every run (T, runs) [Hz]."""
    return np.column_stack([track.frequencies[:, k] for track in tracks])


def band(ax: Any, time: Array, runs: Array, label: str, **style: Any) -> None:
    """Draw the median over the runs (T, runs) and the stretch that holds most of them."""
    low, high = quantile(runs, (1.0 - SHARE) / 2.0), quantile(runs, (1.0 + SHARE) / 2.0)
    ax.fill_between(time, low, high, color=style['color'], alpha=0.2, linewidth=0)
    ax.plot(time, quantile(runs, 0.5), linewidth=1.4, label=label, **style)


def quantile(runs: Array, share: float) -> Array:
    """Quantile over the runs that have a value; nan where none has."""
    found = np.full(runs.shape[0], np.nan)
    for k, row in enumerate(runs):
        known = row[np.isfinite(row)]
        if known.size:
            found[k] = np.quantile(known, share)
    return found


def _time(run: Trajectory) -> Array:
    return np.asarray((run.stamp_ns - run.stamp_ns[0]) * 1e-9, dtype=np.float64)
