"""Real nodes over real DDS, each test in a context and a domain of its own."""

from __future__ import annotations

import itertools
import os
import warnings
from collections.abc import Iterator
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
