"""A program answers --help, and a mistake in its arguments, before it loads anything that takes long to load."""

from __future__ import annotations

import subprocess
import sys

import pytest

PROGRAMS = ('identify_bag', 'simulate_bag', 'live_view', 'monte_carlo', 'reproduce_paper', 'write_urdf')
SLOW = ('scipy', 'numba', 'rosbags', 'matplotlib', 'rich', 'rclpy')
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
