"""The runs of a study, and where they are computed: this process, this machine's cores, or a Dask cluster."""

from __future__ import annotations

import gc
import hashlib
import importlib
import json
import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from itertools import islice
from multiprocessing.synchronize import Lock
from pathlib import Path
from typing import Any, NamedTuple

from flexmanip_ros.cli import console
from flexmanip_ros.errors import FlexmanipError
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.studies import trial
from flexmanip_ros.studies.scenario import Scenario

KEY = 'run'
"""Name of the column with the key of a run. A study continues with the runs whose keys are not in its journal."""
VERSION = 'version'
"""Name of the column that tells a recording from another one at the same path, which is done again."""
SETTLING_TIME = 1.0
"""Time after a capture in a recording from which on the error counts [s], as in the paper."""

AHEAD = 4
"""Number of runs submitted per worker, so that no worker waits for its next run."""
ANSWER_TIME = 10.0
"""Time after which a scheduler that does not answer counts as missing [s]."""
GARBAGE = 20_000
"""Number of new objects between two garbage collections, each of which visits the many small objects of a run."""

Task = Any
Work = Callable[[Task], Any]


@dataclass(frozen=True)
class Simulated:
    """A run of a scenario with one seed."""

    scenario: Scenario
    seed: int

    @property
    def key(self) -> str:
        """The name of the run."""
        return str(self.seed)


@dataclass(frozen=True)
class Recorded:
    """A run on one recording. window: start and end of the time over which the mean error is taken [s]."""

    path: str
    config: IdentifierParameters
    window: tuple[float, float]
    version: str

    @property
    def key(self) -> str:
        """The name of the run."""
        return self.path


def work(task: Simulated | Recorded) -> list[trial.Row]:
    """Do one run and return its rows, each with the run's name."""
    rows = trial.trial(task.scenario, task.seed) if isinstance(task, Simulated) else [_recorded(task)]
    return [{**_names(task), **row} for row in rows]


def failed(task: Simulated | Recorded, error: BaseException) -> list[trial.Row]:
    """Return the row of a run that failed."""
    return [{**_names(task), 'error': trial.describe(error)}]


def _names(task: Simulated | Recorded) -> trial.Row:
    """Return the columns that name a run."""
    return {KEY: task.key} if isinstance(task, Simulated) else {KEY: task.key, VERSION: task.version}


def _recorded(task: Recorded) -> trial.Row:
    from flexmanip_ros.cli.replay import Messages, Request  # runs of a scenario need none of what they import

    messages = Messages(Request(task.path, task.config), console.Report())
    items = list(messages)
    if messages.fault is not None and not items:  # else the messages before the fault are identified
        raise messages.fault
    truth = true_payload(Path(task.path))
    if truth is not None and messages.recorded:
        truth = trial.held(messages.recorded, truth)
    row = trial.measure(task.config, items, truth, task.window, settled=SETTLING_TIME)
    return {'bag': task.path, 'estimator': task.config.payload_method, **row, 'error': str(messages.fault or '')}


def true_payload(path: Path) -> float | None:
    """Return the mass that NAME.truth.json beside a recording says is held at its end, None when there is none."""
    try:
        found: Any = json.loads(_truth_path(path).read_text(encoding='utf-8'))
    except (OSError, ValueError):
        return None
    mass = found.get('payload_mass_kg') if isinstance(found, dict) else None
    if not isinstance(mass, (int, float)):
        return None
    return float(mass) if found.get('release_time_s') is None else 0.0


def _truth_path(path: Path) -> Path:
    return path.with_name(f'{path.stem if path.is_file() else path.name}.truth.json')


def version(path: Path) -> str:
    """Return what changes with the files of a recording and with that of its truth: their sizes and times."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    states = [(file.name, os.stat(file)) for file in (*files, _truth_path(path))
              if os.path.isfile(file) and not file.name.endswith('-shm')]  # which sqlite makes while it reads
    text = repr([(name, state.st_size, state.st_mtime_ns) for name, state in states])
    return hashlib.sha256(text.encode('utf-8', 'surrogateescape')).hexdigest()[:16]


def recordings(folder: Path) -> list[Path]:
    """Return every recording at or below a folder, in order."""
    found = {path.parent for path in folder.rglob('metadata.yaml')}
    loose = {path for suffix in ('*.mcap', '*.db3') for path in folder.rglob(suffix) if path.parent not in found}
    return sorted(found | loose)


class Outcome(NamedTuple):
    """A task with its result or its error."""

    task: Task
    result: Any
    error: BaseException | None


def compute(work: Work, tasks: Iterable[Task], count: int | None) -> Iterator[Outcome]:
    """Compute in ``count`` processes of this machine (None: one per core), or where it is 0 in this process."""
    if count is None:
        count = len(os.sched_getaffinity(0))
    return processes(work, tasks, count) if count else serial(work, tasks)


def serial(work: Work, tasks: Iterable[Task]) -> Iterator[Outcome]:
    """Compute the tasks in this process, one after the other."""
    with console.announced():
        for task in tasks:
            try:
                result = work(task)
            except Exception as error:  # a failed run is a result
                yield Outcome(task, None, error)
            else:
                yield Outcome(task, result, None)


def processes(work: Work, tasks: Iterable[Task], count: int) -> Iterator[Outcome]:
    """Compute in ``count`` processes of this machine. Outcomes come as they are ready.

    A worker that dies (killed, out of memory) costs at most the run it was doing: the runs under way are done again,
    each alone, so that it is known which one kills its worker.
    """
    waiting = iter(tasks)
    spawn = multiprocessing.get_context('spawn')
    turn = spawn.Lock()

    def tried(some: Iterator[Task]) -> Iterator[Outcome]:
        with ProcessPoolExecutor(count, spawn, _serve, (turn,)) as pool:
            yield from _outcomes(pool, work, some, lambda: count)

    while True:
        again: list[Task] = []
        for outcome in tried(waiting):
            if isinstance(outcome.error, BrokenProcessPool):
                again.append(outcome.task)
            else:
                yield outcome
        if not again:
            return
        for task in again:
            for outcome in tried(iter([task])):
                if isinstance(outcome.error, BrokenProcessPool):
                    outcome = Outcome(task, None, FlexmanipError(
                        'the worker died in this run', 'run it alone with --workers 0 to see why'))
                yield outcome


def _outcomes(pool: Executor, work: Work, waiting: Iterator[Task], workers: Callable[[], int]) -> Iterator[Outcome]:
    """Compute until no task waits or the pool is broken, with ``AHEAD`` tasks a worker under way."""
    running: dict[Future[Any], Task] = {}
    is_broken = False
    try:
        while True:
            for task in islice(waiting, 0 if is_broken else max(AHEAD * workers() - len(running), 0)):
                try:
                    running[pool.submit(work, task)] = task
                except BrokenProcessPool as broken:
                    is_broken = True
                    yield Outcome(task, None, broken)
                    break
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                task = running.pop(future)
                error = CancelledError('the run was cancelled') if future.cancelled() else future.exception()
                is_broken |= isinstance(error, BrokenProcessPool)
                yield Outcome(task, None if error else future.result(), error)
    finally:
        for future in running:
            future.cancel()


def _serve(turn: Lock) -> None:
    """Set up a worker: it ignores Ctrl-C, which its parent handles, and ends when its parent ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.set_threshold(GARBAGE)
    console.announce_in_worker(turn)
    warnings.simplefilter('ignore')  # as in the parent: numbers out of range are told by the status
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    """End this process when the process of the sentinel has ended."""
    multiprocessing.connection.wait([sentinel])
    os._exit(1)


def cluster(work: Work, tasks: Iterable[Task], address: str) -> Iterator[Outcome]:
    """Compute on an existing Dask cluster. The workers need this package installed."""
    try:
        dask = importlib.import_module('dask.distributed')
    except ImportError as err:
        raise FlexmanipError('--scheduler needs dask.distributed, which is not installed',
                             "run 'pip install distributed', or leave --scheduler away") from err
    try:
        client = dask.Client(address, timeout=ANSWER_TIME)
    except (OSError, ValueError) as err:
        raise FlexmanipError(f"no Dask scheduler answers at '{address}'",
                             'start one with: dask scheduler, and workers with: dask worker ADDRESS') from err
    with client:
        try:
            client.wait_for_workers(1, timeout=ANSWER_TIME)
        except TimeoutError as err:
            raise FlexmanipError(f"the cluster at '{address}' has no workers",
                                 'start some with: dask worker ADDRESS') from err
        yield from _outcomes(client.get_executor(pure=False), work, iter(tasks),
                             lambda: max(sum(client.nthreads().values()), 1))  # workers may join and leave
