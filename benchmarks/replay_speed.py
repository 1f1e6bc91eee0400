"""Claim: `identify_bag` takes at most 5 times what rosbags needs to read and deserialize the recording.

A simulated recording at 1 kHz; the best of three alternating runs of each in this one run: the last estimate alone, and
a table of all of them. Beside it the peak memory
of a recording of four times the length, and how long `--help` and the import take. Use: replay_speed.py [SECONDS]
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import claims

READ = """
import sys, time
from pathlib import Path
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
begin = time.perf_counter()
with AnyReader([Path(sys.argv[1])], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
    for connection, _, raw in reader.messages():
        reader.deserialize(raw, connection.msgtype)
print(time.perf_counter() - begin)
"""


def program(name: str, *arguments: str) -> list[str]:
    """Return the command of an offline program."""
    return [sys.executable, '-m', f'flexmanip_ros.cli.{name}', *arguments]


def timed(command: list[str]) -> tuple[float, float]:
    """Return wall time [s] and peak memory [MB] of a command."""
    begin = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0, command
    return time.perf_counter() - begin, usage.ru_maxrss / 1024.0


def main() -> None:
    """Measure, print and write JSON."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 120.0
    with tempfile.TemporaryDirectory() as folder:
        bags = {}
        for part in (0.5, 1.0, 2.0):
            bags[part] = str(Path(folder) / f'bag_{part}')
            subprocess.run(program('simulate_bag', bags[part], '--duration', str(part * seconds)), check=True,
                           stdout=subprocess.DEVNULL)
        ours, tables, library = [], [], []
        for _ in range(3):
            ours.append(timed(program('identify_bag', bags[1.0]))[0])
            tables.append(timed(program('identify_bag', bags[1.0], '--output', str(Path(folder) / 'table.csv')))[0])
            done = subprocess.run([sys.executable, '-c', READ, bags[1.0]], check=True, capture_output=True, text=True)
            library.append(float(done.stdout))
        memory = {part: timed(program('identify_bag', bags[part]))[1] for part in (0.5, 2.0)}
    bare = min(timed([sys.executable, '-c', 'pass'])[0] for _ in range(5))
    result = {
        'recording_s': seconds, 'identify_bag_s': min(ours), 'rosbags_s': min(library),
        'ratio': min(ours) / min(library), 'ratio_table': min(tables) / min(library),
        'memory_mb': memory, 'memory_ratio': memory[2.0] / memory[0.5],
        'help_s': min(timed(program('identify_bag', '--help'))[0] for _ in range(5)),
        'import_s': min(timed([sys.executable, '-c', 'import flexmanip_ros.cli.replay'])[0] for _ in range(5)) - bare,
        'load_average': os.getloadavg()}
    for name, value in result.items():
        print(f'{name}: {value}')
    claims.write('replay_speed', result)


if __name__ == '__main__':
    main()
