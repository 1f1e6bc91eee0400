"""What package.xml, setup.py, the locks and the README promise is what the code needs and has."""

from __future__ import annotations

import ast
import importlib
import json
import os
import re
import subprocess
import sys
import warnings
import xml.etree.ElementTree as ElementTree
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

import flexmanip_ros

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ElementTree.parse(ROOT / 'package.xml').getroot()
# Imported name -> (rosdep key, name on PyPI); a ROS package is its own key.
LIBRARIES = {
    'numpy': ('python3-numpy', 'numpy'),
    'scipy': ('python3-scipy', 'scipy'),
    'numba': ('python3-numba', 'numba'),
    'matplotlib': ('python3-matplotlib', 'matplotlib'),
    'yaml': ('python3-yaml', 'PyYAML'),
    'rich': ('python3-rich', 'rich'),
    'rosbags': ('python3-rosbags-pip', 'rosbags'),
    'lz4': ('python3-rosbags-pip', 'lz4'),
    'backports': ('python3-rosbags-pip', 'backports.zstd'),
    'compression': ('python3-rosbags-pip', 'backports.zstd'),  # from Python 3.14 on
}
OPTIONAL = {'dask', 'distributed', 'skfem'}
"""Extras, imported where they are used, with an error that names the extra."""


def requirements(name: str) -> str:
    return (ROOT / 'requirements' / name).read_text(encoding='utf-8')


DECLARED = """
import json, setuptools
from distutils.core import run_setup
it = run_setup('setup.py', stop_after='init')
print(json.dumps([it.get_version(), it.entry_points, it.packages, it.data_files,
                  it.install_requires, it.extras_require]))
"""


class Distribution(NamedTuple):
    """What setup.py declares."""

    version: str
    entry_points: dict[str, list[str]]
    packages: list[str]
    data_files: list[tuple[str, list[str]]]
    libraries: list[str]
    extras: dict[str, list[str]]


@pytest.fixture(scope='module')
def distribution() -> Distribution:
    """Return what setup.py declares, read by setuptools itself (whose warnings are its own)."""
    command = [sys.executable, '-c', DECLARED]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return Distribution(*json.loads(done.stdout.splitlines()[-1]))


def programs(distribution: Distribution) -> dict[str, str]:
    pairs = (line.split(' = ') for line in distribution.entry_points['console_scripts'])
    return dict(pairs)


def declared() -> set[str]:
    return {element.text or '' for element in PACKAGE if element.tag.endswith('depend')}


@cache
def third_party() -> dict[str, set[str]]:
    """Return imported name -> files, of everything that is neither Python's own nor ours."""
    found: dict[str, set[str]] = {}
    for path in [*(ROOT / 'flexmanip_ros').rglob('*.py'), *(ROOT / 'launch').glob('*.py')]:
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module]
            for name in {full.split('.')[0] for full in names} - sys.stdlib_module_names - {'flexmanip_ros'}:
                found.setdefault(name, set()).add(str(path.relative_to(ROOT)))
    return {name: files for name, files in found.items() if name not in OPTIONAL}


def test_one_version_everywhere(distribution: Distribution) -> None:
    changelog = (ROOT / 'CHANGELOG.rst').read_text(encoding='utf-8')
    versions = {
        'setup.py': distribution.version,
        'package.xml': PACKAGE.findtext('version'),
        'CHANGELOG.rst': re.findall(r'^(\d+\.\d+\.\d+) \(\d{4}-\d{2}-\d{2}\)$', changelog, re.MULTILINE)[0],
    }
    assert versions == dict.fromkeys(versions, flexmanip_ros.__version__)


def test_every_import_has_a_rosdep_key() -> None:
    for name, files in third_party().items():
        key = LIBRARIES.get(name, (name, ''))[0]
        assert key in declared(), f'{sorted(files)} import {name}: package.xml lacks {key}'


def test_every_rosdep_key_was_looked_up_for_ubuntu_noble() -> None:
    """The notebook has the table; a new key is looked up and added there."""
    notebook = (ROOT / 'docs/lab/jazzy.md').read_text(encoding='utf-8')
    table = notebook.split('## rosdep')[1].split('\n## ')[0]
    found = {key for row in re.findall(r'^\| (`.*?) \|', table, re.MULTILINE) for key in re.findall(r'`([^`]+)`', row)}
    assert declared() - found == set()


def launched() -> set[str]:
    """Return the other packages whose executables our launch files start."""
    texts = [path.read_text(encoding='utf-8') for path in (ROOT / 'launch').glob('*.py')]
    return {name for text in texts for name in re.findall(r"package='(\w+)'", text)} - {'flexmanip_ros'}


def test_every_launched_package_is_a_dependency() -> None:
    assert launched() <= declared()


def test_every_rosdep_key_is_for_something_imported() -> None:
    used = {LIBRARIES.get(name, (name, ''))[0] for name in third_party()}
    tools = {'python3-pytest', 'python3-pytest-timeout', 'python3-hypothesis'}
    assert declared() - used - tools - launched() == set()


def test_what_pytest_is_configured_for_is_a_test_dependency() -> None:
    """``timeout`` in pyproject.toml is an option of pytest-timeout: without it pytest ends in an error."""
    settings = (ROOT / 'pyproject.toml').read_text(encoding='utf-8')
    assert re.search(r'^timeout = \d+$', settings, re.MULTILINE)
    needed = {element.text for element in PACKAGE.iter('test_depend')}
    assert {'python3-pytest', 'python3-pytest-timeout', 'python3-hypothesis'} <= needed


def test_a_deprecated_call_of_an_old_dateutil_is_no_error() -> None:
    """Python 3.12 warns of a call in dateutil 2.8.2 when matplotlib imports it."""
    with pytest.warns(DeprecationWarning, match='another'):  # other warnings remain errors
        warnings.warn_explicit('another', DeprecationWarning, 'tz.py', 1, module='dateutil.tz.tz')
    said = 'datetime.datetime.utcfromtimestamp() is deprecated and scheduled for removal in a future version.'
    warnings.warn_explicit(said, DeprecationWarning, 'tz.py', 37, module='dateutil.tz.tz')


def test_a_test_that_needs_an_extra_is_skipped_without_it(tmp_path: Path) -> None:
    (tmp_path / 'skfem.py').write_text("raise ModuleNotFoundError('not installed here')\n", encoding='utf-8')
    tests = next((ROOT / 'test').rglob('test_finite_element*.py'))
    command = [sys.executable, '-m', 'pytest', '-q', '-p', 'no:cacheprovider', str(tests)]
    search = os.pathsep.join([str(tmp_path), str(ROOT), os.environ.get('PYTHONPATH', '')])
    done = subprocess.run(command, cwd=ROOT, env=os.environ | {'PYTHONPATH': search}, capture_output=True, text=True,
                          check=False)
    assert done.returncode == 0, done.stdout[-2000:]
    assert 'scikit-fem, which is not installed' in done.stdout


@pytest.mark.parametrize('locked', ['runtime.txt', 'jazzy.txt'])
def test_every_import_is_locked(locked: str) -> None:
    lock = requirements(locked)
    for name, files in third_party().items():
        if name in ('launch', 'launch_ros', 'ament_index_python'):
            continue  # not on PyPI: launch files run on a full ROS installation
        pypi = LIBRARIES.get(name, ('', 'ros-' + name))[1].lower().replace('_', '-').replace('.', '-')
        assert re.search(rf'^{pypi}==', lock, re.MULTILINE), f'{sorted(files)} import {name}: not locked'


@pytest.mark.parametrize('name', ['runtime.txt', 'development.txt', 'benchmark.txt', 'jazzy.txt', 'docs.txt'])
def test_locks_pin_every_version_with_hashes_and_name_no_host(name: str) -> None:
    lock = requirements(name)
    entries = re.split(r'\n(?=\S)', lock)
    pins = [entry for entry in entries if not entry.startswith('#')]
    assert all('==' in pin and '--hash=sha256:' in pin for pin in pins)
    assert '://' not in lock
    assert not re.search(r'^\s*--(extra-)?(index|find)', lock, re.MULTILINE)


def test_pip_installs_what_is_imported(distribution: Distribution) -> None:
    """The wheel asks for each library that a program imports, and its extra for each ROS package."""
    ros = {name.partition('[')[0] for name in distribution.extras['ros']}
    for name, files in third_party().items():
        if name in ('launch', 'launch_ros', 'ament_index_python', 'compression'):
            continue  # launch files run on a full ROS installation; compression is Python's own from 3.14 on
        pypi = LIBRARIES.get(name, ('', ''))[1]
        brought = ('builtin_interfaces', 'rcl_interfaces', 'lifecycle_msgs', 'rosidl_runtime_py', 'rosgraph_msgs')
        known = any(item.startswith(pypi) for item in distribution.libraries) if pypi else (
            f'ros-jazzy-{name.replace("_", "-")}' in ros or name in brought)
        assert known, f'{sorted(files)} import {name}: setup.py lacks it'


def test_the_three_locks_agree() -> None:
    def pins(name: str) -> dict[str, str]:
        return dict(re.findall(r'^([\w.-]+)==(\S+)', requirements(name), re.MULTILINE))

    runtime, development, benchmark = pins('runtime.txt'), pins('development.txt'), pins('benchmark.txt')
    assert runtime.items() <= development.items() <= benchmark.items()


def test_every_program_imports_and_is_callable(distribution: Distribution) -> None:
    for name, target in programs(distribution).items():
        module, function = target.split(':')
        assert function == 'main'
        assert module.rpartition('.')[2] == name
        assert callable(getattr(importlib.import_module(module), function))


def test_every_module_with_a_main_is_a_program(distribution: Distribution) -> None:
    modules = [path for door in ('ros', 'cli') for path in (ROOT / 'flexmanip_ros' / door).rglob('*.py')]
    mains = {path.stem for path in modules if re.search(r'\n(def main\(|main = )', path.read_text(encoding='utf-8'))}
    assert mains - {'warm_up'} == set(programs(distribution))


def test_every_package_is_installed(distribution: Distribution) -> None:
    folders = {path.parent for path in (ROOT / 'flexmanip_ros').rglob('*.py')}
    assert set(distribution.packages) == {'.'.join(folder.relative_to(ROOT).parts) for folder in folders}


def test_every_configuration_and_launch_file_is_installed(distribution: Distribution) -> None:
    pairs = [(Path(target), Path(file)) for target, files in distribution.data_files for file in files]
    installed = {str(target / file.name) for target, file in pairs}
    for folder in ('config', 'launch'):
        for path in (ROOT / folder).rglob('*.*'):
            if path.is_file() and '__pycache__' not in path.parts:
                assert f'share/flexmanip_ros/{path.relative_to(ROOT)}' in installed
    assert 'share/flexmanip_ros/package.xml' in installed
    assert 'share/ament_index/resource_index/packages/flexmanip_ros' in installed


def test_the_readme_names_every_program(distribution: Distribution) -> None:
    readme = (ROOT / 'README.md').read_text(encoding='utf-8')
    for name in programs(distribution):
        assert f'`{name}`' in readme
