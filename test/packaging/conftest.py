"""The sdist, the wheel and the fresh environment, made once for all tests of this folder."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from fresh_environment import Fresh, built, fresh_in, sdist_in, unpacked


@pytest.fixture(scope='session')
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the sdist."""
    return sdist_in(tmp_path_factory.mktemp('sdist'))


@pytest.fixture(scope='session')
def wheel(sdist: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel from the unpacked sdist, as an installer does."""
    folder = tmp_path_factory.mktemp('wheel')
    return built('build_wheel', unpacked(sdist, folder), folder)


@pytest.fixture(scope='session')
def fresh(sdist: Path, tmp_path_factory: pytest.TempPathFactory) -> Fresh:
    """Install into a new virtual environment, without ROS; ``make test-wheel`` asks for it."""
    if not os.environ.get('FLEXMANIP_FRESH'):
        pytest.skip('a fresh environment downloads and compiles for minutes; make test-wheel makes one')
    folder = tmp_path_factory.mktemp('fresh')
    unpacked(sdist, folder)
    return fresh_in(folder)
