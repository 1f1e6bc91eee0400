"""A broken link in docs/ fails the build of the site; `.ci/run` builds it without a warning."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
from pathlib import Path
from types import ModuleType

import pytest

from flexmanip_ros.io.parameter_file import load
from flexmanip_ros.parameters.document import NODES

ROOT = Path(__file__).resolve().parents[2]
FOUND = shutil.which('sphinx-build')
BUILDER = next((place for place in (ROOT / '.venv-docs/bin/sphinx-build', Path(FOUND or '/')) if place.is_file()), None)

needs_sphinx = pytest.mark.skipif(BUILDER is None, reason='Sphinx is not installed; make docs installs it')


@pytest.fixture(scope='module')
def reference() -> ModuleType:
    spec = importlib.util.spec_from_file_location('write_reference', ROOT / 'docs/write_reference.py')
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """Return the folder of a site of two pages, built as docs/ is."""
    shutil.copytree(ROOT / 'docs/_static', tmp_path / 'docs/_static')
    shutil.copy(ROOT / 'docs/conf.py', tmp_path / 'docs')
    shutil.copy(ROOT / 'setup.py', tmp_path)
    (tmp_path / 'docs/concepts.md').write_text('# Concepts\n\n## Status\n', encoding='utf-8')
    (tmp_path / 'docs/index.md').write_text(
        '# Index\n\n[Status](concepts.md#status)\n\n```{toctree}\nconcepts\n```\n', encoding='utf-8')
    return tmp_path


def build(folder: Path) -> subprocess.CompletedProcess[str]:
    """Build the site as `make docs` does."""
    command = [str(BUILDER), '-W', '--keep-going', '--nitpicky', '--quiet', '-b', 'html', '-d', 'doctrees', 'docs',
               'html']
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=170)


@needs_sphinx
def test_a_broken_link_fails_the_build(site: Path) -> None:
    whole = build(site)
    assert whole.returncode == 0, whole.stderr
    broken = {'no_such_page': '[gone](no_such_page.md)', 'no-such-heading': '[gone](concepts.md#no-such-heading)',
              'no_such_picture': '![gone](images/no_such_picture.png)'}
    page = site / 'docs/index.md'
    page.write_text('\n\n'.join([page.read_text(encoding='utf-8'), *broken.values()]), encoding='utf-8')
    done = build(site)
    assert done.returncode != 0
    assert [word for word in broken if word not in done.stderr] == []


def test_the_reference_is_what_the_code_says(reference: ModuleType) -> None:
    written = (ROOT / 'docs/reference.md').read_text(encoding='utf-8')
    assert written == reference.page(), 'stale: run python docs/write_reference.py'


@pytest.mark.parametrize('node', list(NODES))
def test_every_topic_of_a_node_stands_in_its_docstring(reference: ModuleType, node: str) -> None:
    """The reference takes topics from docstrings: those are complete if no line of them was left out."""
    text = reference.docstring(ROOT / f'flexmanip_ros/ros/nodes/{node}.py')
    kinds = [word for word in text.split() if '/msg' not in word and word.count('/') == 1 and '_msgs/' in word]
    listed = [edge.kind for edge in reference.edges(text)]
    assert len(listed) >= len([kind for kind in kinds if not kind.endswith('Inertia,')])


def test_every_argument_of_a_launch_file_is_in_the_reference(reference: ModuleType) -> None:
    sections = '\n'.join(reference.launch_files()).split('### ')
    for path in (ROOT / 'launch').glob('*.launch.py'):
        section = next(part for part in sections if part.startswith(path.name))
        for name in set(_used(path.read_text(encoding='utf-8'))):
            assert f'| `{name}` |' in section, f'{path.name}: {name}'


def _used(source: str) -> list[str]:
    return [part.split("'")[1] for part in source.split('LaunchConfiguration(')[1:] if part.startswith("'")]


def test_the_parameter_file_of_your_own_arm_is_one(tmp_path: Path) -> None:
    page = (ROOT / 'docs/your_own_arm.md').read_text(encoding='utf-8')
    path = tmp_path / 'my_arm.yaml'
    path.write_text(page.split('```yaml\n')[1].split('```')[0], encoding='utf-8')
    for node in ('rpbsid_identifier', 'plant_simulator', 'excitation'):
        assert load(NODES[node], node, str(path), []).arm.joint_mass == 1.2
