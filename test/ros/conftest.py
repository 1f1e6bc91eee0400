"""Real nodes over real DDS, each test in a context and a domain of its own."""

from __future__ import annotations

import itertools
import os
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

with warnings.catch_warnings():
    # The message packages import a parser generator that uses a deprecated module of Python.
    warnings.simplefilter('ignore', DeprecationWarning)
    import rosidl_generator_py  # noqa: F401

if TYPE_CHECKING:
    from ros_harness import Ros

_domains = itertools.count(os.getpid())


@pytest.fixture(autouse=True)
def surroundings(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep logs and discovery to this machine and this test."""
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'log'))
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')


@pytest.fixture
def ros(surroundings: None) -> Iterator[Ros]:
    from ros_harness import Ros

    made = Ros(1 + next(_domains) % 70)  # those above are of tests that run side by side (Makefile, packaging)
    try:
        yield made
    finally:
        made.close()


@pytest.fixture
def log(ros: Ros, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> Iterator[Callable[[str], str]]:
    """Return a function that waits until a text was logged, and returns the log so far.

    What is written while pytest reads what it captured is lost, so the standard error goes to a file from the first
    call on. /rosout ends where an earlier node of the same name is collected.
    """
    path, before = tmp_path / 'stderr', ['']

    def so_far() -> str:
        return before[0] + path.read_text(encoding='utf-8')

    with path.open('ab') as file:
        def wait(text: str) -> str:
            if not os.path.sameopenfile(file.fileno(), 2):
                os.dup2(file.fileno(), 2)  # pytest puts its own back after the test
                before[0] = capfd.readouterr().err
            try:
                ros.wait(lambda: text in so_far())
            except AssertionError:
                pytest.fail(f'{text!r} was not logged but\n{so_far()}')
            return so_far()

        yield wait
