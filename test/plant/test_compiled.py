"""Compiled functions on disk never outlive the sources they were made from."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import flexmanip_ros
from flexmanip_ros.numerics.compiled import _sources, drop_stale


def test_caches_older_than_a_kernel_are_dropped(tmp_path: Path) -> None:
    cache = tmp_path / 'plant' / '__pycache__'
    cache.mkdir(parents=True)
    kernel, other = tmp_path / 'plant' / 'kernels.py', tmp_path / 'plant' / 'simulator.py'
    old, young = cache / 'a.nbi', cache / 'b.nbc'
    for path, age in ((kernel, 200), (other, 400), (old, 100), (young, 300)):
        path.write_text('@kernel' if path == kernel else '')
        os.utime(path, (age, age))
    assert drop_stale(tmp_path) == 1
    assert not old.exists()
    assert young.exists()
    assert drop_stale(tmp_path) == 0


def test_caches_older_than_constants_that_a_kernel_reads_are_dropped(tmp_path: Path) -> None:
    package = tmp_path / 'arms'
    cache = package / '__pycache__'
    cache.mkdir(parents=True)
    kernels = ('from arms.layout import (\n    WIDTH,\n)\nfrom arms import state as mem\n'
               'from arms.words import say\n@kernel')
    texts = {'kernels.py': kernels, 'layout.py': '', 'state.py': '', 'words.py': '', '__pycache__/a.nbi': ''}
    ages = {'kernels.py': 100, 'layout.py': 100, 'state.py': 100, 'words.py': 300, '__pycache__/a.nbi': 200}
    for name, text in texts.items():
        (package / name).write_text(text)
        os.utime(package / name, (ages[name], ages[name]))
    assert drop_stale(package) == 0
    os.utime(package / 'layout.py', (400, 400))
    assert drop_stale(package) == 1
    (package / '__pycache__/a.nbi').write_text('')
    os.utime(package / '__pycache__/a.nbi', (500, 500))
    assert drop_stale(package) == 0
    os.utime(package / 'state.py', (600, 600))
    assert drop_stale(package) == 1


def test_every_file_with_a_compiled_function_is_watched() -> None:
    package = Path(flexmanip_ros.__file__).parent
    compiled = {path.parents[1] / f'{path.name.split(".")[0]}.py' for path in package.rglob('__pycache__/*.nbi')}
    assert compiled
    assert compiled <= _sources(package)


SEPARATE = """
from flexmanip_ros.numerics.compiled import inner, kernel, separate

@inner
def power(count):
    return 2.0 ** count

@separate
def halve(x, count):
    return x / power(count)

@kernel
def twice(x):
    return halve(x, 1) + halve(x, 2) * power(0)
"""


def test_a_kernel_from_the_cache_brings_the_separate_kernels_that_it_calls(tmp_path: Path) -> None:
    (tmp_path / 'halves.py').write_text(SEPARATE)
    environment = os.environ | {'PYTHONPATH': os.pathsep.join((str(tmp_path), *sys.path)),
                                'NUMBA_CACHE_DIR': str(tmp_path)}
    call = ('import halves; '
            'print(halves.twice(8.0), halves.halve(8.0, halves.power(0)), sum(halves.twice.stats.cache_hits.values()))')
    said = [subprocess.run([sys.executable, '-c', call], env=environment, capture_output=True, text=True, check=True,
                           timeout=100).stdout.split() for _ in range(2)]
    assert said == [['6.0', '4.0', '0'], ['6.0', '4.0', '1']]
