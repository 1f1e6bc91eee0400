"""The report of identify_bag: everything about one run on one page."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

from flexmanip_ros.io import pictures
from flexmanip_ros.io.html import Section, matrix, number, page, picture, table, write
from flexmanip_ros.parameters import IdentifierParameters, flatten, leaves
from flexmanip_ros.parameters.document import written
from flexmanip_ros.studies.holdout import Scores
from flexmanip_ros.studies.summary import Summary
from flexmanip_ros.types import StateSpace, Status


def identification_report(
    path: str | Path, source: str, config: IdentifierParameters, summary: Summary, made: pictures.Run,
    model: StateSpace | None, scores: Scores | None, messages: dict[str, int], bound: float | None = None,
    fault: str = '',
) -> None:
    """Write the report of identify_bag."""
    sections = [Section('Result', _result(summary, made.signals.outputs, bound, fault)),
                Section('Signals', picture(
                    pictures.signals_figure(made), 'torques and measured signals over time'))]
    if any(estimate.modes for estimate in made.estimates):
        sections.append(Section('Frequencies', picture(
            pictures.frequency_figure(made), 'identified frequencies with 95 % bands over time')))
    if any(estimate.payload is not None for estimate in made.estimates):
        sections.append(Section('Payload', picture(
            pictures.payload_figure(made), 'payload with its 95 % interval, and residual power over time')))
    if scores is not None:
        note = '' if not scores.until_gap else '<p class="note">Scored up to the first gap.</p>'
        drawn = pictures.validation_figure(scores, made.signals.outputs, has_arm=made.has_arm)
        sections.append(Section(
            'Validation', note + picture(drawn, 'measured, simulated and predicted outputs')))
    if model is not None:
        sections.append(Section('Model', _model(model, made.signals.inputs, made.signals.outputs)))
    counts = [(name.replace('_', ' '), count) for name, count in messages.items()]
    sections += [Section('Parameters', _parameters(config)),
                 Section('Messages', table(['what became of the messages', 'count'], counts))]
    lead = f'{summary.samples} samples, {made.end:.3f} s, identified in {summary.wall_s:.2f} s'
    write(path, page(f'Identification of {source}', lead, sections))


def _result(summary: Summary, outputs: Sequence[str], bound: float | None, fault: str) -> str:
    rows: list[tuple[str, str]] = [('status', f'{summary.status}: {Status[summary.status].value}')]
    if summary.model_status not in (summary.status, Status.TRACKING.name):
        rows.append(('model', f'{summary.model_status}: {Status[summary.model_status].value}'))
    modes = zip(summary.frequencies_hz, summary.damping_ratios, strict=True)
    for k, (frequency, damping) in enumerate(modes):
        rows.append((f'mode {k + 1}', f'{frequency:.4f} Hz, damping ratio {damping:.4f}'))
    if summary.payload_ci95_kg is not None:
        low, high = summary.payload_ci95_kg
        rows.append(('payload', f'{number(summary.payload_mass_kg)} kg, 95 % interval {number(low)} to '
                     f'{number(high)} kg, standard deviation {number(summary.payload_std_kg)} kg'))
        if bound is not None:
            rows.append(('best possible', f'standard deviation {number(bound, 3)} kg (Cramer-Rao bound of '
                         'the samples after the capture, at the noise they show)'))
        rows.append(('residual power', f'{number(summary.consistency)} (1: noise only)'))
    for name, value in (('capture', summary.capture_time_s), ('release', summary.release_time_s)):
        if value is not None:
            rows.append((name, f'{value:.3f} s'))
    rows.append(('sample time', f'{number(summary.sample_time_s)} s, {summary.gaps} gaps'))
    for kind, values in (('simulation', summary.vaf_simulation_percent),
                         ('one-step prediction', summary.vaf_prediction_percent)):
        if values is not None:
            said = [f'{name} {number(value, 4)} %' for name, value in zip(outputs, values, strict=True)]
            rows.append((f'variance accounted for, {kind}', ', '.join(said)))
    warning = f'<p class="changed">{escape(fault)}</p>' if fault else ''
    return warning + table(['', ''], rows)


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
