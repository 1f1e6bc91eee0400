"""Run benchmarks, compare what they measured with what they claim, and print the table of claims.

Use: ``python benchmarks/run_all.py [PART_OF_A_NAME ...]``. Each benchmark is a program of its own that prints
a table and writes ``results/<name>.json``. One that fails does not stop the others. Exit code 1: a benchmark failed, or
a claim (``claims.py``) falls short.
"""

from __future__ import annotations

import ast
import datetime
import json
import os
import platform
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import claims

HERE = Path(__file__).resolve().parent
RESULTS = HERE / 'results'


class Outcome(NamedTuple):
    """How one benchmark went."""

    name: str
    claim: str
    passed: bool
    seconds: float


def claim_of(path: Path) -> str:
    """Return the first line of the docstring: the claim that the file measures."""
    words = ast.get_docstring(ast.parse(path.read_text(encoding='utf-8'))) or ''
    return words.split('\n', 1)[0]


def run(path: Path) -> Outcome:
    """Run one benchmark with its output shown as it comes."""
    print(f'\n=== {path.stem}: {claim_of(path)}', flush=True)
    begin = time.perf_counter()
    done = subprocess.run([sys.executable, str(path)], cwd=HERE.parent, stdin=subprocess.DEVNULL, check=False)
    if done.returncode == 0:
        claims.record_run(path.stem, date=datetime.datetime.now(datetime.UTC).date().isoformat(), **machine())
    return Outcome(path.stem, claim_of(path), done.returncode == 0, time.perf_counter() - begin)


def machine() -> dict[str, Any]:
    """Return the kind of machine that measures."""
    return {'cores': os.cpu_count(), 'processor': platform.machine(), 'python': platform.python_version()}


def gather(outcomes: list[Outcome]) -> dict[str, Any]:
    """Return everything measured, with the kind of machine that measured it."""
    results = {}
    for path in sorted(RESULTS.glob('*.json')):
        if path.name not in ('all.json', claims.RUNS):
            results[path.stem] = json.loads(path.read_text(encoding='utf-8'))
    return {
        'machine': machine(),
        'runs': [outcome._asdict() for outcome in outcomes],
        'results': results,
    }


def table(outcomes: list[Outcome]) -> str:
    """Return one row a benchmark as Markdown."""
    rows = ['| benchmark | claim | ran | seconds |', '|---|---|---|---|']
    for name, claim, passed, seconds in outcomes:
        rows.append(f'| {name} | {claim} | {"yes" if passed else "FAILED"} | {seconds:.0f} |')
    return '\n'.join(rows) + '\n'


def claims_table(names: list[str]) -> tuple[str, bool]:
    """Return one row a claim as Markdown, and whether all of them hold; what cannot be compared does not hold."""
    rows, good = ['| benchmark | claim | value | bounds | holds |', '|---|---|---|---|---|'], True
    for name in names:
        try:
            found = claims.recorded(name)
        except (LookupError, ValueError, TypeError) as error:
            found, problem = [], f'{type(error).__name__}: {error}'
        else:
            problem = '' if found else 'nothing is recorded'
        if problem:
            good = False
            rows.append(f'| {name} | cannot be compared: {problem} | | | NO |')
        for claim in found:
            good = good and claim.holds
            rows.append(f'| {name} | {claim.name} | {claim.value:.4g} {claim.unit} | {claim.bounds} | '
                        f'{"yes" if claim.holds else "NO"} |')
    return '\n'.join(rows) + '\n', good


def main() -> int:
    """Run those whose names contain an argument (all without one); exit 1 when one failed or a claim falls short."""
    chosen = [
        path for path in sorted(HERE.glob('*.py'))
        if path.stem not in ('run_all', 'tables') and not path.stem.startswith('_')
        and (len(sys.argv) == 1 or any(part in path.stem for part in sys.argv[1:]))
        and "__name__ == '__main__'" in path.read_text(encoding='utf-8')
    ]
    RESULTS.mkdir(exist_ok=True)
    outcomes = [run(path) for path in chosen]
    (RESULTS / 'all.json').write_text(json.dumps(gather(outcomes), indent=1) + '\n', encoding='utf-8')
    (RESULTS / 'all.md').write_text(table(outcomes), encoding='utf-8')
    claimed, good = claims_table([outcome.name for outcome in outcomes])
    print('\n' + table(outcomes) + '\n' + claimed)
    return 0 if good and outcomes and all(outcome.passed for outcome in outcomes) else 1


if __name__ == '__main__':
    sys.exit(main())
