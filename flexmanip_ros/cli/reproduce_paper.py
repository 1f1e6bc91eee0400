"""reproduce_paper: every figure and table of the paper's section 4, with the methods of this package beside its own."""

from __future__ import annotations

import argparse
import importlib.util
import sys
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flexmanip_ros.cli import console
from flexmanip_ros.errors import FlexmanipError, ModelError, ParameterError
from flexmanip_ros.paper import experiments

if TYPE_CHECKING:
    from flexmanip_ros.paper.case_run import Track
    from flexmanip_ros.studies.trial import Row

PROG = 'reproduce_paper'
EXAMPLES = """examples:
  reproduce_paper                                30 runs per case, into paper_reproduction/
  reproduce_paper --runs 5 --output quick

Writes report.html (one file with figures and tables), runs.csv (one row per run and method) and summary.csv. The
same seeds give the same numbers.
exit status: 0 on success, 2 on bad arguments, 130 when interrupted.
"""
PAGE, ROWS, SUMMARY = 'report.html', 'runs.csv', 'summary.csv'
SHOWN = {'mean error [%]': '4-6 s, %', 'rms error at 6 s [%]': 'rms 6 s %', 'bound at 6 s [%]': 'bound %',
         '95 % interval holds [%]': 'covered %', 'time per sample [us]': 'us/sample'}
"""Columns of the summary that are printed, and their headings."""


def _parser() -> console.Parser:
    made = console.parser(
        PROG, "Reproduce the results of the paper's section 4, with our estimators beside its own.", EXAMPLES)
    add = made.add_argument
    console.add_runs(made, 30, 'runs per case, of which the paper has 30')
    add('--case', action='append', choices=[case.name for case in experiments.CASES], metavar='NAME',
        help=f'run only this case; may be repeated: {", ".join(case.name for case in experiments.CASES)}')
    add('--first-seed', type=console.whole, default=0, metavar='SEED', help='first seed; default: 0')
    add('--output', default='paper_reproduction', metavar='DIR',
        help='folder to write into; default: paper_reproduction')
    console.add_workers(made)
    return made


def _main(given: argparse.Namespace) -> int:
    from flexmanip_ros.cli import workers
    from flexmanip_ros.io.outputs import check_place, write_rows

    if given.runs < 1:
        raise ParameterError(f'--runs is {given.runs}', 'give at least 1')
    if importlib.util.find_spec('skfem') is None:  # told before the work, which ends with this plant
        raise ModelError('the finite element plant needs scikit-fem, which is not installed',
                         "run 'pip install scikit-fem'")
    from flexmanip_ros.paper import report

    folder = Path(given.output)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as err:
        raise FlexmanipError(f"folder '{folder}' cannot be made: {err.strerror}", 'give another --output') from err
    for name in (PAGE, ROWS, SUMMARY):
        check_place(folder / name)
    started = time.perf_counter()
    cases = [case for case in experiments.CASES if given.case is None or case.name in given.case]
    seeds = range(given.first_seed, given.first_seed + given.runs)
    bounds, rows, tracks = _results(cases, seeds, given.workers)
    planned = list(enumerate(report.planned(tracks, rows)))
    drawn: dict[int, bytes] = {}
    with console.progress('drawing', 'figures') as progress:
        for outcome in workers.compute(report.drawing, planned, given.workers):
            if outcome.error is not None:
                _tell(f'figure {outcome.task[1].numbers} could not be drawn', outcome.error)
            drawn[outcome.task[0]] = outcome.result or b''
            progress(len(drawn), len(planned))
    wall = time.perf_counter() - started
    lines = report.summary(rows, bounds)
    write_rows(folder / ROWS, rows)
    write_rows(folder / SUMMARY, lines)
    lead = f'{given.runs} runs per case, {len(rows)} rows, computed in {wall:.0f} s.'
    report.report(folder / PAGE, rows, lines, [(one, drawn[k]) for k, one in planned], lead)
    print('\n'.join(describe(lines)))
    print(f"{len(cases) * len(seeds)} runs in {wall:.1f} s; wrote '{folder / PAGE}', {ROWS} and {SUMMARY}")
    return console.SUCCESS


def _results(cases: Sequence[experiments.Case], seeds: Sequence[int], processes: int | None
             ) -> tuple[dict[tuple[str, str], float], list[Row], dict[str, dict[str, list[Track]]]]:
    """Compute every run; return bounds by (case, method), rows, and the tracks of each case and method.

    Rows and tracks are in the order of cases and seeds, whatever the order in which the runs end.
    """
    from flexmanip_ros.cli import workers
    from flexmanip_ros.paper import case_run

    tasks: list[tuple[experiments.Case, int | None]] = [(case, None) for case in cases]
    tasks += [(case, seed) for seed in seeds for case in cases]
    found: dict[tuple[experiments.Case, int | None], Any] = {}
    with console.progress('simulating and estimating', 'steps') as progress:
        for count, (task, result, error) in enumerate(workers.compute(case_run.work, tasks, processes), start=1):
            case, seed = task
            if error is None:
                found[task] = result
            elif seed is None:
                found[task] = {}
                _tell(f'the bounds of {case.name} could not be computed', error)
            else:
                found[task] = case_run.failed(case, seed, error)
            progress(count, len(tasks))
    bounds = {(case.name, method): value for case in cases for method, value in found[case, None].items()}
    rows = [row for case in cases for seed in seeds for row in found[case, seed][0]]
    tracks: dict[str, dict[str, list[Track]]] = {
        case.name: {method.name: [] for method in experiments.METHODS} for case in experiments.CASES}
    for case in cases:
        for seed in seeds:
            for method, track in found[case, seed][1].items():
                tracks[case.name][method].append(track)
    return bounds, rows, tracks


def _tell(words: str, error: BaseException) -> None:
    """Say on stderr what is missing from the results, and why."""
    from flexmanip_ros.studies.trial import describe

    console.print_error(PROG, f'{words}: {describe(error)}')


def describe(lines: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the summary as the lines to print."""
    rows = [('case', 'method', *SHOWN.values()),
            *((line['case'], line['method'], *(console.number(line[name]) for name in SHOWN)) for line in lines)]
    return console.aligned(rows, ('40', '12', '>9', '>9', '>9', '>11', '>10'))


main = partial(console.start, _parser, _main)

if __name__ == '__main__':
    sys.exit(main())
