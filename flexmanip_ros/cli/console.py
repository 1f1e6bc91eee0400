"""What every program shares: progress on a terminal, a word while kernels compile, one line for an error, exit codes.

The programs import numpy, scipy, numba, rosbags and matplotlib only after their arguments are parsed, so that
``--help`` and a mistake in the arguments are answered at once.
"""

import argparse
import math
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn

from flexmanip_ros.errors import FlexmanipError

if TYPE_CHECKING:
    from multiprocessing.synchronize import Lock

SUCCESS, DEFECT, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
LONGEST = 1e9
"""Largest time that is accepted [s]; larger ones overflow a stamp in nanoseconds."""
POSTPONED_S = 0.05
"""Time after which a postponed signal is sent again [s]; a kernel is loaded and a message written in milliseconds."""
UNINTERRUPTED = ('llvmlite.', 'flexmanip_ros.io.bag_writer')
"""Modules in which no signal is handled. An exception in a callback of LLVM, which loads a kernel, is printed and lost,
or ends the process with SIGSEGV; one between two writes to a recording leaves a file without its end."""
END_S = 0.2
"""Time given to a background thread that was told to end [s]; one that is idle ends in milliseconds, one in a kernel
cannot be stopped."""
MOST_RUNS, MOST_WORKERS = 1_000_000, 10_000
"""Largest numbers of runs in one command and of processes. The runs to do are listed first, in 0.2 kB each."""
TRACEBACK = 'FLEXMANIP_TRACEBACK'
"""Environment variable; where it is set, a defect prints its traceback."""
PATIENCE = 2.0
"""Duration of a compilation [s] from which on the user is told of it; a shorter one is not worth a line."""
COMPILING = ('flexmanip_ros: compiling the kernels for this machine. It takes a minute or two, at the first use of '
             'each method after an installation.')


class Report:
    """Progress of a program, shown by a bar of rich where one is given. ``progress`` gives one on a terminal."""

    def __init__(self, bar: Any = None, task: Any = None) -> None:
        self._bar, self._task = bar, task

    def __call__(self, done: int, total: int | None) -> None:
        """Note the steps done and the steps in all (None: unknown)."""
        if self._bar is not None:
            self._bar.update(self._task, completed=done, total=total)

    def phase(self, words: str) -> None:
        """Begin another part of the work, whose duration is not known."""
        if self._bar is not None:
            self._bar.reset(self._task, description=words, total=None)


class Parser(argparse.ArgumentParser):
    """An argument parser that reports a mistake in one line."""

    def error(self, message: str) -> NoReturn:
        """Print the mistake and where to find help; exit with 2."""
        self.exit(BAD_INPUT, f'{self.prog}: {message}; see {self.prog} --help\n')


def seconds(text: str) -> float:
    """Return an argument as a time [s]. Raises ArgumentTypeError."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not abs(value) <= LONGEST:
        raise argparse.ArgumentTypeError(f"'{text}' is not a time in seconds")
    return value


def positive_seconds(text: str) -> float:
    """Return an argument as a time above 0 [s]. Raises ArgumentTypeError."""
    value = seconds(text)
    if not value > 0.0:
        raise argparse.ArgumentTypeError(f"'{text}' is not a time above 0 s")
    return value


def whole(text: str, most: int = 2**63 - 1) -> int:
    """Return an argument as a seed or count. Raises ArgumentTypeError."""
    if not text.strip().isdecimal() or len(text.strip()) > 19 or int(text) > most:
        raise argparse.ArgumentTypeError(f"'{text:.30}' is not a whole number from 0 to {most}")
    return int(text)


def parser(prog: str, words: str, epilog: str) -> Parser:
    """Return a parser. words: its description; epilog: printed as it is, below the arguments."""
    return Parser(prog=prog, description=words, epilog=epilog, allow_abbrev=False,
                  formatter_class=argparse.RawDescriptionHelpFormatter)


class Once(argparse.Action):
    """An option that may be given once; argparse would drop the first of two values without a message."""

    def __call__(self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any,
                 option_string: str | None = None) -> None:
        """Store the value, or report an error where the option already has one."""
        if getattr(namespace, self.dest) is not None:
            parser.error(f'{option_string} was given twice; give one file with the parameters of both')
        setattr(namespace, self.dest, values)


def add_parameters(made: Parser, owner: str, note: str = '') -> None:
    """Add --params and --set. owner: whose parameters they are; note: what else --set can name."""
    made.add_argument('--params', metavar='FILE.yaml', action=Once,
                      help=f'ROS parameter file with the parameters of {owner}')
    made.add_argument('--set', metavar='name=value', action='append', default=[],
                      help=f'set one parameter{note}; the value is YAML; may be repeated')


def add_runs(made: Parser, default: int, words: str) -> None:
    """Add --runs: a count. words: what is run so often."""
    made.add_argument('--runs', type=lambda text: whole(text, MOST_RUNS), default=default, metavar='N',
                      help=f'{words}; default: {default}')


def add_workers(made: Parser) -> None:
    """Add --workers: a count, or None for one per core."""
    made.add_argument('--workers', type=lambda text: whole(text, MOST_WORKERS), metavar='N',
                      help='number of processes; default: one per core; 0: this process alone')


@contextmanager
def progress(words: str, unit: str) -> Iterator[Report]:
    """Show a bar on stderr when that is a terminal; otherwise nothing."""
    if not sys.stderr.isatty():
        yield Report()
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    bar = Progress(TextColumn('{task.description}'), BarColumn(), MofNCompleteColumn(), TextColumn(unit),
                   TimeRemainingColumn(), console=Console(stderr=True), transient=True)
    with bar:
        yield Report(bar, bar.add_task(words, total=None))


def tell_compiling() -> None:
    """Write ``COMPILING`` on stderr."""
    print(COMPILING, file=sys.stderr, flush=True)


@contextmanager
def announced(say: Callable[[], None] = tell_compiling) -> Iterator[None]:
    """Tell the user at most once, on stderr unless ``say`` does otherwise, that kernels are being compiled.

    `make setup` and `colcon build` compile all kernels beforehand (`warm_up`); a wheel is only files. numba then
    compiles each kernel when it is called first, and keeps it on disk.
    """
    from numba.core import event

    with event.install_listener('numba:compile', _listener(say)):
        yield


def announce_in_worker(turn: 'Lock') -> None:
    """Do as ``announced`` in a worker process. The workers of a pool share ``turn``: the first to take it tells."""
    from numba.core import event

    def once() -> None:
        if turn.acquire(block=False):
            tell_compiling()

    event.register('numba:compile', _listener(once))  # type: ignore[no-untyped-call]


def _listener(say: Callable[[], None]) -> Any:
    """Return a listener to numba's compilations that calls ``say`` once if one takes long."""
    from numba.core import event

    class Listener(event.Listener):
        depth = 0  # the compilation of one kernel may contain that of another
        told = False
        timer: threading.Timer | None = None

        def on_start(self, event: Any) -> None:
            self.depth += 1
            if self.depth == 1 and not self.told:
                self.timer = threading.Timer(PATIENCE, self.tell)
                self.timer.daemon = True
                self.timer.start()

        def on_end(self, event: Any) -> None:
            self.depth -= 1
            if self.depth == 0 and self.timer is not None:
                self.timer.cancel()

        def tell(self) -> None:
            self.told = True
            say()

    return Listener()


def open_streams() -> None:
    """Send stdout and stderr nowhere where they were closed, as by a service manager; Python has None instead."""
    for name in ('stdout', 'stderr'):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), 'w'))


def print_error(prog: str, error: BaseException | str, code: int = BAD_INPUT) -> int:
    """Write one line on stderr; return the exit code of a program that ends with it."""
    print(f'{prog}: {" ".join(str(error).split())}', file=sys.stderr)
    return code


def number(value: float | None, digits: int = 3) -> str:
    """Return a number as text; '-' where there is none."""
    return '-' if value is None or math.isnan(value) else f'{value:.{digits}g}'


def aligned(rows: Iterable[Sequence[str]], formats: Sequence[str]) -> list[str]:
    """Return the lines of a table. formats: of each column, such as '12' (to the left) or '>9' (to the right)."""
    return [' '.join(f'{cell:{how}}' for cell, how in zip(row, formats, strict=True)) for row in rows]


def start(parser: Callable[[], Parser], body: Callable[[argparse.Namespace], int],
          arguments: Sequence[str] | None = None) -> int:
    """Run a program with its arguments; return its exit status."""
    made = parser()
    given = made.parse_args(arguments)
    return run(made.prog, lambda: body(given))


def run(prog: str, body: Callable[[], int]) -> int:
    """Run a program; return its exit status.

    That is 2 after an error of the package, of the file system or without memory, 130 when interrupted, 1 for a defect.
    """
    signals: list[int] = []
    status = _run(prog, body, signals)
    if status == INTERRUPTED and signals:
        _end_at_once(status)
    return status


def _run(prog: str, body: Callable[[], int], signals: list[int]) -> int:
    """Run a program; return its exit status. signals: takes the number of each signal that interrupts it."""
    open_streams()
    try:  # around all of it, as a signal may come while a context manager ends
        with _signals_as_interrupt(signals), warnings.catch_warnings():
            warnings.simplefilter('ignore')  # the status reports numbers out of range; stderr is for one line
            status = body()
            sys.stdout.flush()  # at the end of the process an error of it would be a traceback and status 120
            return status
    except FlexmanipError as error:
        return print_error(prog, error)
    except KeyboardInterrupt:
        return print_error(prog, 'interrupted', INTERRUPTED)
    except BrokenPipeError:
        _drop_output()  # its reader has ended
        return SUCCESS
    except Exception as error:
        if os.environ.get(TRACEBACK):
            raise
        if isinstance(error, OSError):  # a name that is too long, a folder of somebody else, a full disk
            if error.filename is None:
                _drop_output()
            place = '' if error.filename is None else f"'{error.filename}': "
            words = f'{place}{error.strerror or error}; check names, permissions and space on the disk'
            return print_error(prog, words)
        if isinstance(error, MemoryError):
            return print_error(prog, f'the memory does not suffice: {error}; ask for fewer samples, or a lower rate')
        return print_error(prog, f'a defect of this program: {type(error).__name__}: {error}; '
                           f'please report it with the recording ({TRACEBACK}=1 shows where)', DEFECT)


def _end_at_once(status: int) -> None:
    """End this process where a background thread still computes: Python would wait for it, for seconds to minutes."""
    from flexmanip_ros.numerics.background import NAME

    for thread in threading.enumerate():
        if thread.name.startswith(NAME):
            thread.join(END_S)
            if thread.is_alive():
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(status)


def _drop_output() -> None:
    """Send what is left of stdout nowhere: Python would write it at the end of the process, and fail again."""
    with suppress(OSError):  # it is not a file
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def is_postponed(number: int, frame: FrameType | None) -> bool:
    """Return whether a signal came in one of the modules ``UNINTERRUPTED``; it is sent again after ``POSTPONED_S``."""
    while frame is not None:
        if frame.f_globals.get('__name__', '').startswith(UNINTERRUPTED):
            send_again(number, POSTPONED_S)
            return True
        frame = frame.f_back
    return False


def send_again(number: int, seconds: float) -> None:
    """Send a signal to this process after a time [s]."""
    timer = threading.Timer(seconds, os.kill, (os.getpid(), number))
    timer.daemon = True
    timer.start()


@contextmanager
def _signals_as_interrupt(signals: list[int]) -> Iterator[None]:
    """Raise KeyboardInterrupt on SIGINT and on SIGTERM, so that both write the results so far; note their numbers."""
    def interrupt(number: int, frame: FrameType | None) -> None:
        if not is_postponed(number, frame):
            signals.append(number)
            raise KeyboardInterrupt

    try:
        before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    except ValueError:  # not the main thread
        yield
        return
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
