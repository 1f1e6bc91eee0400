"""reproduce_paper: every figure and table of the paper's section 4, with the methods of this package beside its own."""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from flexmanip_ros.cli import console
from flexmanip_ros.errors import ParameterError
from flexmanip_ros.paper import experiments

if TYPE_CHECKING:
    from flexmanip_ros.cli import workers
    from flexmanip_ros.paper.case_run import Track
    from flexmanip_ros.paper.report import Planned
    from flexmanip_ros.studies.trial import Row

PROG = 'reproduce_paper'
EXAMPLES = """examples:
  reproduce_paper                                30 runs a case, into paper_reproduction/
  reproduce_paper --runs 5 --output quick

Writes report.html (one file with figures and tables), runs.csv (one row per run and method) and summary.csv. The
same seeds give the same numbers.
exit status: 0 on success, 2 on bad arguments, 130 when interrupted.
"""
PAGE, ROWS, SUMMARY = 'report.html', 'runs.csv', 'summary.csv'
GROUPS: Mapping[str, tuple[experiments.Case, ...]] = {
    'payloads': experiments.PAYLOADS, 'configurations': experiments.CONFIGURATIONS,
    'finite_element': (experiments.FINITE_ELEMENT,)}
"""Cases whose figures belong together; they are drawn as soon as the last run of the group is done."""
SHOWN = ('mean error [%]', 'rms error at 6 s [%]', 'bound at 6 s [%]', '95 % interval holds [%]',
         'time per sample [us]')


def _parser() -> console.Parser:
    made = console.parser(
        PROG, "Reproduce the results of the paper's section 4, with our estimators beside its own.", EXAMPLES)
    add = made.add_argument
    add('--runs', type=int, default=30, metavar='N', help='runs a case (default 30, as the paper)')
    add('--case', action='append', choices=[case.name for case in experiments.CASES], metavar='NAME',
        help=f'only this case, may be repeated: {", ".join(case.name for case in experiments.CASES)}')
    add('--first-seed', type=console.whole, default=0, metavar='SEED', help='default: 0')
    add('--output', default='paper_reproduction', metavar='DIR', help='default: paper_reproduction')
    add('--workers', type=int, metavar='N', help='processes; default: one a core; 0: this one only')
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; return its exit status."""
    given = _parser().parse_args(arguments)
    return console.run(PROG, lambda: _main(given))


class Job(NamedTuple):
    """A task of a worker: a run, the bounds of a case, or a figure."""

    kind: str
    key: tuple[Any, ...]
    call: Callable[[], Any]


def work(job: Job) -> Any:
    """Do a job and return its result."""
    return job.call()


class Collected:
    """The results so far, and the jobs that they make possible."""

    def __init__(self, cases: Sequence[experiments.Case], seeds: Sequence[int]) -> None:
        self.groups = {name: [case for case in group if case in cases] for name, group in GROUPS.items()}
        self.seeds = seeds
        self.runs: dict[tuple[str, int], tuple[list[Row], dict[str, Track]]] = {}
        self.bounds: dict[tuple[str, str], float] = {}
        self.planned: dict[str, Sequence[Planned]] = {}
        self.drawn: dict[tuple[str, int], bytes] = {}

    def first(self) -> list[Job]:
        """Return the jobs that need no result; the runs of one group after the other."""
        from flexmanip_ros.paper import case_run, report

        cases = [case for group in self.groups.values() for case in group]
        bounds = [Job('bounds', (case.name,), partial(case_run.bounds, case)) for case in cases]
        runs = [Job('run', (case, seed), partial(case_run.run, case, seed))
                for group in self.groups.values() for seed in self.seeds for case in group]
        return [*bounds, *self._drawings('signals', report.without_results()), *runs]

    def take(self, outcome: workers.Outcome) -> list[Job]:
        """Keep an outcome; return the jobs that it makes possible."""
        job, found = outcome.task, outcome.result
        if job.kind == 'bounds':
            self.bounds |= {(*job.key, method): value for method, value in (found or {}).items()}
        elif job.kind == 'figure':
            self.drawn[job.key] = found or b''
        else:
            case, seed = job.key
            self.runs[case.name, seed] = (found if outcome.error is None else (_failed(case, seed, outcome.error), {}))
            group = next(name for name, cases in self.groups.items() if case in cases)
            if all((known.name, seed) in self.runs for known in self.groups[group] for seed in self.seeds):
                return self._figures(group)
        return []

    def rows(self) -> list[Row]:
        """Return the rows so far, in the order of cases and seeds."""
        return [row for group in self.groups.values() for case in group for seed in self.seeds
                for row in self.runs.get((case.name, seed), ([], {}))[0]]

    def pictures(self) -> dict[str, list[tuple[Planned, bytes]]]:
        """Return the planned figures with their PNG images."""
        return {group: [(one, self.drawn.get((group, k), b'')) for k, one in enumerate(planned)]
                for group, planned in self.planned.items()}

    def _figures(self, group: str) -> list[Job]:
        from flexmanip_ros.paper import report

        plan = {'payloads': report.payload_example,
                'configurations': report.configuration_example,
                'finite_element': report.finite_element_example}[group]
        return self._drawings(group, plan(self._tracks(), self.rows()))

    def _tracks(self) -> dict[str, dict[str, list[Track]]]:
        return {case.name: {
            method.name: [self.runs[case.name, seed][1][method.name] for seed in self.seeds
                          if method.name in self.runs.get((case.name, seed), ([], {}))[1]]
            for method in experiments.METHODS} for case in experiments.CASES}

    def _drawings(self, group: str, planned: Sequence[Planned]) -> list[Job]:
        from flexmanip_ros.paper import report

        self.planned[group] = planned
        return [Job('figure', (group, k), partial(report.drawing, one)) for k, one in enumerate(planned)]


def _main(given: argparse.Namespace) -> int:
    from flexmanip_ros.cli import workers
    from flexmanip_ros.io.outputs import OutputError, check_place, write_rows

    if given.runs < 1:
        raise ParameterError(f'--runs is {given.runs}', 'give at least 1')
    if given.workers is not None and given.workers < 0:
        raise ParameterError(f'--workers is {given.workers}', 'give 0 or more')
    console.require_matplotlib()
    from flexmanip_ros.paper import report, summary

    folder = Path(given.output)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as err:
        raise OutputError(f"folder '{folder}' cannot be made: {err.strerror}", 'give another --output') from err
    for name in (PAGE, ROWS, SUMMARY):
        check_place(folder / name)
    started = time.perf_counter()
    cases = [case for case in experiments.CASES if given.case is None or case.name in given.case]
    collected = Collected(cases, range(given.first_seed, given.first_seed + given.runs))
    queue = workers.TaskQueue(collected.first())
    with console.progress('reproducing', 'steps') as progress:
        for count, outcome in enumerate(_compute(given.workers, queue), start=1):
            queue.add(collected.take(outcome))
            progress(count, queue.total)
    wall = time.perf_counter() - started
    rows = collected.rows()
    lines = summary.summary(rows, collected.bounds)
    write_rows(folder / ROWS, rows)
    write_rows(folder / SUMMARY, lines)
    report.report(folder / PAGE, report.Study(rows, collected.bounds, collected.pictures(), given.runs, wall))
    print('\n'.join(describe(lines)))
    print(f"{len(collected.runs)} runs in {wall:.1f} s; wrote '{folder / PAGE}', {ROWS} and {SUMMARY}")
    return console.SUCCESS


def _compute(count: int | None, jobs: Iterable[Job]) -> Iterator[workers.Outcome]:
    from flexmanip_ros.cli import workers

    cores = len(os.sched_getaffinity(0)) if count is None else count
    return workers.processes(work, jobs, cores) if cores > 0 else workers.serial(work, jobs)


def _failed(case: experiments.Case, seed: int, error: BaseException) -> list[Row]:
    from flexmanip_ros.studies import trial

    return [{'case': case.name, 'method': method.name, 'seed': seed, 'error': trial.describe(error)}
            for method in experiments.METHODS]


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


if __name__ == '__main__':
    sys.exit(main())
