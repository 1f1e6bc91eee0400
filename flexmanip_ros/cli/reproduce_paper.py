"""reproduce_paper: every figure and table of the paper's section 4, and ours beside it."""

from __future__ import annotations

import argparse
import csv
import io
import math
import os
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from flexmanip_ros import paper, study
from flexmanip_ros.cli import console, workers
from flexmanip_ros.errors import ParameterError
from flexmanip_ros.io.table import OutputError, write_file

PROG = 'reproduce_paper'
EXAMPLES = """examples:
  reproduce_paper                                30 runs a case, into paper_reproduction/
  reproduce_paper --runs 5 --output quick

Writes report.html (figures and tables, nothing else needed), runs.csv (one row a run and method) and
summary.csv. The same seeds give the same numbers.
exit status: 0 on success, 2 on bad arguments, 130 when interrupted.
"""
Task = tuple[paper.Case, int]
SHOWN = ('mean error [%]', 'rms error at 6 s [%]', 'bound at 6 s [%]', '95 % interval holds [%]',
         'time per sample [us]')


def _parser() -> console.Parser:
    made = console.parser(
        PROG, "Regenerate the results of the paper's section 4, our estimators beside its own.", EXAMPLES)
    add = made.add_argument
    add('--runs', type=int, default=30, metavar='N', help='runs a case (default 30, as the paper)')
    add('--case', action='append', choices=[case.name for case in paper.CASES], metavar='NAME',
        help=f'only this case, may be repeated: {", ".join(case.name for case in paper.CASES)}')
    add('--first-seed', type=console.whole, default=0, metavar='SEED', help='default: 0')
    add('--output', default='paper_reproduction', metavar='DIR', help='default: paper_reproduction')
    add('--workers', type=int, metavar='N', help='processes; default: one a core; 0: this one only')
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; return its exit status."""
    given = _parser().parse_args(arguments)
    return console.run(PROG, lambda: _main(given))


def work(task: Task) -> tuple[list[study.Row], dict[str, paper.Track]]:
    """Do one run of one case."""
    return paper.run(*task)


def _main(given: argparse.Namespace) -> int:
    if given.runs < 1:
        raise ParameterError(f'--runs is {given.runs}', 'give at least 1')
    console.require_pictures()
    from flexmanip_ros.io import paper_report

    folder = Path(given.output)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as err:
        raise OutputError(f"folder '{folder}' cannot be made: {err.strerror}",
                          'give another --output') from err
    started = time.perf_counter()
    cases = [case for case in paper.CASES if given.case is None or case.name in given.case]
    tasks: list[Task] = [(case, given.first_seed + k) for k in range(given.runs) for case in cases]
    found: dict[Task, tuple[list[study.Row], dict[str, paper.Track]]] = {}
    with console.progress('reproducing', 'runs') as progress:
        for outcome in _compute(given.workers, tasks):
            found[outcome.task] = outcome.result if outcome.error is None else (_failed(outcome), {})
            progress(len(found), len(tasks))
    rows = [row for task in tasks for row in found[task][0]]
    tracks = {case.name: {method.name: [found[task][1][method.name] for task in tasks
                                        if task[0] is case and method.name in found[task][1]]
                          for method in paper.METHODS} for case in paper.CASES}
    wall = time.perf_counter() - started
    lines = paper_report.summary(rows)
    write_csv(folder / 'runs.csv', rows)
    write_csv(folder / 'summary.csv', lines)
    paper_report.report(folder / 'report.html', paper_report.Study(rows, tracks, given.runs, wall))
    print('\n'.join(describe(lines)))
    print(f"{len(tasks)} runs in {wall:.1f} s; wrote '{folder / 'report.html'}', runs.csv and summary.csv")
    return console.SUCCESS


def _compute(count: int | None, tasks: Sequence[Task]) -> Iterator[workers.Outcome]:
    cores = len(os.sched_getaffinity(0)) if count is None else count
    return workers.processes(work, tasks, cores) if cores > 0 else workers.serial(work, tasks)


def _failed(outcome: workers.Outcome) -> list[study.Row]:
    case, seed = outcome.task
    words = study.describe(outcome.error or RuntimeError('unknown'))
    return [{'case': case.name, 'method': method.name, 'seed': seed, 'error': words}
            for method in paper.METHODS]


def describe(lines: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the summary as lines for people."""
    said = [f'{"case":40s} {"method":12s} {"4-6 s, %":>9s} {"rms 6 s %":>9s} {"bound %":>9s} '
            f'{"covered %":>11s} {"us/sample":>10s}']
    for line in lines:
        error, rms, least, held, cost = (_short(line[name]) for name in SHOWN)
        said.append(f'{line["case"]:40s} {line["method"]:12s} {error:>9s} {rms:>9s} {least:>9s} {held:>11s} '
                    f'{cost:>10s}')
    return said


def _short(value: float | None) -> str:
    return '-' if value is None or math.isnan(value) else f'{value:.3g}'


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows as a table; a missing value is an empty cell."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, names, restval='', lineterminator='\n')
    writer.writeheader()
    writer.writerows({name: '' if row[name] is None else row[name] for name in row} for row in rows)
    write_file(path, lambda file: file.write(text.getvalue().encode('utf-8')))


if __name__ == '__main__':
    sys.exit(main())
