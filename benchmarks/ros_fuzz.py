"""Claim: no message ends a node, makes it say NaN, or fills its memory.

Hypothesis makes up messages (JointState, Header, Float64MultiArray, InertiaStamped; names, sizes, values and
stamps at their extremes; bytes that are no message) and sends them over DDS to every real node that listens;
the strategies are those of test/ros/test_fuzz.py, which runs a few. Memory is what this process holds
after the first and after the last tenth of the examples. Use: ros_fuzz.py [EXAMPLES] [PART_OF_A_NAME]
"""

from __future__ import annotations

import gc
import os
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / 'test' / 'ros'))
os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
warnings.simplefilter('ignore', RuntimeWarning)  # numbers out of range have a status

import claims  # noqa: E402
from fuzz_nodes import SUBJECTS, Bench, fuzz  # noqa: E402
from ros_harness import Ros  # noqa: E402


def resident_mb() -> float:
    """Return the memory that this process has now [MB]."""
    gc.collect()
    pages = int(Path('/proc/self/statm').read_text(encoding='ascii').split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE') / 1e6


def run(name: str, examples: int) -> dict[str, Any]:
    """Fuzz one node; return what it came to."""
    ros = Ros(1 + os.getpid() % 100)
    began = time.monotonic()
    try:
        bench = Bench(ros, name)
        fuzz(bench, examples // 10)
        before = resident_mb()
        fuzz(bench, examples - examples // 10)
        bench.alive()
        problem, grown = '', resident_mb() - before
        received = bench.sent
    except BaseException as error:
        problem, grown, received = f'{type(error).__name__}: {error}'[:300], float('nan'), 0
    try:
        ros.close()
    except BaseException as error:
        problem = problem or str(error)[:300]
    return {'node': name, 'messages': received, 'grown_mb': grown, 'seconds': time.monotonic() - began,
            'problem': problem}


def main() -> None:
    """Fuzz every node; print a table and write JSON."""
    examples = int(sys.argv[1]) if len(sys.argv) > 1 else 3000
    part = sys.argv[2] if len(sys.argv) > 2 else ''
    with tempfile.TemporaryDirectory() as folder:
        os.environ['ROS_LOG_DIR'] = folder
        rows = [run(name, examples) for name in SUBJECTS if part in name]
    print('| node | messages | memory grown MB | s | problem |')
    print('|---|---|---|---|---|')
    for row in rows:
        print(f'| {row["node"]} | {row["messages"]} | {row["grown_mb"]:.1f} | {row["seconds"]:.0f} | '
              f'{row["problem"]} |')
    if not part:
        claims.write('ros_fuzz', rows)
    if any(row['problem'] for row in rows):
        sys.exit(1)


if __name__ == '__main__':
    main()
