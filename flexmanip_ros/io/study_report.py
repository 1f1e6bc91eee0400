"""The page of a study: how good each estimator was, and every run of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from flexmanip_ros.io import plots
from flexmanip_ros.io.html import Section, page, picture, table, write
from flexmanip_ros.studies.metrics import Score, score
from flexmanip_ros.studies.trial import Row

SHOWN_FAILURES = 50


def report(path: str | Path, name: str, rows: Sequence[Row]) -> None:
    """Write the page."""
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
    write(path, page(f'Study: {name}', f'{len(rows)} rows', sections))


def errors(rows: Sequence[Row]) -> Figure | None:
    """Draw the error of each run over its payload [%]; None when no run has both."""
    needed = ('payload_true_kg', 'payload_mass_kg', 'payload_lower_kg', 'payload_upper_kg')
    good = [row for row in rows if not row.get('error') and all(_finite(row.get(name)) for name in needed)
            and row['payload_true_kg'] > 0.0]
    if not good:
        return None
    values = np.array([[row[name] for name in needed] for row in good], dtype=np.float64)
    true, mass, low, high = values.T
    relative = [100.0 * (part - true) / true for part in (mass, low, high)]
    held = np.array([bool(row['covered']) for row in good])
    drawn, axes = plots.figure(1, [3.4], share_time=False)
    for chosen, colour, mark, label in ((held, plots.PAYLOAD_COLOUR, 'o', 'truth inside\nthe 95 % interval'),
                                        (~held, plots.EVENT_COLOUR, 'x', 'truth outside')):
        if chosen.any():
            axes[0].vlines(true[chosen], relative[1][chosen], relative[2][chosen], color=colour, alpha=0.5)
            axes[0].plot(true[chosen], relative[0][chosen], mark, markersize=4, color=colour, label=label)
    axes[0].axhline(0.0, color=plots.TRUTH_COLOUR, linewidth=1.0)
    spread = float(np.percentile(np.abs(relative[0]), 95))
    # intervals that are much wider than the errors must not hide them
    room = 1.5 * (spread + min(float(np.median(relative[2] - relative[1])), 3.0 * spread))
    axes[0].set_ylim(-room or -1.0, room or 1.0)
    axes[0].set_xlabel('true payload [kg]')
    axes[0].set_ylabel('error [%]')
    plots.legend(axes[0])
    return drawn


def _finite(value: Any) -> bool:
    return isinstance(value, (int, float)) and bool(np.isfinite(value))
