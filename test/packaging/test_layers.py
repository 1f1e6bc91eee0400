"""The shape of the code, walked file by file: imports point one way, and the core keeps to itself."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / 'flexmanip_ros'
MODULES = sorted(PACKAGE.rglob('*.py'))

# leaves <- core <- pipeline <- doors; what is not named here is core.
FORBIDDEN_TO_BAGS = ('flexmanip_ros.ros', 'flexmanip_ros.cli')
LEAVES = {'', 'types', 'errors', 'parameters'}
PIPELINE = {'estimator', 'event_replay', 'pipeline', 'studies'}
DOORS = {'io', 'ros', 'cli', 'paper', 'view'}
ROS_LIBRARIES = {
    'rclpy', 'launch', 'launch_ros', 'ament_index_python', 'rosidl_runtime_py', 'rosbag2_py',
    'action_msgs', 'builtin_interfaces', 'diagnostic_msgs', 'geometry_msgs', 'lifecycle_msgs',
    'rcl_interfaces', 'rosgraph_msgs', 'sensor_msgs', 'std_msgs', 'std_srvs', 'visualization_msgs',
}
FORBIDDEN = {'print', 'input', 'exit', 'quit', 'sys.exit', 'os._exit', 'np.random.seed', 'np.seterr'}
"""Calls that speak for the whole process, which belongs to whoever uses the core."""


def name_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix('').parts
    return '.'.join(parts[:-1] if parts[-1] == '__init__' else parts)


def part_of(module: str) -> str:
    """Return the first name below the package: 'arm' for flexmanip_ros.arm.capture."""
    return [*module.split('.'), ''][1]


def layer(module: str) -> int:
    part = part_of(module)
    if part in LEAVES:
        return 0
    return 3 if part in DOORS else 2 if part in PIPELINE else 1


def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding='utf-8'), str(path))


def imports_of(path: Path) -> Iterator[str]:
    """Yield every module that a file imports, those inside functions included."""
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{path}:{node.lineno}: relative import'
            assert node.module is not None
            if node.module.split('.')[0] != PACKAGE.name:
                yield node.module
                continue
            for alias in node.names:
                deeper = ROOT / Path(*node.module.split('.')) / alias.name
                is_module = deeper.is_dir() or deeper.with_suffix('.py').is_file()
                yield f'{node.module}.{alias.name}' if is_module else node.module


def of_layers(*layers: int) -> list[Path]:
    return [path for path in MODULES if layer(name_of(path)) in layers]


def without(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize('path', MODULES, ids=without)
def test_imports_point_from_doors_to_leaves(path: Path) -> None:
    here = name_of(path)
    upward = [
        there for there in imports_of(path)
        if there.split('.')[0] == PACKAGE.name and there != PACKAGE.name and layer(there) > layer(here)
    ]
    assert not upward, f'{here} imports {upward}, which are built on it'


def test_no_files_import_each_other_in_a_circle() -> None:
    known = {name_of(path): path for path in MODULES}
    graph = {name: {there for there in imports_of(path) if there in known and there != name}
             for name, path in known.items()}
    while free := [name for name, needs in graph.items() if not needs & graph.keys()]:
        for name in free:
            del graph[name]
    assert not graph, f'these import each other, or what is in the circle: {sorted(graph)}'


@pytest.mark.parametrize('path', MODULES, ids=without)
def test_only_ros_imports_ros_and_only_io_imports_rosbags(path: Path) -> None:
    part = part_of(name_of(path))
    outside = {there.split('.')[0] for there in imports_of(path)}
    if part != 'ros':
        assert not outside & ROS_LIBRARIES
    if part != 'io':
        assert 'rosbags' not in outside


def test_bags_do_not_know_nodes_nor_command_lines() -> None:
    for path in MODULES:
        if part_of(name_of(path)) == 'io':
            wrong = [there for there in imports_of(path) if there.startswith(FORBIDDEN_TO_BAGS)]
            assert not wrong, f'{without(path)} imports {wrong}'


@pytest.mark.parametrize('path', of_layers(0, 1, 2), ids=without)
def test_the_core_prints_nothing_never_exits_and_keeps_no_globals(path: Path) -> None:
    for node in ast.walk(tree_of(path)):
        where = f'{without(path)}:{getattr(node, "lineno", 0)}'
        assert not isinstance(node, ast.Global), f'{where}: global state'
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            assert called not in FORBIDDEN, f'{where}: {called}'
        if isinstance(node, ast.Raise) and node.exc is not None:
            assert 'SystemExit' not in ast.unparse(node.exc), f'{where}: leaves the process'


BLOCKED = """
import importlib, sys
blocked, modules = set(sys.argv[1].split(',')), sys.argv[2].split(',')
class Block:
    def find_spec(self, name, path=None, target=None):
        if name.split('.')[0] in blocked:
            raise ImportError(f'{name} is blocked here')
sys.meta_path.insert(0, Block())
for module in modules:
    importlib.import_module(module)
"""


BAG_LIBRARIES = {'rosbags', 'lz4', 'backports'}


def importable(parts: str) -> list[str]:
    chosen = of_layers(0, 1, 2) if parts == 'core' else of_layers(3)
    names = [name_of(path) for path in chosen if path.stem != '__main__']
    if parts == 'nodes':
        return [name for name in names if name.startswith('flexmanip_ros.ros.nodes.')]
    return [name for name in names if part_of(name) != 'ros']


@pytest.mark.parametrize(
    ('libraries', 'parts'),
    [(ROS_LIBRARIES | BAG_LIBRARIES, 'core'), (ROS_LIBRARIES, 'io and cli'), (BAG_LIBRARIES, 'nodes')],
    ids=['core without ROS and bags', 'io and cli without ROS', 'nodes without bags'],
)
def test_imports_without(libraries: set[str], parts: str) -> None:
    modules = importable(parts)
    result = subprocess.run(
        [sys.executable, '-c', BLOCKED, ','.join(libraries), ','.join(modules)],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )
    assert result.returncode == 0, result.stderr[-2000:]


@pytest.mark.parametrize(('code', 'threads', 'warned'), [
    ('import numpy, flexmanip_ros', {}, True),
    ('import flexmanip_ros, numpy', {}, False),
    ('import numpy, flexmanip_ros', {'OMP_NUM_THREADS': '2'}, False),
], ids=['after numpy', 'before numpy', 'where the user has chosen'])
def test_an_import_after_numpy_says_that_its_threads_cost_time(
    code: str, threads: dict[str, str], warned: bool,
) -> None:
    own = {name: value for name, value in os.environ.items() if not name.endswith('_NUM_THREADS')}
    result = subprocess.run([sys.executable, '-c', code], cwd=ROOT, env={**own, **threads}, capture_output=True,
                            text=True, check=True)
    assert ('Import flexmanip_ros first' in result.stderr) is warned, result.stderr


@cache
def defined_in(path: Path) -> set[str]:
    """Return every name that a module binds anywhere."""
    return {name for node in ast.walk(tree_of(path)) for name in (
        [node.name] if isinstance(node, (ast.FunctionDef, ast.ClassDef)) else
        [node.id] if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) else
        [alias.asname or alias.name for alias in node.names] if isinstance(node, (ast.Import, ast.ImportFrom)) else [])}


@pytest.mark.parametrize('folder', ['benchmarks', 'docs', 'launch', 'test'])
def test_what_is_imported_from_the_package_is_there(folder: str) -> None:
    """Benchmarks and launch files run seldom, and mypy reads the package alone."""
    missing = []
    for path in sorted((ROOT / folder).rglob('*.py')):
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.ImportFrom) and (node.module or '').split('.')[0] == PACKAGE.name:
                place = ROOT / Path(*str(node.module).split('.'))
                file = place / '__init__.py' if place.is_dir() else place.with_suffix('.py')
                known = defined_in(file) if file.is_file() else set()
                missing += [f'{without(path)}:{node.lineno}: {node.module}.{alias.name}' for alias in node.names
                            if alias.name not in known and not (place / alias.name).with_suffix('.py').is_file()
                            and not (place / alias.name).is_dir()]
    assert not missing, missing
