"""From a node class to a program: --help, executor, signals, exit codes."""

from __future__ import annotations

import argparse
import faulthandler
import gc
import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.exceptions import ParameterException
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from flexmanip_ros.errors import FlexmanipError
from flexmanip_ros.parameters.document import help_text
from flexmanip_ros.ros.node import FlexmanipNode

BAD_INPUT = 2
FAREWELL_S = 10.0
"""Longest time in which a node leaves the middleware; it takes some tenths of a second."""
POLL_S = 0.1
"""Longest wait inside the executor, hence the longest delay of a signal on an idle node."""


def make_executor(context: Context | None = None) -> Executor:
    """Return the events executor (a quarter of the cost at 1 kHz), or the plain one where it is absent."""
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        return SingleThreadedExecutor(context=context)
    return EventsExecutor(context=context)


class Interrupt:
    """SIGINT and SIGTERM: at once while there is nothing to put in order, as a flag from ``graceful`` on.

    At once means without Python's own way out: an exception in the midst of the compiler ends in a maze of
    tracebacks. exit_with_signal: end with 128 + the signal's number, as a program whose work is unfinished.
    """

    def __init__(self, *, exit_with_signal: bool = False) -> None:
        self.raised = False
        self.graceful = False
        self.exit_code = 0
        self._exit_with_signal = exit_with_signal

    def install(self) -> None:
        """Take both signals; again after an executor was made, which takes them for itself."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._handle)

    @staticmethod
    def over() -> None:
        """All is put in order: a second signal (launch and a terminal both send one) changes nothing."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.raised = True
        self.exit_code = 128 + number if self._exit_with_signal else 0
        if not self.graceful:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(self.exit_code)


def spin(executor: Executor, context: Context | None, interrupt: Interrupt,
         until: Callable[[], bool] = lambda: False) -> None:
    """Run callbacks until a signal, the end of the context, or ``until``; signals are graceful from here."""
    interrupt.graceful = True
    try:
        # A bare spin() of the events executor runs no callback in rclpy 7.1.
        while not interrupt.raised and rclpy.ok(context=context) and not until():
            executor.spin_once(timeout_sec=POLL_S)
    except ExternalShutdownException:
        return


def run(make: Callable[[], FlexmanipNode[Any]], name: str, about: str | None, cls: type,
        argv: Sequence[str] | None = None) -> int:
    """Run one node until it is asked to stop; return the exit code.

    0 after SIGINT or SIGTERM, 2 with one line on stderr for bad arguments or parameters.
    """
    arguments = list(sys.argv if argv is None else argv)
    interrupt = Interrupt()
    interrupt.install()
    try:
        parser(name, about, cls).parse_args(remove_ros_args(arguments)[1:])
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rcl raises types of its C extension for --ros-args and parameter files
        return refuse(name, first_line(error))
    warnings.simplefilter('ignore', RuntimeWarning)  # numbers out of range have a status
    try:
        node = make()
    except (FlexmanipError, ParameterException) as error:
        rclpy.try_shutdown()
        return refuse(name, str(error))
    executor = make_executor()
    interrupt.install()
    try:
        executor.add_node(node)
        if not node.autostart():
            return BAD_INPUT  # the node has said why
        node.real_time.take()
        gc.collect()
        gc.freeze()  # what lives from here on is not looked through again while samples come
        spin(executor, None, interrupt)
    finally:
        node.close()
        with time_limit(FAREWELL_S):
            executor.shutdown()
            node.destroy_node()
            rclpy.try_shutdown()
            del executor, node  # the executor gives the signals back to their default
            bury()
        interrupt.over()
    return 0


def bury() -> None:
    """Destroy what destroy_node leaves of nodes that nobody refers to any more, the DDS participant among it.

    A node refers to itself, and after gc.freeze no collection finds such a cycle, not even the interpreter's
    last. The participant would go in C's exit handlers, while the thread of rmw_fastrtps that listens to the
    graph still waits on its readers: woken by another node that leaves, it writes into freed memory, and the
    process aborts ("malloc_consolidate(): unaligned fastbin chunk detected").
    """
    gc.unfreeze()
    gc.collect()
    gc.freeze()  # the interpreter's own collections at its end would take 0.2 s


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """End the process with exit code 1 when this takes longer: all is in order, only the middleware hangs.

    Fast DDS 2.14 waits for ever, inside its own code, when a participant is destroyed just as another leaves:
    one mutex each way between ``set_listener`` and the discovery. Nothing of Python runs then.
    """
    faulthandler.dump_traceback_later(seconds, exit=True)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()


def refuse(name: str, problem: str) -> int:
    """Say on stderr why the program does not start; return its exit code."""
    print(f'{name}: {problem}', file=sys.stderr)
    return BAD_INPUT


def first_line(error: BaseException) -> str:
    """Return the first line of an error of the middleware, without its source locations."""
    text = str(error).strip().splitlines()
    line = text[0] if text else type(error).__name__
    return line.split(', at ./')[0].split(', at /')[0]


def parser(name: str, about: str | None, cls: type) -> argparse.ArgumentParser:
    """Return the parser behind --help: what the node is, its topics and services, its parameters."""
    return argparse.ArgumentParser(
        prog=name, formatter_class=argparse.RawDescriptionHelpFormatter,
        usage=f'{name} [--help] [--ros-args -p NAME:=VALUE --params-file FILE.yaml ...]',
        description=about, epilog='parameters:\n' + help_text(cls))
