"""A program answers --help, and a mistake in its arguments, before it loads anything that takes long to load.

An interrupt while it loads kernels ends it as well.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import warnings
from typing import Any

import numpy as np
import pytest

from flexmanip_ros.cli import console

PROGRAMS = ('identify_bag', 'simulate_bag', 'live_view', 'monte_carlo', 'reproduce_paper', 'write_urdf')
SLOW = ('numpy', 'scipy', 'numba', 'rosbags', 'matplotlib', 'rich', 'rclpy')
LOADED = """
import sys
from flexmanip_ros.cli import {program}
try:
    {program}.main({arguments!r})
except SystemExit as end:
    print('exit', end.code)
print('loaded', *sorted(name for name in {slow!r} if name in sys.modules))
"""


def lines_of(program: str, *arguments: str) -> list[str]:
    """Return what a fresh interpreter prints that runs the program and then tells which slow modules it loaded."""
    code = LOADED.format(program=program, arguments=list(arguments), slow=SLOW)
    return subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True).stdout.splitlines()


@pytest.mark.parametrize('program', PROGRAMS)
def test_help_loads_none_of_the_slow_libraries(program):
    lines = lines_of(program, '--help')
    assert lines[0].startswith(f'usage: {program}')
    assert lines[-2:] == ['exit 0', 'loaded']


@pytest.mark.parametrize('program', PROGRAMS)
def test_a_mistake_in_the_arguments_is_told_before_the_slow_libraries_are_loaded(program):
    assert lines_of(program, '--no-such-option')[-2:] == ['exit 2', 'loaded']


def test_an_interrupt_while_llvm_calls_back_comes_once_the_kernel_is_loaded() -> None:
    callback: dict[str, Any] = {'__name__': 'llvmlite.binding.executionengine', 'interrupt': lambda: os.kill(
        os.getpid(), signal.SIGINT)}
    exec('def notify():\n    interrupt()\n    return "to its end"', callback)
    said = []

    def body() -> int:
        said.append(callback['notify']())
        limit = time.monotonic() + 10.0
        while time.monotonic() < limit:
            time.sleep(0.01)
        return console.SUCCESS

    assert console.run('program', body) == console.INTERRUPTED
    assert said == ['to its end']


def test_an_interrupt_at_the_end_of_the_work_is_no_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    class Ending(warnings.catch_warnings):
        def __exit__(self, *reason: object) -> None:
            super().__exit__(*reason)
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(console.warnings, 'catch_warnings', Ending)
    assert console.run('program', lambda: console.SUCCESS) == console.INTERRUPTED


def ended(output: Any, *arguments: str) -> tuple[int, str]:
    """Return exit status and stderr of a write_urdf whose stdout is ``output``, buffered as a user's shell has it."""
    command = [sys.executable, '-m', 'flexmanip_ros.cli.write_urdf', *arguments]
    made = subprocess.run(command, stdout=output, stderr=subprocess.PIPE, text=True, check=False,
                          env={name: value for name, value in os.environ.items() if name != 'PYTHONUNBUFFERED'})
    return made.returncode, made.stderr


@pytest.mark.parametrize('segments', ['2', '30'], ids=['less than a buffer', 'more'])
def test_a_reader_that_ended_is_no_error(segments: str) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    assert ended(writer, '--segments', segments) == (console.SUCCESS, '')
    os.close(writer)


@pytest.mark.parametrize('segments', ['2', '30'], ids=['less than a buffer', 'more'])
def test_a_full_disk_is_one_line_and_exit_2(segments: str) -> None:
    with open('/dev/full', 'wb') as full:
        status, err = ended(full, '--segments', segments)
    assert (status, err.count('\n')) == (console.BAD_INPUT, 1)
    assert 'No space left on device' in err


def test_a_program_works_without_stdout_and_stderr() -> None:
    command = ['sh', '-c', 'exec "$0" -m flexmanip_ros.cli.write_urdf >&- 2>&-', sys.executable]
    assert subprocess.run(command, check=False).returncode == console.SUCCESS


def test_an_error_of_the_file_system_is_one_line_and_exit_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert console.run('program', lambda: len(os.listdir('x' * 300))) == console.BAD_INPUT
    err = capsys.readouterr().err
    assert err.count('\n') == 1
    assert f"'{'x' * 300}': File name too long" in err
    assert 'defect' not in err


def test_work_that_the_memory_does_not_suffice_for_is_no_defect(capsys: pytest.CaptureFixture[str]) -> None:
    """A simulation of 10^6 s at 100 kHz is one line too, and names the size; the samples here have a million TB."""
    assert console.run('program', lambda: np.empty((1 << 57, 1)).size) == console.BAD_INPUT
    err = capsys.readouterr().err
    assert err.count('\n') == 1
    assert 'program: the memory does not suffice: Unable to allocate 1.00 EiB' in err
