"""Write docs/how_well.md: what every benchmark claims, and what it measured last; and the shares in README.md.

Use: ``python benchmarks/tables.py`` (``make docs``). The values come from ``benchmarks/results``, the bounds from
``benchmarks/claims.py``.
"""

from __future__ import annotations

import inspect
import math
import re
from pathlib import Path

import claims

ENOUGH = 100
"""Runs from which a share of them is worth a sentence: it is known to 2 %."""
TARGET = Path(__file__).resolve().parents[1] / 'docs' / 'how_well.md'
README = TARGET.parents[1] / 'README.md'
SUBJECTS = {
    'payload': 'The payload', 'identification': 'The identified model', 'detection': 'Captures found in the signals',
    'control': 'The controller', 'plant': 'The simulated arm', 'replay': 'Replay', 'ros': 'The nodes',
    'io': 'Recordings', 'study': 'Studies', 'setup': 'Set-up'}


def page() -> str:
    """Return the page."""
    parts = ['# How well it works\n',
             'Each row is a claim: a value that a benchmark measured, and the bounds it is compared with. `make bench` '
             'measures again and ends with exit code 1 when a claim falls short; `make docs` writes this page. '
             '`benchmarks/claims.py` says where each bound comes from. Values without a date are older than the '
             'records of dates.\n',
             'Coverage is the share of 95 % intervals that hold the true value. `TRACKING and outside` is the share of '
             'all estimates (in missions: of those that are TRACKING) that have the status TRACKING and an interval '
             'that misses the true mass. `error over bound` is the root mean square error over the Cramer-Rao bound.\n']
    for prefix, title in SUBJECTS.items():
        rows = []
        for name, function in claims.CLAIMS.items():
            if name.split('_')[0] == prefix:
                found = claims.recorded(name)
                words = ' '.join((inspect.getdoc(function) or '').split())
                rows.append(f'`{name}`: {words}{when(name)}\n')
                rows.append(table(found) if found else 'Not measured yet.\n')
        if rows:
            parts += [f'## {title}\n', *rows]
    return '\n'.join(parts)


def when(name: str) -> str:
    """Return a sentence with date and machine of a result; empty where they are not recorded."""
    run = claims.run_of(name)
    if run is None:
        return ''
    return f' Measured on {run["date"]}, {run["cores"]} cores ({run["processor"]}), Python {run["python"]}.'


def table(found: list[claims.Claim]) -> str:
    """Return the claims of a benchmark as Markdown."""
    rows = ['| value | measured | claimed | holds |', '|---|---|---|---|']
    rows += [f'| {claim.name} | {claim.value:.4g} {claim.unit}'.rstrip()
             + f' | {claim.bounds} | {"yes" if claim.holds else "no"} |' for claim in found]
    return '\n'.join(rows) + '\n'


def readme(text: str) -> str:
    """Return README.md with the shares measured last. Each stands before words that are looked for here."""
    matched = [share for row in claims.read('payload_coverage') if row['runs'] >= ENOUGH for share in row['coverage']]
    elements = claims.read('payload_elements')[0]
    simulated = claims.read('identification_measured_arms')['daisy_robot_arm']['ours order=4']['simulation'][0]
    second, third = (elements['samples_after_capture'].index(count) for count in (1000, 2990))
    for words, share in (
            ('of the 95 % intervals hold the true mass', _percent(min(matched), max(matched))),
            ('of the masses are less than 1 % off', _percent(1.0 - elements['share_beyond_1_percent'][second])),
            ('of the intervals hold the true mass 3 s after', _percent(elements['coverage'][third])),
            ('of the second half', f'{simulated:.1f}')):
        pattern = words.replace(' ', r'\s+')
        text, count = re.subn(rf'[\d.]+(?: to \d+)?(?=\s%\s{pattern})', share, text)
        if count != 1:
            raise ValueError(f'README.md has to say once how many % {words}')
    return text


def _percent(low: float, high: float | None = None) -> str:
    if high is None:
        return f'{100.0 * low:.0f}'
    return f'{math.floor(100.0 * low)} to {math.ceil(100.0 * high)}'


if __name__ == '__main__':
    TARGET.write_text(page(), encoding='utf-8')
    README.write_text(readme(README.read_text(encoding='utf-8')), encoding='utf-8')
    print(f'wrote {TARGET.name}, and the shares in {README.name}')
