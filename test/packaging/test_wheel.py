"""The package installs with pip: a wheel whose offline programs need no ROS, in an environment made for the test."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tarfile
import zipfile
from email.parser import HeaderParser
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
NODES = ('plant_simulator', 'excitation', 'capture_trigger', 'rpbsid_identifier', 'payload_controller')
OFFLINE = ('identify_bag', 'simulate_bag', 'reproduce_paper', 'monte_carlo', 'write_urdf')
BUILD = 'import sys; from setuptools import build_meta; print(getattr(build_meta, sys.argv[1])(sys.argv[2]))'
WORD = 'compiling the kernels for this machine'

pytestmark = pytest.mark.timeout(1500)  # libraries are downloaded and kernels compiled, on a machine that may be busy


def run(*command: str | Path, folder: Path, seconds: float = 900.0) -> subprocess.CompletedProcess[str]:
    """Run a command as a user with nothing sourced does."""
    mine = ('PYTHON', 'AMENT', 'ROS', '_ROS', 'COLCON', 'LD_LIBRARY', 'VIRTUAL_ENV', 'FLEXMANIP', 'NUMBA')
    kept = {key: value for key, value in os.environ.items() if not key.startswith(mine)}
    return subprocess.run(
        [str(part) for part in command], cwd=folder, env=kept | {'ROS_LOG_DIR': str(folder / 'ros_log')}, check=False,
        capture_output=True, text=True, timeout=seconds, stdin=subprocess.DEVNULL)


def built(hook: str, source: Path, target: Path) -> Path:
    """Build an sdist or a wheel with the installed setuptools, no registry needed; return the file."""
    done = run(sys.executable, '-c', BUILD, hook, target, folder=source)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return target / done.stdout.splitlines()[-1]


@pytest.fixture(scope='module')
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the sdist from what is committed or would be: a copy of the tree without what is made in it."""
    folder = tmp_path_factory.mktemp('sdist')
    source = folder / 'tree'
    listed = subprocess.run(['git', 'ls-files', '--cached', '--others', '--exclude-standard'], cwd=ROOT, check=True,
                            capture_output=True, text=True)
    for name in listed.stdout.splitlines():
        if (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
    return built('build_sdist', source, folder)


@pytest.fixture(scope='module')
def wheel(sdist: Path) -> Path:
    """Build the wheel from the unpacked sdist, as an installer does."""
    with tarfile.open(sdist) as archive:
        archive.extractall(sdist.parent, filter='data')
    return built('build_wheel', sdist.parent / sdist.name.removesuffix('.tar.gz'), sdist.parent)


@pytest.fixture(scope='module')
def environment(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Install the wheel without extras into a new virtual environment; return its bin folder."""
    folder = tmp_path_factory.mktemp('fresh')
    assert run(sys.executable, '-m', 'venv', 'venv', folder=folder).returncode == 0
    place = folder / 'venv/bin'
    if run(place / 'pip', 'index', 'versions', 'rich', '--retries', '0', folder=folder).returncode != 0:
        pytest.skip('no package registry is reachable from here')
    install(place, str(wheel))
    return place


def install(place: Path, what: str) -> None:
    """Install with pip, at the versions that are locked for the tests."""
    lock = (ROOT / 'requirements/runtime.txt').read_text(encoding='utf-8')
    pins = re.findall(r'^[\w.-]+==\S+(?: ; [^\\\n]+)?', lock, re.MULTILINE)
    constraints = place.parent / 'constraints.txt'
    constraints.write_text('\n'.join(pins) + '\n', encoding='utf-8')
    done = run(place / 'pip', 'install', '--quiet', '--constraint', constraints, what, folder=place.parent)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]


@pytest.fixture(scope='module')
def recording(environment: Path) -> tuple[Path, str]:
    """Simulate a recording, the first thing done with the installation; return it and what was said on stderr."""
    bag = environment.parent / 'bag'
    done = run(environment / 'simulate_bag', bag, '--duration', '4.5', folder=environment.parent)
    assert done.returncode == 0, done.stderr
    return bag, done.stderr


def metadata(wheel: Path) -> list[str]:
    with zipfile.ZipFile(wheel) as archive:
        name = next(name for name in archive.namelist() if name.endswith('.dist-info/METADATA'))
        return HeaderParser().parsestr(archive.read(name).decode()).get_all('Requires-Dist') or []


def test_the_sdist_holds_what_a_wheel_is_built_from(sdist: Path) -> None:
    with tarfile.open(sdist) as archive:
        names = {name.partition('/')[2] for name in archive.getnames()}
    assert names >= {'setup.py', 'setup.cfg', 'pyproject.toml', 'package.xml', 'README.md', 'LICENSE',
                     'config/arms/quanser.yaml', 'launch/demo.launch.py', 'resource/flexmanip_ros',
                     'flexmanip_ros/py.typed'}


def test_without_the_extra_the_wheel_asks_for_no_ros_package(wheel: Path) -> None:
    always = [line for line in metadata(wheel) if 'extra ==' not in line]
    assert any(line.startswith('rosbags') for line in always)
    assert [line for line in always if line.startswith('ros-') or 'rclpy' in line] == []
    assert any(line.startswith('ros-jazzy-rclpy') and 'extra == "ros"' in line.replace("'", '"')
               for line in metadata(wheel))


def test_the_wheel_has_ordinary_console_scripts_and_the_shared_files(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        points = next(name for name in names if name.endswith('.dist-info/entry_points.txt'))
        scripts = set(re.findall(r'^(\w+) = ', archive.read(points).decode(), re.MULTILINE))
    assert set(NODES) | set(OFFLINE) <= scripts
    assert not [name for name in names if 'lib/flexmanip_ros' in name or '/scripts/' in name]
    assert any(name.endswith('.data/data/share/flexmanip_ros/config/scenarios/capture.yaml') for name in names)


def test_the_fresh_environment_has_no_ros_and_its_scripts_lie_in_bin(environment: Path) -> None:
    for name in ('rclpy', 'std_msgs'):
        assert run(environment / 'python', '-c', f'import {name}', folder=environment.parent).returncode != 0
    assert {path.name for path in environment.iterdir()} >= {*OFFLINE, *NODES, 'demo'}
    assert (environment.parent / 'share/flexmanip_ros/config/scenarios/capture.yaml').is_file()


def test_a_node_says_what_it_lacks(environment: Path) -> None:
    done = run(environment / 'rpbsid_identifier', folder=environment.parent)
    assert done.returncode == 1
    assert "pip install 'flexmanip_ros[ros]'" in done.stderr.splitlines()[-1]


def test_the_first_program_says_once_that_kernels_are_compiled(recording: tuple[Path, str]) -> None:
    assert recording[1].count(WORD) == 1


def test_the_second_time_nothing_is_compiled(environment: Path, recording: tuple[Path, str]) -> None:
    again = run(environment / 'simulate_bag', 'again', '--duration', '0.5', folder=recording[0].parent)
    assert (again.returncode, again.stderr) == (0, '')


def test_identify_bag_finds_the_payload(environment: Path, recording: tuple[Path, str]) -> None:
    done = run(environment / 'identify_bag', recording[0], '--json', folder=recording[0].parent)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    low, high = found['payload_ci95_kg']
    assert low - 0.1 < 20.0 < high + 0.1
    assert high - low < 1.0


def test_a_study_runs_in_processes_of_its_own(environment: Path, recording: tuple[Path, str]) -> None:
    scenario = environment.parent / 'share/flexmanip_ros/config/scenarios/capture.yaml'
    done = run(environment / 'monte_carlo', scenario, '--runs', '2', '--output', 'study.csv',
               folder=recording[0].parent)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count(WORD) <= 1  # however many workers compile
    assert "wrote 'study.csv'" in done.stdout


def test_the_paper_is_reproduced(environment: Path, recording: tuple[Path, str]) -> None:
    done = run(environment / 'reproduce_paper', '--runs', '1', '--case', 'payload_20', '--output', 'paper',
               folder=recording[0].parent)
    assert done.returncode == 0, done.stderr
    assert (recording[0].parent / 'paper/report.html').is_file()


def test_with_the_extra_the_nodes_start_too(environment: Path, wheel: Path) -> None:
    install(environment, f'{wheel}[ros]')
    assert run(environment / 'python', '-c', 'import rclpy', folder=environment.parent).returncode == 0
    done = run(environment / 'rpbsid_identifier', '--help', folder=environment.parent)
    assert done.returncode == 0, done.stderr
    assert 'payload_method' in done.stdout
