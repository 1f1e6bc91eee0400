"""The package builds in a real colcon workspace, and what it installs starts from there."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
COLCON = Path(sys.executable).with_name('colcon')
LEFT_OUT = shutil.ignore_patterns(
    '.*', '__pycache__', 'build', 'install', 'log', '*.egg-info', 'demo_output', 'benchmarks'
)

pytestmark = [
    pytest.mark.skipif(not COLCON.exists(), reason='colcon is not installed; make test installs it'),
    pytest.mark.timeout(600),  # kernels are compiled here, on a machine that may be busy
]


FRESH = bool(os.environ.get('FLEXMANIP_FRESH'))
BUILD = re.findall(r'^colcon build.*$', (ROOT / 'README.md').read_text(encoding='utf-8'), re.MULTILINE)[0]
"""As the first page says."""


def run(command: str, folder: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run a line of bash the way a user of a workspace does, with only our Python and colcon on the path."""
    kept = {key: os.environ[key] for key in ('HOME', 'LANG', 'TMPDIR') if key in os.environ}
    path = os.pathsep.join([str(COLCON.parent), '/usr/local/bin', '/usr/bin', '/bin'])
    environment = kept | {'PATH': path, 'ROS_LOG_DIR': str(folder / 'ros_log'), 'COLCON_LOG_LEVEL': '40'}
    return subprocess.run(
        ['bash', '-c', command], cwd=folder, env=environment | variables, check=False,
        capture_output=True, text=True, timeout=580, stdin=subprocess.DEVNULL,
    )


def workspace(folder: Path, *options: str, **variables: str) -> Path:
    """Build a copy of the package in ``folder`` and return it."""
    source = folder / 'src' / 'flexmanip_ros'
    shutil.copytree(ROOT, source, ignore=LEFT_OUT)
    built = run(' '.join([BUILD, *options]), folder, **variables)
    assert built.returncode == 0, built.stdout + built.stderr
    (folder / 'shown.txt').write_text(built.stdout, encoding='utf-8')
    return folder


@pytest.fixture(scope='module')
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return workspace(tmp_path_factory.mktemp('workspace'), FLEXMANIP_WARM_UP='1' if FRESH else '0')


def test_ros2_run_finds_every_executable_where_it_looks(installed: Path) -> None:
    scripts = {path.name for path in (installed / 'install/flexmanip_ros/lib/flexmanip_ros').iterdir()}
    setup = (ROOT / 'setup.py').read_text(encoding='utf-8')
    assert {'plant_simulator', 'rpbsid_identifier', 'identify_bag'} <= scripts
    assert all(re.search(rf"\b{name}\b", setup) for name in scripts)


def test_the_index_and_the_share_folder_are_there_for_ros2_pkg_and_launch(installed: Path) -> None:
    prefix = installed / 'install/flexmanip_ros'
    assert (prefix / 'share/ament_index/resource_index/packages/flexmanip_ros').is_file()
    share = prefix / 'share/flexmanip_ros'
    assert (share / 'package.xml').is_file()
    assert list((installed / 'install').rglob('flexmanip_ros/view/page.html'))  # not beside, but in the package
    for folder in ('config', 'launch'):
        files = [path for path in (ROOT / folder).rglob('*.*') if path.is_file() and path.suffix != '.pyc']
        assert [path for path in files if not (share / path.relative_to(ROOT)).is_file()] == []


def test_an_installed_program_runs_from_the_install_folder(installed: Path) -> None:
    result = run(
        '. install/setup.bash && install/flexmanip_ros/lib/flexmanip_ros/identify_bag --help'
        ' && python -c "import flexmanip_ros; print(flexmanip_ros.__file__)"', installed,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    assert '--validate-from' in result.stdout
    assert result.stdout.splitlines()[-1].startswith(str(installed / 'install'))


@pytest.mark.skipif(not FRESH, reason='compiling takes minutes; make test-wheel does it')
def test_kernels_are_compiled_while_installing(installed: Path) -> None:
    rooms = {path.parent.parent.name for path in (installed / 'install').rglob('*.nbi')}
    assert {'identification', 'payload', 'simulation'} <= rooms
    assert 'compiling 2 parts side by side' in (installed / 'shown.txt').read_text(encoding='utf-8')


def test_what_a_build_prints_is_seen_while_it_builds(installed: Path) -> None:
    """Kernels compile for a minute, and colcon keeps the output of a package to itself unless it is asked for it."""
    assert 'running install' in (installed / 'shown.txt').read_text(encoding='utf-8')


def test_an_installed_node_starts_and_ends_on_interrupt(installed: Path) -> None:
    """Run a real node from install/ for a while, then interrupt it as Ctrl-C does."""
    node = 'plant_simulator' if FRESH else 'excitation'  # which needs no kernels: they would be compiled first
    result = run(
        '. install/setup.bash && exec timeout --signal=INT --kill-after=30 8'
        f' install/flexmanip_ros/lib/flexmanip_ros/{node}', installed,
        ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST', ROS_DOMAIN_ID='77',
    )
    assert result.returncode == 124, result.stdout + result.stderr  # ran until timeout ended it, no sooner
    assert 'Traceback' not in result.stdout + result.stderr, result.stdout + result.stderr


def test_colcon_test_really_runs_tests(installed: Path) -> None:
    tested = run('colcon test --return-code-on-test-failure --pytest-args test/parameters', installed)
    assert tested.returncode == 0, tested.stdout + tested.stderr
    report = next((installed / 'build').rglob('pytest.xml'))
    suites = ElementTree.parse(report).getroot().iter('testsuite')
    assert sum(int(suite.get('tests', '0')) for suite in suites) > 20


def test_a_symlink_install_follows_the_source(tmp_path: Path) -> None:
    folder = workspace(tmp_path, '--symlink-install', FLEXMANIP_WARM_UP='0')
    source = folder / 'src/flexmanip_ros/flexmanip_ros'
    (source / 'added_after_the_build.py').write_text('VALUE = 42\n', encoding='utf-8')
    result = run(
        '. install/setup.bash && install/flexmanip_ros/lib/flexmanip_ros/identify_bag --help > /dev/null'
        ' && python -c "from flexmanip_ros.added_after_the_build import VALUE; print(VALUE)"', folder,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    assert result.stdout.strip() == '42'
