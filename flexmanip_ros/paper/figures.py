"""The figures of the paper's section 4, and the test responses that some of them show.

Every method has one colour and one marker in all figures; links and frequencies differ by the line style.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from scipy.integrate import cumulative_trapezoid

from flexmanip_ros.arm import linearization
from flexmanip_ros.identification import validation
from flexmanip_ros.io import plots
from flexmanip_ros.io.report import plain
from flexmanip_ros.paper import experiments
from flexmanip_ros.paper.case_run import RATE, Track
from flexmanip_ros.parameters import ArmParameters, ExcitationParameters, configure
from flexmanip_ros.simulation import excitation
from flexmanip_ros.simulation.simulator import Trajectory
from flexmanip_ros.types import Array, EventKind, StateSpace
from flexmanip_ros.view import screen

Tracks = Mapping[str, Sequence[Track]]
"""Method -> one track for each run."""
LOOKS: Mapping[str, tuple[str, str]] = {
    'paper': ('#0072B2', 'o'), 'restart': ('#D55E00', 's'), 'known M_b': ('#E69F00', '^'),
    'rigid RLS': ('#CC79A7', 'v'), 'algebraic': ('#7F7F7F', 'D'), 'algebraic, 1 link': ('#56B4E9', 'P'),
    'structured': (screen.PAYLOAD_COLOUR, 'X')}
"""Colour and marker of each method."""
SHARE = 0.95
"""Share of the runs that a band contains."""
TRUE = {'color': plots.TRUTH_COLOUR, 'linestyle': (0, (4, 3)), 'linewidth': 1.1}
CAPTURE = ((experiments.CAPTURE_TIME, EventKind.CAPTURE),)
SINCE_CAPTURE = (experiments.CAPTURE_TIME - 0.1, experiments.WINDOW[1])
CLOSE = ('restart', 'known M_b', 'structured')
"""Methods whose own 95 % interval is drawn."""
LEAST_SHARE = 1e-5
"""Bottom of the logarithmic error axes, as a fraction of the payload."""
DURATION = 3.0
TEST_INPUT = {'shape': 'multisine', 'band': [0.5, 10.0], 'repeat_time': 3.0, 'amplitude': [10.0, 5.0], 'seed': 4}
"""Parameters of the test torque, with which the model was not identified."""


class Response(NamedTuple):
    """time (N,) [s], angles (N, 2) [rad] and bends (N, 2) [m] from rest."""

    time: Array
    angles: Array
    bends: Array


def arm() -> ArmParameters:
    """Return the arm of the paper's cases."""
    return configure(ArmParameters, experiments.ARM)


def true_response(case: experiments.Case) -> Response:
    """Return the response of the linearized arm with its true payload."""
    Ac, Bc = linearization.vibration_model(arm(), np.radians(case.angles_deg), case.payload)
    A, B = linearization.discretize(Ac, Bc, 1.0 / RATE)
    n, r = B.shape
    exact = StateSpace(A, B, np.eye(n), np.zeros((n, r)), np.zeros((n, n)), 1.0 / RATE)
    return _response(case, exact, case.payload)


def identified_response(case: experiments.Case, track: Track) -> Response | None:
    """Return the response of the last identified model; None without one. Its angles need the estimated payload."""
    mass = track.mass[-1] if track.mass.size else np.nan
    if track.model is None or not np.isfinite(mass):
        return None
    return _response(case, track.model, float(mass))


def _response(case: experiments.Case, model: StateSpace, payload: float) -> Response:
    """Bends from the model; angles by integrating theta'' = Ma^-1 (B_theta tau - Mb eta'') (eq. 14) twice."""
    source = configure(ExcitationParameters, {**TEST_INPUT, 'rate': RATE})
    torque = excitation.sequence(source, round(DURATION * RATE))
    outputs = validation.simulate(model, torque)
    parts = linearization.blocks(arm(), np.radians(case.angles_deg), payload)
    bend_acceleration = np.gradient(outputs[:, 2:], 1.0 / RATE, axis=0)
    acceleration = np.linalg.solve(parts.Ma, parts.B_theta @ torque.T - parts.Mb @ bend_acceleration.T).T
    rate = cumulative_trapezoid(acceleration, dx=1.0 / RATE, axis=0, initial=0)
    angles = cumulative_trapezoid(rate, dx=1.0 / RATE, axis=0, initial=0)
    return Response(np.arange(torque.shape[0]) / RATE, angles, outputs[:, :2])


def torques(run: Trajectory) -> Figure:
    """Fig. 2: torques over time."""
    drawn, axes = plots.figure([2.2])
    plots.lines(axes[0], _time(run), run.effort, ['joint 1', 'joint 2'], 'torque', 'N m')
    plots.events(axes, CAPTURE)
    return drawn


def responses(run: Trajectory) -> Figure:
    """Fig. 3: angles from the working point, and bends."""
    drawn, axes = plots.figure([2.0, 2.0])
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
    drawn, axes = plots.figure([1.5] * 4)
    for row, (values, what, unit) in enumerate(zip(
            mid_span(run), ('displacement', 'velocity'), ('mm', 'mm/s'), strict=True)):
        for k, axis in enumerate('XY'):
            plots.lines(axes[2 * row + k], _time(run), 1e3 * values[k], ['link 1', 'link 2'], f'{axis} {what}', unit)
        top = 1.1e3 * float(np.abs(values).max())
        for ax in axes[2 * row:2 * row + 2]:
            ax.set_ylim(-top, top)
    plots.events(axes, CAPTURE)
    return drawn


def arms(cases: Sequence[experiments.Case], arm: ArmParameters) -> Figure:
    """Fig. 10: the configurations, to scale."""
    drawn, columns = plots.figure([2.6], columns=len(cases), share_time=False)
    reach = 1.08 * sum(arm.link_length)
    for ax, case in zip(columns, cases, strict=True):
        theta = np.radians(case.angles_deg)
        x = np.concatenate([[0.0], np.cumsum(arm.link_length * np.cos(theta))])
        y = np.concatenate([[0.0], np.cumsum(arm.link_length * np.sin(theta))])
        ax.plot(x, y, color='#444444', linewidth=3.0, solid_capstyle='round')
        for k, (marker, label) in enumerate((('s', 'joint 1'), ('o', 'joint 2'), ('*', 'payload'))):
            ax.plot(x[k], y[k], marker, markersize=10, color=screen.COLOURS[k], label=label)
        ax.set(xlim=(-0.1 * reach, reach), ylim=(-0.55 * reach, 0.55 * reach), aspect='equal', xlabel='X [m]')
        ax.set_title(f'{case.angles_deg[0]:g}/{case.angles_deg[1]:g} deg', loc='left', fontsize=10)
    columns[0].set_ylabel('Y [m]')
    plots.legend(columns[-1])
    return drawn


def test_response(true: Response, found: Mapping[str, Response]) -> Figure:
    """Figs. 4, 5, 11 and 12: angles and bends of all models, and the errors of the identified ones."""
    drawn, axes = plots.figure([1.9, 1.5, 1.9, 1.5])
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
        # the range of the true response, so that a wrong model does not hide it
        top.set(ylim=(-room, room), ylabel=f'{name}\n[{unit}]')
        below.set(ylim=(1e-6 * room, 10.0 * room), ylabel=f'error of\n{name} [{unit}]')
        plots.legend(top)
    axes[-1].set_xlabel('time since the start of the test [s]')
    return drawn


def frequency_tracks(tracks: Tracks, before: Sequence[float], after: Sequence[float]) -> Figure:
    """Figs. 6 and 13: both frequencies by the paper's settings and by ours; below, their errors."""
    drawn, axes = plots.figure([2.0, 2.0, 2.0])
    for ax, method in zip(axes, ('paper', experiments.BEST_MODEL), strict=False):
        for k in range(2):
            if tracks.get(method):
                time = tracks[method][0].time
                runs = np.column_stack([track.frequencies[:, k] for track in tracks[method]])
                style = {'color': LOOKS[method][0], 'linestyle': plots.LINES[k]}
                band(ax, time, runs, f'frequency {k + 1}', **style)
                true = np.where(time < experiments.CAPTURE_TIME, before[k], after[k])
                off = quantile(100.0 * np.abs(runs / true[:, None] - 1.0), 0.5)
                axes[2].semilogy(time, off, linewidth=1.4, label=f'{method}, frequency {k + 1}', **style)
            for begin, end, values in ((0.0, experiments.CAPTURE_TIME, before),
                                       (experiments.CAPTURE_TIME, experiments.WINDOW[1], after)):
                ax.plot([begin, end], [values[k]] * 2, **TRUE, label='true' if k == 0 and begin == 0.0 else None)
        low, high = min(*before, *after), max(*before, *after)
        ax.set(ylim=(low - 0.7 * (high - low), high + 0.7 * (high - low)), ylabel=f'frequency [Hz],\n{method}')
        plots.legend(ax)
    for limit, words in ((5.0, 'the paper accepts 5 %'), (0.5, 'our target 0.5 %')):
        axes[2].axhline(limit, color='#555555', linewidth=1.0, linestyle=':')
        axes[2].annotate(words, (0.995, limit), xycoords=('axes fraction', 'data'), xytext=(0, 2), ha='right',
                         textcoords='offset points', fontsize=8, color='#555555',
                         bbox={'facecolor': 'white', 'edgecolor': 'none', 'alpha': 0.8, 'pad': 0.5})
    axes[2].set(xlim=(0.0, experiments.WINDOW[1]), ylim=(1e-4, 50.0), ylabel='median error\n[%]')
    plots.legend(axes[2])
    plots.events(axes, CAPTURE)
    return drawn


def band(ax: Any, time: Array, runs: Array, label: str, **style: Any) -> None:
    """Draw the median over the runs (T, runs) and the band that contains ``SHARE`` of them."""
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


def _look(method: str) -> dict[str, Any]:
    """Return how the payload of a method is drawn."""
    colour, marker = LOOKS[method]
    return {'color': colour, 'marker': marker, 'markersize': 4}


def _masses(runs: Sequence[Track]) -> Array:
    """Return the payload of every run (T, runs) [kg]."""
    return np.column_stack([track.mass for track in runs])


def payload_tracks(cases: Sequence[experiments.Case], tracks: Mapping[str, Tracks]) -> Figure:
    """Figs. 7, 14 and 19: median and band of the runs in the paper's window."""
    drawn, axes = plots.figure([2.2] * len(cases))
    for ax, case in zip(axes, cases, strict=True):
        for method, runs in tracks[case.name].items():
            if runs:
                band(ax, runs[0].time, _masses(runs), method, **_look(method))
        ax.axhline(case.payload, **TRUE, label='true')
        ax.set(xlim=experiments.WINDOW, ylim=(-0.05 * case.payload, 2.0 * case.payload), ylabel='payload\n[kg]')
        ax.set_title(f'{case.title}, captured at {experiments.CAPTURE_TIME:g} s', loc='left', fontsize=10)
        plots.legend(ax)
    return drawn


def interval_tracks(cases: Sequence[experiments.Case], tracks: Mapping[str, Tracks]) -> Figure:
    """One run of each case: the payload by the methods in ``CLOSE`` with their 95 % intervals."""
    drawn, axes = plots.figure([2.2] * len(cases))
    for ax, case in zip(axes, cases, strict=True):
        widest = 0.0
        for method in CLOSE:
            for track in tracks[case.name].get(method, ())[:1]:
                late = track.time >= experiments.WINDOW[0]
                ax.fill_between(track.time, track.lower, track.upper, color=LOOKS[method][0], alpha=0.25, linewidth=0,
                                label=f'{method}, 95 % interval')
                ax.plot(track.time, track.mass, label=method, **_look(method))
                ends = np.abs(np.concatenate([track.lower[late], track.upper[late]]) - case.payload)
                known = ends[np.isfinite(ends)]
                widest = max(widest, float(np.median(known)) if known.size else 0.0)
        ax.axhline(case.payload, **TRUE, label='true')
        room = min(1.8 * widest, case.payload) or case.payload
        ax.set(xlim=SINCE_CAPTURE, ylim=(case.payload - room, case.payload + room), ylabel='payload, close up\n[kg]')
        ax.set_title(case.title, loc='right', fontsize=10)  # the event's name is at the left
        plots.legend(ax)
        for track in tracks[case.name].get('structured', ())[:1]:  # its band may be thinner than the line
            if np.isfinite(track.mass[-1]):
                ax.annotate(f'structured at {track.time[-1]:.0f} s: {track.mass[-1]:.3f} kg, 95 %: '
                            f'{track.lower[-1]:.3f} to {track.upper[-1]:.3f} kg', (1.0, 0.04),
                            xycoords='axes fraction', ha='right', fontsize=9, fontweight='bold',
                            color=LOOKS['structured'][0])
    plots.events(axes, CAPTURE)
    return drawn


def error_tracks(cases: Sequence[experiments.Case], tracks: Mapping[str, Tracks]) -> Figure:
    """Figs. 8, 15 and 19: median absolute error and band of the runs since the capture, logarithmic."""
    drawn, axes = plots.figure([2.4] * len(cases))
    for ax, case in zip(axes, cases, strict=True):
        for method, runs in tracks[case.name].items():
            if not runs:
                continue
            since = runs[0].time >= experiments.CAPTURE_TIME
            error = np.maximum(np.abs(_masses(runs) - case.payload), LEAST_SHARE * case.payload)[since]
            if np.isfinite(error).any():
                band(ax, runs[0].time[since], error, method, **_look(method))
        ax.set(yscale='log', xlim=SINCE_CAPTURE, ylim=(LEAST_SHARE * case.payload, 100.0 * case.payload),
               ylabel='absolute error\n[kg]')
        ax.set_title(case.title, loc='right', fontsize=10)  # the event's name is at the left
        plots.legend(ax)
    plots.events(axes, CAPTURE)
    return drawn


def error_points(cases: Sequence[experiments.Case], errors: Mapping[tuple[str, str], Array]) -> Figure:
    """Figs. 9, 16 and 19: mean relative error of each method, and the stretch that holds 95 % of the runs."""
    drawn, columns = plots.figure([3.0], columns=len(cases), share_time=False)
    names = [method.name for method in experiments.METHODS]
    for ax, case in zip(columns, cases, strict=True):
        for place, name in enumerate(names):
            values = errors[case.name, name]
            if values.size == 0:
                continue
            colour, marker = LOOKS[name]
            low, high = np.quantile(values, [0.025, 0.975])
            ax.plot([low, high], [place, place], color=colour, linewidth=4.0, alpha=0.4)
            ax.plot(values.mean(), place, marker, markersize=8, color=colour)
            ax.annotate(f'{plain(values.mean())} %', (values.mean(), place), xytext=(0, 6),
                        textcoords='offset points', ha='center', fontsize=8)
        ax.set(xscale='log', xlim=(1e-3, 1e5), ylim=(len(names) - 0.4, -0.8),
               xlabel='mean relative error,\n4 to 6 s [%]')
        ax.set_yticks(range(len(names)), names if ax is columns[0] else [''] * len(names))
        ax.set_title(case.title.replace(', ', ',\n'), loc='left', fontsize=10)
    return drawn


def _time(run: Trajectory) -> Array:
    return np.asarray((run.stamp_ns - run.stamp_ns[0]) * 1e-9, dtype=np.float64)
