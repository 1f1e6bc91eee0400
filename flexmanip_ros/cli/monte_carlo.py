"""monte_carlo: run a scenario with many seeds, or identify many recordings; one row per run."""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flexmanip_ros.cli import console
from flexmanip_ros.errors import ParameterError
from flexmanip_ros.io.parameter_file import load, parse, parse_overrides
from flexmanip_ros.parameters import IdentifierParameters, flatten

if TYPE_CHECKING:
    from flexmanip_ros.cli import workers
    from flexmanip_ros.studies.scenario import Scenario
    from flexmanip_ros.studies.trial import Row

PROG = 'monte_carlo'
RUNS = 100
"""Number of runs of a scenario where none is given."""
EXAMPLES = """examples:
  monte_carlo config/scenarios/capture.yaml --runs 100 --output capture.csv
  monte_carlo recordings/ --params my_arm.yaml --output recordings.csv
  monte_carlo config/scenarios/capture.yaml --runs 100000 --scheduler tcp://head:8786 --output capture.csv

An interrupted study continues when the same command is given again; more --runs add to what is there.
A run that fails gives a row with its error. The true payload of a recording is read from NAME.truth.json beside it.
exit status: 0 on success, 2 on bad arguments, 130 when interrupted.
"""


def _parser() -> console.Parser:
    made = console.parser(
        PROG, 'Run a scenario with many seeds, or identify every recording in a folder; one row per run.', EXAMPLES)
    add = made.add_argument
    add('source', metavar='SCENARIO.yaml|FOLDER', help='scenario to repeat, or folder with recordings')
    console.add_runs(made, RUNS, 'run the seeds FIRST .. FIRST+N-1')
    made.set_defaults(runs=None)  # so that one that is given is told from the default
    add('--first-seed', type=console.whole, metavar='FIRST', help='first seed; default: 0')
    add('--output', default='study.csv', metavar='TABLE', help='table to write, .csv; default: study.csv')
    add('--report', metavar='REPORT.html', help='write a report: one HTML page with scores and figures')
    console.add_workers(made)
    add('--scheduler', metavar='ADDRESS', help='run on the Dask cluster with this scheduler instead')
    console.add_parameters(made, 'the identifier, for recordings', ' of the identifier, also over a scenario')
    return made


def _main(given: argparse.Namespace) -> int:
    from flexmanip_ros.cli import workers
    from flexmanip_ros.io.outputs import Journal, check_place

    todo, identity = _plan(given)
    if given.report is not None:
        check_place(given.report, '.html', '.htm')  # so it is neither the table nor the scenario
    interrupted = False
    with Journal(given.output, identity) as journal:
        versions: dict[Any, str] = {task.key: task.version for task in todo if isinstance(task, workers.Recorded)}
        journal.rows = [row for row in journal.rows
                        if versions.get(row.get(workers.KEY)) in (None, row.get(workers.VERSION))]
        done = {row.get(workers.KEY) for row in journal.rows}
        left = [task for task in todo if task.key not in done]
        if done:
            print(f'continuing: {len(todo) - len(left)} of {len(todo)} runs are done already', file=sys.stderr)
        outcomes = (workers.compute(workers.work, left, given.workers) if given.scheduler is None
                    else workers.cluster(workers.work, left, given.scheduler))
        try:
            with console.progress('running', 'runs') as progress:
                for count, outcome in enumerate(outcomes, start=1):
                    journal.add(outcome.result if outcome.error is None
                                else workers.failed(outcome.task, outcome.error))
                    progress(len(todo) - len(left) + count, len(todo))
        except KeyboardInterrupt:
            interrupted = True
        journal.finish(('estimator', 'seed', workers.KEY))
    if given.report is not None:
        from flexmanip_ros.io.report import study_report

        study_report(given.report, Path(given.source).stem, journal.rows)
    for line in describe(journal.rows):
        print(line)
    print(f"wrote '{given.output}' ({len(journal.rows)} rows)")
    if interrupted:
        words = 'interrupted; the same command continues where this one stopped'
        return console.print_error(PROG, words, console.INTERRUPTED)
    return console.SUCCESS


def _plan(given: argparse.Namespace) -> tuple[Sequence[workers.Task], dict[str, Any]]:
    """Return the tasks that the arguments ask for, and the identity of the study for its journal."""
    from flexmanip_ros.cli import workers
    from flexmanip_ros.io.bag import COMPRESSED, STORAGE

    source = Path(given.source).absolute()  # a worker may have another current directory
    if source.is_dir():
        for option, value in (('--runs', given.runs), ('--first-seed', given.first_seed)):
            if value is not None:
                raise ParameterError(f'{option} is for a scenario', 'leave it away: each recording is identified once')
        config = load(IdentifierParameters, 'rpbsid_identifier', given.params, given.set)
        found = workers.recordings(source)
        if not found:
            raise ParameterError(f"folder '{given.source}' holds no recording", 'give a folder of rosbag2 recordings')
        return ([workers.Recorded(str(path), config, (0.0, float('inf')), workers.version(path)) for path in found],
                {'recordings': str(source), 'parameters': _digest(flatten(config))})
    if source.is_file() and source.name.endswith((*STORAGE, *COMPRESSED)):
        raise ParameterError(f"'{given.source}' is a recording", 'give its folder; each recording in it is identified')
    runs = RUNS if given.runs is None else given.runs
    if runs < 1:
        raise ParameterError(f'--runs is {runs}', 'give at least 1')
    if given.params is not None:
        raise ParameterError('--params is for recordings', 'put the parameters into the scenario file')
    study = read_scenario(Path(given.source), given.set)
    return ([workers.Simulated(study, (given.first_seed or 0) + k) for k in range(runs)],
            {'scenario': study.name, 'parameters': _digest(asdict(study))})


def read_scenario(path: Path, overrides: Sequence[str] = ()) -> Scenario:
    """Return the scenario in a YAML file, with overrides of the identifier's parameters."""
    from flexmanip_ros.studies.scenario import scenario

    try:
        text = path.read_text(encoding='utf-8')
    except (OSError, ValueError) as err:
        reason = getattr(err, 'strerror', None) or 'it is not UTF-8 text'
        raise ParameterError(f"scenario '{path}' cannot be read: {reason}", 'check the path') from err
    try:
        made = scenario(parse(text, 'the file'))
        if overrides:
            values = parse_overrides(overrides)
            made = replace(made, estimators={name: {**given, **values} for name, given in made.estimators.items()})
    except ParameterError as err:
        raise ParameterError(f"scenario '{path}': {err.problem}", err.remedy) from err
    return made


def _digest(values: Any) -> str:
    text = json.dumps(values, sort_keys=True, default=str)
    return hashlib.sha256(text.encode('utf-8')).hexdigest()[:16]


def describe(rows: Sequence[Row]) -> list[str]:
    """Return the scores of each estimator as the lines to print."""
    from flexmanip_ros.studies.results import score

    number = console.number
    lines = [('estimator', 'runs', 'failed', 'mean err %', 'median %', 'rms %', 'bias kg', '95 % interval holds',
              'rms/bound', 'us/sample')]
    for name in sorted({str(row.get('estimator', '')) for row in rows}):
        made = score([row for row in rows if str(row.get('estimator', '')) == name])
        coverage = '-' if math.isnan(made.coverage_percent) else (
            f'{made.coverage_percent:.1f} % ({made.coverage_low:.1f}..{made.coverage_high:.1f})')
        lines.append((
            name or '(failed)', str(made.runs), str(made.failed), number(made.mean_error_percent, 4),
            number(made.median_error_percent, 4), number(made.rms_error_percent, 4), number(made.bias_kg), coverage,
            number(made.bound_ratio), number(made.us_per_sample)))
    return console.aligned(lines, ('24', '>6', '>6', '>10', '>9', '>8', '>9', '>22', '>9', '>9'))


main = partial(console.start, _parser, _main)

if __name__ == '__main__':
    sys.exit(main())
