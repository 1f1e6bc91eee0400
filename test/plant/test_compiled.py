"""Compiled functions on disk never outlive the sources they were made from."""

from __future__ import annotations

import os
from pathlib import Path

from flexmanip_ros.numerics.compiled import drop_stale


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
