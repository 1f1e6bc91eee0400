"""Two reports as HTML pages in one file: of one run of identify_bag, and of a study of monte_carlo."""

import base64
import io
from collections.abc import Iterable, Sequence
from dataclasses import fields
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from flexmanip_ros.io import plots
from flexmanip_ros.io.outputs import write_text
from flexmanip_ros.parameters import IdentifierParameters, flatten
from flexmanip_ros.parameters.document import written
from flexmanip_ros.parameters.field import leaves
from flexmanip_ros.studies.results import Score, Summary, result_rows, score, status_text
from flexmanip_ros.studies.trial import Row
from flexmanip_ros.studies.whole_recording import Scores, Smoothed, Sweep
from flexmanip_ros.types import QUANTILE, Array, Estimate, Mode, StateSpace, Status
from flexmanip_ros.view import screen

STYLE = """
body{font:16px/1.5 system-ui,sans-serif;color:#1a1a1a;max-width:1100px;margin:2rem auto;padding:0 1rem}
h1{font-size:1.6rem;margin-bottom:.2rem}h2{font-size:1.2rem;margin-top:2.2rem;border-bottom:1px solid #ddd}
img{width:100%;height:auto}iframe{width:100%;height:760px;border:1px solid #ddd}
table{border-collapse:collapse;margin:.6rem 0;font-size:.9rem}
th,td{padding:.2rem .7rem;text-align:left;border-bottom:1px solid #e6e6e6;vertical-align:top}
td.n{text-align:right;font-variant-numeric:tabular-nums;white-space:nowrap}
nav a{margin-right:1rem}.note{color:#555}.changed{background:#fff3d6}div.wide{overflow-x:auto}
.answer{font-size:1.25rem;font-weight:600}
caption{text-align:left;font-weight:600;padding:.3rem 0}
"""


class Section(NamedTuple):
    """A heading and the HTML below it."""

    title: str
    body: str


def page(title: str, lead: str, sections: Sequence[Section]) -> str:
    """Return a whole page with a contents list. ``title`` and ``lead`` are plain text."""
    links = ''.join(f'<a href="#s{k}">{escape(section.title)}</a>' for k, section in enumerate(sections))
    parts = ''.join(f'<h2 id="s{k}">{escape(section.title)}</h2>{section.body}' for k, section in enumerate(sections))
    return (f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
            f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style></head><body>'
            f'<h1>{escape(title)}</h1><p class="note">{escape(lead)}</p><nav>{links}</nav>{parts}'
            '</body></html>\n')


def picture(drawn: Figure, words: str) -> str:
    """Return a figure as an inline image."""
    return image(png(drawn), words)


def png(drawn: Figure) -> bytes:
    """Return a figure as PNG."""
    buffer = io.BytesIO()
    drawn.savefig(buffer, format='png')
    return buffer.getvalue()


def image(data: bytes, words: str) -> str:
    """Return a PNG as an inline image. words: its description for readers who cannot see it."""
    text = base64.b64encode(data).decode('ascii')
    return f'<img alt="{escape(words)}" src="data:image/png;base64,{text}">'


def frame(page: str, words: str) -> str:
    """Return a whole page inside another, with scripts and styles of its own. words: its description."""
    return f'<iframe title="{escape(words)}" srcdoc="{escape(page)}"></iframe>'


def table(header: Sequence[str], rows: Iterable[Sequence[Any]], caption: str = '', digits: int = 5) -> str:
    """Return a table. Numbers are rounded to ``digits`` significant ones and right-aligned, texts are escaped."""
    head = ''.join(f'<th>{escape(name)}</th>' for name in header)
    body = ''.join('<tr>' + ''.join(_cell(value, digits) for value in row) + '</tr>' for row in rows)
    top = f'<caption>{escape(caption)}</caption>' if caption else ''
    return f'<div class="wide"><table>{top}<tr>{head}</tr>{body}</table></div>'


def number(value: Any, digits: int = 5) -> str:
    """Return a number as text for people; None and nan give a dash."""
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return '\N{EN DASH}'
    return str(value) if isinstance(value, (int, str)) else f'{float(value):.{digits}g}'


def plain(value: float | None) -> str:
    """Return a number as text with two digits and without an exponent; None and nan give a dash."""
    if value is None or np.isnan(value):
        return '\N{EN DASH}'
    return np.format_float_positional(value, precision=2, fractional=False, trim='-')


def _cell(value: Any, digits: int) -> str:
    if value is None or isinstance(value, (int, float, np.number)):
        return f'<td class="n">{number(value, digits)}</td>'
    return f'<td>{escape(str(value))}</td>'


def matrix(name: str, values: Array, rows: Sequence[str] = (), columns: Sequence[str] = ()) -> str:
    """Return a matrix as a table. rows, columns: names of its rows and columns, x1, x2, ... where there are none."""
    header = ['', *(columns or [f'x{k + 1}' for k in range(values.shape[1])])]
    labels = rows or [f'x{k + 1}' for k in range(values.shape[0])]
    return table(header, [[label, *row] for label, row in zip(labels, values.tolist(), strict=True)], name)


SHOWN_FAILURES = 50
"""Largest number of failed runs that are listed."""


def identification_report(
    path: str | Path, source: str, config: IdentifierParameters, summary: Summary, made: plots.Run,
    last: Estimate | None, scores: Scores | None, messages: dict[str, int], *, bound: float | None, fault: str,
    events: str, player: str, configurations: Sweep | None,
) -> None:
    """Write the report of identify_bag: the answer, then pictures, then tables.

    last: the last estimate; messages: what became of them, and how many; bound: Cramer-Rao bound of the payload [kg].
    events: text on the events that were detected in the signals; empty where the events are known. player: the page
    that plays the recording; configurations: the modes at other angles, where the model gives them.
    """
    modes, model = (last.modes, last.model) if last is not None else ((), None)
    sections = [Section('Result', _answer(config, summary, modes, events, fault)),
                Section('Replay', frame(player, 'the arm, its signals, modes and payload over time'))]
    if any(estimate.payload is not None for estimate in made.estimates):
        sections.append(Section('Payload', picture(
            plots.payload_figure(made), 'payload with its 95 % interval, and residual power over time')))
    if any(estimate.modes for estimate in made.estimates):
        sections.append(Section('Frequencies', picture(
            plots.frequency_figure(made, summary.smoothed or ()), 'identified frequencies with 95 % bands over time')
            + _smoothed(summary.smoothed or ())))
    if configurations is not None:
        sections.append(Section('Configurations', picture(
            plots.configurations_figure(configurations), 'frequencies over the angle between the links')))
    sections.append(Section('Signals', picture(plots.signals_figure(made), 'torques and measured signals over time')))
    if scores is not None:
        note = '' if not scores.until_gap else '<p class="note">Scored up to the first gap.</p>'
        drawn = plots.validation_figure(scores, made.signals.outputs, has_arm=made.has_arm)
        sections.append(Section('Validation', note + picture(drawn, 'measured, simulated and predicted outputs')))
    sections.append(Section('Numbers', _result(config, summary, modes, bound)))
    if model is not None:
        sections.append(Section('Model', _model(model, made.signals.inputs, made.signals.outputs)))
    counts = [(name.replace('_', ' '), count) for name, count in messages.items()]
    sections += [Section('Parameters', _parameters(config)),
                 Section('Messages', table(['what became of the messages', 'count'], counts))]
    lead = f'{summary.samples} samples, {made.end:.3f} s, identified in {summary.wall_s:.2f} s'
    write_text(path, page(f'Identification of {source}', lead, sections))


def _answer(config: IdentifierParameters, summary: Summary, modes: Sequence[Mode], events: str, fault: str) -> str:
    """Return the answer as HTML: the payload, since when it is held, its interval and status, and the modes."""
    status = Status[summary.status]
    parts = [f'<p class="changed">{escape(fault)}</p>'] if fault else []
    if summary.payload_ci95_kg is not None:
        since = summary.held_since_s
        held = '' if since is None else f', since {since:.3f} s' if since >= 0.0 else ', since before the first sample'
        if summary.release_time_s is not None and since is None:
            held = f', since the release at {summary.release_time_s:.3f} s'
        parts.append(f'<p class="answer">Payload: {escape(summary.payload_text(config))}{held}.</p>')
    if events:
        parts.append(f'<p>Captures and releases: {escape(events)}.</p>')
    look = '' if status is Status.TRACKING else ' class="changed"'
    parts.append(f'<p{look}>Status: {escape(status_text(status, config, summary.status_reason))}.</p>')
    if summary.model_status not in (summary.status, Status.TRACKING.name):
        model = status_text(Status[summary.model_status], known=summary.reason, of_model=True)
        parts.append(f'<p class="changed">Model: {escape(model)}.</p>')
    found = [mode for mode in modes if np.isfinite(mode.frequency_hz)]
    if found:
        shown = [f'{mode.frequency_hz:.4g}'
                 + (f' &plusmn; {QUANTILE * mode.frequency_std_hz:.2g}' if mode.frequency_std_hz > 0.0 else '')
                 + f' Hz (damping ratio {mode.damping_ratio:.3g})' for mode in found]
        parts.append(f'<p>Modes (95 %): {", ".join(shown)}.</p>')
    return ''.join(parts)


def _result(config: IdentifierParameters, summary: Summary, modes: Sequence[Mode], bound: float | None) -> str:
    rows = result_rows(summary, config, modes)
    if summary.payload_ci95_kg is not None and summary.payload_std_kg is not None:
        rows.append(('standard deviation', f'{number(summary.payload_std_kg)} kg'))
    if bound is not None:
        rows.append(('Cramer-Rao bound', f'standard deviation {number(bound, 3)} kg from the samples after the '
                     'capture alone; what the empty arm taught lowers it'))
    return table(['', ''], rows)


def _smoothed(parts: Sequence[Smoothed]) -> str:
    """Return a table of the models of whole stretches, which are the grey bands; empty without any."""
    rows = [(f'{part.start_s:.3f} to {part.end_s:.3f} s', part.method, f'{mode.frequency_hz:.4f} Hz',
             f'{QUANTILE * mode.frequency_std_hz:.2g} Hz', f'{mode.damping_ratio:.4f}')
            for part in parts for mode in part.modes]
    note = '<p class="note">Grey: the model of each stretch from all of its samples.</p>'
    return note + table(['stretch', 'method', 'frequency', '95 % +-', 'damping ratio'], rows) if rows else ''


def _model(model: StateSpace, inputs: Sequence[str], outputs: Sequence[str]) -> str:
    innovations = [f'e: {name}' for name in outputs]
    return ('<p class="note">x(k+1) = A x + B u + K e, y = C x + D u + e, one step of '
            f'{number(model.dt)} s, signals in JointState units.</p>'
            + matrix('A', model.A) + matrix('B', model.B, columns=inputs)
            + matrix('C', model.C, rows=outputs) + matrix('D', model.D, rows=outputs, columns=inputs)
            + matrix('K', model.K, columns=innovations))


def _parameters(config: IdentifierParameters) -> str:
    values = flatten(config)
    rows = []
    for leaf in leaves(type(config)):
        changed = ' class="changed"' if values[leaf.name] != leaf.default else ''
        cells = (leaf.name, written(leaf, values[leaf.name]), leaf.unit, leaf.words)
        rows.append(f'<tr{changed}>' + ''.join(f'<td>{escape(cell)}</td>' for cell in cells) + '</tr>')
    return ('<p class="note">Marked: different from the default.</p><div class="wide"><table>'
            '<tr><th>parameter</th><th>value</th><th>unit</th><th>meaning</th></tr>'
            + ''.join(rows) + '</table></div>')


def study_report(path: str | Path, name: str, rows: Sequence[Row]) -> None:
    """Write the report of monte_carlo: how good each estimator was, and every run of it."""
    names = sorted({str(row.get('estimator', '')) for row in rows})
    groups = {item: [row for row in rows if str(row.get('estimator', '')) == item] for item in names}
    header = ['estimator', *(item.name.replace('_', ' ') for item in fields(Score))]
    scores = [[item, *vars(score(group)).values()] for item, group in groups.items()]
    sections = [Section('Scores', table(header, scores))]
    for item, group in groups.items():
        drawn = errors(group)
        if drawn is not None:
            note = '<p class="note">Error of the last estimate of each run with its 95 % interval.</p>'
            shown = picture(drawn, f'payload errors of {item}')
            sections.append(Section(f'Payload: {item}', note + shown))
    statuses = sorted({str(row.get('status') or 'failed') for row in rows})
    sections.append(Section('Status at the end', table(['estimator', *statuses], [
        [item, *(sum(str(row.get('status') or 'failed') == status for row in group) for status in statuses)]
        for item, group in groups.items()])))
    failed = [row for row in rows if row.get('error')]
    if failed:
        columns = ('run', 'estimator', 'error')
        shown = table(columns, [[str(row.get(k, '')) for k in columns] for row in failed[:SHOWN_FAILURES]])
        sections.append(Section(f'Failed: {len(failed)}', shown))
    write_text(path, page(f'Study: {name}', f'{len(rows)} rows', sections))


def errors(rows: Sequence[Row]) -> Figure | None:
    """Draw the relative error of each run [%] over its true payload [kg]; None when no run has both."""
    needed = ('payload_true_kg', 'payload_mass_kg', 'payload_lower_kg', 'payload_upper_kg')
    good = [row for row in rows if not row.get('error') and all(_finite(row.get(name)) for name in needed)
            and row['payload_true_kg'] > 0.0]
    if not good:
        return None
    values = np.array([[row[name] for name in needed] for row in good], dtype=np.float64)
    true, mass, low, high = values.T
    relative = [100.0 * (part - true) / true for part in (mass, low, high)]
    covered = np.array([bool(row['covered']) for row in good])
    drawn, axes = plots.figure([3.4], share_time=False)
    for chosen, colour, mark, label in ((covered, screen.PAYLOAD_COLOUR, 'o', 'truth inside\nthe 95 % interval'),
                                        (~covered, screen.EVENT_COLOUR, 'x', 'truth outside')):
        if chosen.any():
            axes[0].vlines(true[chosen], relative[1][chosen], relative[2][chosen], color=colour, alpha=0.5)
            axes[0].plot(true[chosen], relative[0][chosen], mark, markersize=4, color=colour, label=label)
    axes[0].axhline(0.0, color=plots.TRUTH_COLOUR, linewidth=1.0)
    spread = float(np.percentile(np.abs(relative[0]), 95))
    # the errors stay visible where the intervals are much wider
    room = 1.5 * (spread + min(float(np.median(relative[2] - relative[1])), 3.0 * spread))
    axes[0].set(ylim=(-room or -1.0, room or 1.0), xlabel='true payload [kg]', ylabel='error [%]')
    plots.legend(axes[0])
    return drawn


def _finite(value: Any) -> bool:
    return isinstance(value, (int, float)) and bool(np.isfinite(value))
