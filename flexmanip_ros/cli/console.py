"""What every program shares: progress on a terminal, one line for an error, exit codes."""

from __future__ import annotations

import argparse
import math
import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from flexmanip_ros.errors import FlexmanipError

SUCCESS, DEFECT, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
LONGEST = 1e9
"""Seconds; beyond it a stamp in nanoseconds may not be one."""
TRACEBACK = 'FLEXMANIP_TRACEBACK'
"""Environment variable that lets the traceback of a defect through."""
Report = Callable[[int, int | None], None]
"""Called with what is done and what there is to do (None: unknown)."""


class Parser(argparse.ArgumentParser):
    """Arguments with one line for a mistake."""

    def error(self, message: str) -> NoReturn:
        """Say what is wrong and where help is; exit 2."""
        self.exit(BAD_INPUT, f'{self.prog}: {message}; see {self.prog} --help\n')


def seconds(text: str) -> float:
    """Return a time given as an argument [s]. Raises ArgumentTypeError when it is none."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not abs(value) <= LONGEST:
        raise argparse.ArgumentTypeError(f"'{text}' is not a time in seconds")
    return value


def whole(text: str) -> int:
    """Return a seed or count given as an argument. Raises ArgumentTypeError when it is none."""
    if not text.strip().isdecimal():
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number from 0 up")
    return int(text)


def parser(prog: str, words: str, epilog: str) -> Parser:
    """Return a parser whose examples keep their lines."""
    return Parser(prog=prog, description=words, epilog=epilog, allow_abbrev=False,
                  formatter_class=argparse.RawDescriptionHelpFormatter)


@contextmanager
def progress(words: str, unit: str) -> Iterator[Report]:
    """Show a bar on stderr when that is a terminal; otherwise nothing."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda done, total: None
        return
    bar = Progress(TextColumn(words), BarColumn(), MofNCompleteColumn(), TextColumn(unit),
                   TimeRemainingColumn(), console=console, transient=True)
    with bar:
        task = bar.add_task(words, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def complain(prog: str, error: BaseException | str) -> None:
    """Write one line on stderr."""
    print(f'{prog}: {" ".join(str(error).split())}', file=sys.stderr)


def require_pictures() -> None:
    """Raise now, not after the work, when pictures are asked for and cannot be drawn."""
    try:
        import matplotlib  # noqa: F401
    except ImportError as err:
        raise FlexmanipError('a report needs matplotlib, which is not installed',
                             "run 'pip install matplotlib', or leave --report away") from err


def run(prog: str, body: Callable[[], int]) -> int:
    """Run a program: our errors become one line and exit 2, an interrupt exit 130."""
    with _signals_as_interrupt(), warnings.catch_warnings():
        warnings.simplefilter('ignore')  # numbers out of range have a status; stderr is for one line
        try:
            return body()
        except FlexmanipError as error:
            complain(prog, error)
            return BAD_INPUT
        except KeyboardInterrupt:
            complain(prog, 'interrupted')
            return INTERRUPTED
        except BrokenPipeError:
            sys.stderr.close()  # the reader of our output is gone; nothing is left to say
            return SUCCESS
        except Exception as error:
            if os.environ.get(TRACEBACK):
                raise
            complain(prog, f'a defect of this program: {type(error).__name__}: {error}; '
                     f'please report it with the recording ({TRACEBACK}=1 shows where)')
            return DEFECT


@contextmanager
def _signals_as_interrupt() -> Iterator[None]:
    """Let SIGINT and SIGTERM raise, so that what was computed is written in both cases."""
    def interrupt(number: int, frame: FrameType | None) -> None:
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
