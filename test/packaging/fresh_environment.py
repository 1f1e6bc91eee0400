"""An sdist, a wheel, and a fresh virtual environment into which the first page of the documentation installs them."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tarfile
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[2]
BUILD = 'import sys; from setuptools import build_meta; print(getattr(build_meta, sys.argv[1])(sys.argv[2]))'
OURS = ('PYTHON', 'AMENT', 'ROS', '_ROS', 'COLCON', 'LD_LIBRARY', 'VIRTUAL_ENV', 'FLEXMANIP', 'NUMBA')
"""Beginnings of the variables that a user with nothing sourced does not have."""


class Fresh(NamedTuple):
    """What the installation of the page made, and what was found right after it."""

    folder: Path
    bin: Path
    installed: subprocess.CompletedProcess[str]
    has_ros: bool
    node: subprocess.CompletedProcess[str]
    """A node that was started without ROS."""

    def sh(self, block: str) -> subprocess.CompletedProcess[str]:
        """Run a code block of a page in the folder, with the environment active."""
        return run('bash', '-ec', f'. arm_env/bin/activate\n{block}', folder=self.folder)


def run(*command: str | Path, folder: Path, seconds: float = 900.0) -> subprocess.CompletedProcess[str]:
    """Run a command as a user with nothing sourced does; pip takes the versions that are locked for the tests."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith(OURS)}
    if (folder / 'constraints.txt').is_file():
        kept['PIP_CONSTRAINT'] = str(folder / 'constraints.txt')
    local = {'ROS_LOG_DIR': str(folder / 'ros_log'), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
             'ROS_DOMAIN_ID': '78'}
    return subprocess.run(
        [str(part) for part in command], cwd=folder, env=kept | local, check=False,
        capture_output=True, text=True, timeout=seconds, stdin=subprocess.DEVNULL)


def blocks(page: str, language: str = 'sh') -> list[str]:
    """Return the code blocks of a page in docs/."""
    text = (ROOT / 'docs' / page).read_text(encoding='utf-8')
    return re.findall(rf'^```{language}\n(.*?)^```', text, re.MULTILINE | re.DOTALL)


def built(hook: str, source: Path, target: Path) -> Path:
    """Build an sdist or a wheel with the installed setuptools, no registry needed; return the file."""
    done = run(sys.executable, '-c', BUILD, hook, target, folder=source)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return target / done.stdout.splitlines()[-1]


def sdist_in(folder: Path) -> Path:
    """Build the sdist from what is committed or would be: a copy of the tree without what is made in it."""
    source = folder / 'tree'
    listed = subprocess.run(['git', 'ls-files', '--cached', '--others', '--exclude-standard'], cwd=ROOT, check=True,
                            capture_output=True, text=True)
    for name in listed.stdout.splitlines():
        if (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
    return built('build_sdist', source, folder)


def unpacked(sdist: Path, folder: Path) -> Path:
    """Unpack an sdist below a folder, under the name of the package."""
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter='data')
    return (folder / sdist.name.removesuffix('.tar.gz')).rename(folder / 'flexmanip_ros')


def fresh_in(folder: Path) -> Fresh:
    """Install the unpacked sdist in the folder as docs/start_here.md says; skip where no registry is reachable."""
    if run(sys.executable, '-m', 'pip', 'index', 'versions', 'rich', '--retries', '0', folder=folder).returncode != 0:
        pytest.skip('no package registry is reachable from here')
    lock = (ROOT / 'requirements/runtime.txt').read_text(encoding='utf-8')
    pins = re.findall(r'^[\w.-]+==\S+(?: ; [^\\\n]+)?', lock, re.MULTILINE)
    (folder / 'constraints.txt').write_text('\n'.join(pins) + '\n', encoding='utf-8')
    installed = run('bash', '-ec', blocks('start_here.md')[0].replace('python3', sys.executable), folder=folder)
    assert installed.returncode == 0, installed.stdout[-2000:] + installed.stderr[-2000:]
    place = folder / 'arm_env/bin'
    has_ros = any(run(place / 'python', '-c', f'import {name}', folder=folder).returncode == 0
                  for name in ('rclpy', 'std_msgs'))
    return Fresh(folder, place, installed, has_ros, run(place / 'rpbsid_identifier', folder=folder))
