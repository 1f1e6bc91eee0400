"""Claim: all kernels compile in 50 s on two cores.

A copy of the package without compiled functions, and the command of `make setup`. Use: setup_time.py
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import claims

ROOT = Path(__file__).resolve().parents[1]


def main() -> None:
    """Measure, print and write JSON."""
    with tempfile.TemporaryDirectory() as folder:
        shutil.copytree(ROOT / 'flexmanip_ros', Path(folder) / 'flexmanip_ros',
                        ignore=shutil.ignore_patterns('__pycache__'))
        begin = time.perf_counter()
        subprocess.run([sys.executable, '-m', 'flexmanip_ros.cli.warm_up'], cwd=folder, check=True,
                       env={**os.environ, 'PYTHONPATH': folder})
        seconds = time.perf_counter() - begin
    print(f'compiling all kernels: {seconds:.1f} s on {os.cpu_count()} cores')
    result = {'seconds': seconds, 'cores': os.cpu_count(), 'load_average': os.getloadavg()}
    claims.write('setup_time', result)


if __name__ == '__main__':
    main()
