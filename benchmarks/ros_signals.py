"""Claim: SIGINT, SIGTERM and SIGKILL at any moment of a program's work leave whole files, no orphan, and no traceback.

Every executable is started and stopped again after delays drawn between its start and its end: while modules
are imported, while kernels load, during discovery, at work, while files are written. After SIGINT and SIGTERM
the exit code is 0 (a node, or the work was done), 128 + the signal or 130 (it was not), and what was begun is
closed and readable; after SIGKILL a recording gives back what was flushed, a checkpoint is the old or the new
one, a journal ends in a whole line. A signal that comes before a program's main function, while modules are
imported, is answered by Python itself, and counted apart. Use: ros_signals.py [RUNS] [PART_OF_A_NAME]
"""

from __future__ import annotations

import json
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import claims

from flexmanip_ros.errors import BagError, CheckpointError
from flexmanip_ros.io import bag, checkpoint

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
PATIENCE_S = 30.0


NODES = ('plant_simulator', 'excitation', 'capture_trigger', 'rpbsid_identifier', 'payload_controller',
         'payload_adapter')


def command(name: str) -> list[str]:
    """Return what the installed script of a program does."""
    where = 'ros.nodes.' + name if name in NODES else 'ros.demo' if name == 'demo' else 'cli.' + name
    return [sys.executable, '-c', f'import sys; from flexmanip_ros.{where} import main; sys.exit(main())']


class Program(NamedTuple):
    """An executable: its name, arguments with {out} for a folder of its own, and how long to wait at most."""

    name: str
    module: str
    arguments: tuple[str, ...]
    longest_s: float
    look: Callable[[Path, bool], str] = lambda folder, killed: ''
    """Says what is wrong with the files left; empty when nothing is."""
    fed: bool = False
    """Joint states come meanwhile."""


def recording(path: Path, killed: bool) -> str:
    """A recording is whole; after a kill what comes out of it is a beginning."""
    if not path.exists() or (killed and not any(path.glob('*.mcap'))):
        return ''
    try:
        for _ in bag.read(path):
            pass
    except BagError as error:
        said = ('is empty', 'no message', 'has no topic', 'metadata.yaml')
        empty = any(words in str(error) for words in said)
        return '' if killed or empty else str(error)
    return ''


def demo(folder: Path, killed: bool) -> str:
    """Return what is wrong with the demonstration's recording."""
    return '; '.join(filter(None, (recording(path / 'bag', killed) for path in folder.glob('run_*'))))


def kept(folder: Path, killed: bool) -> str:
    """A checkpoint is there whole or not at all."""
    try:
        checkpoint.load(folder / 'state')
    except CheckpointError as error:
        return str(error)
    return ''


def rows(folder: Path, killed: bool) -> str:
    """Tables are whole; a journal's last line may be torn by a kill only."""
    for path in folder.glob('*.journal'):
        lines = path.read_text(encoding='utf-8').split('\n')
        for line in lines[:-1] if killed else lines:
            if line:
                json.loads(line)
    for path in folder.glob('*.csv'):
        if len({line.count(',') for line in path.read_text(encoding='utf-8').splitlines()}) > 1:
            return f'{path.name} is torn'
    return ''


SCENARIO = """
name: signals
duration: 2.0
capture_time: 1.0
window: [1.5, 2.0]
"""
PROGRAMS = (
    Program('plant_simulator', 'plant_simulator', (), 3.0),
    Program('excitation', 'excitation', (), 2.0),
    Program('capture_trigger', 'capture_trigger', ('--ros-args', '-p', 'mode:=auto'), 3.0),
    Program('rpbsid_identifier', 'rpbsid_identifier',
            ('--ros-args', '-p', 'checkpoint_file:={out}/state', '-p', 'checkpoint_period:=0.1'), 6.0, kept,
            fed=True),
    Program('payload_controller', 'payload_controller', (), 2.5),
    Program('payload_adapter', 'payload_adapter', ('--ros-args', '-p', 'target_node:=nobody'), 2.0),
    Program('demo', 'demo', ('{out}', '--duration', '3', '--capture-time', '1', '--rate', '500'), 14.0,
            demo),
    Program('simulate_bag', 'simulate_bag', ('{out}/bag', '--duration', '20'), 4.0,
            lambda folder, killed: recording(folder / 'bag', killed)),
    Program('identify_bag', 'identify_bag', ('{bag}', '--output', '{out}/estimates.csv'), 4.0, rows),
    Program('identify_bag to a bag', 'identify_bag', ('{bag}', '--output', '{out}/bag'), 4.0,
            lambda folder, killed: recording(folder / 'bag', True)),  # it holds no joint states
    Program('monte_carlo', 'monte_carlo',
            ('{scenario}', '--runs', '6', '--workers', '1', '--output', '{out}/study.csv'), 10.0, rows),
    Program('reproduce_paper', 'reproduce_paper', (
        '--runs', '1', '--case', 'payload_20', '--workers', '1', '--output', '{out}/paper'), 8.0),
    Program('write_urdf', 'write_urdf', (), 0.6),
    Program('live_view', 'live_view', ('--ros-args', '-p', 'port:=0'), 2.0),
    Program('live_view of a bag', 'live_view', ('{bag}', '--port', '0'), 4.0),
)


class Trial(NamedTuple):
    """One start and its end."""

    program: str
    signal: str
    delay_s: float
    code: int
    took_s: float
    finished: bool
    """It had ended before the signal."""
    early: bool
    """Python itself was still starting."""
    problem: str


def group(leader: int) -> list[int]:
    """Return the processes of a process group that still run."""
    found = []
    for entry in Path('/proc').iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / 'stat').read_text().rpartition(')')[2].split()
            except OSError:
                continue
            if int(fields[2]) == leader and fields[0] != 'Z':
                found.append(int(entry.name))
    return found


def attempt(program: Program, number: signal.Signals, delay: float, places: dict[str, str]) -> Trial:
    """Start a program, send the signal after a delay, look at what is left."""
    with tempfile.TemporaryDirectory() as folder:
        given = [text.format(out=folder, **places) for text in program.arguments]
        process = subprocess.Popen(
            [*command(program.module), *given], text=True, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, stdin=subprocess.DEVNULL, start_new_session=True,
            env={**os.environ, 'ROS_LOG_DIR': folder})
        try:
            process.wait(delay)
            finished = True
        except subprocess.TimeoutExpired:
            finished = False
        sent = time.monotonic()
        if not finished:
            process.send_signal(number)
        problem = []
        try:
            _, err = process.communicate(timeout=PATIENCE_S)
        except subprocess.TimeoutExpired:
            problem.append('it does not end')
            os.killpg(process.pid, signal.SIGKILL)
            _, err = process.communicate()
        took = time.monotonic() - sent
        orphans = gone(process.pid)
        if orphans:
            problem.append(f'{orphans} orphans')
            os.killpg(process.pid, signal.SIGKILL)
        killed = number == signal.SIGKILL
        allowed = {-number} if killed else {0, 128 + number, 130}
        loud = 'Traceback' in err or 'terminate called' in err
        # Python's own site.py has a function main too, which runs before ours
        interrupted = process.returncode == -number or (process.returncode == 1 and 'KeyboardInterrupt' in err)
        early = interrupted and not re.search(r'flexmanip_ros/.*, in main\n', err)
        if process.returncode not in allowed and not early and not finished:
            problem.append(f'exit code {process.returncode}')
        if loud and not early:
            problem.append('traceback: ' + ' '.join(err.split())[-160:])
        left = program.look(Path(folder), killed)
        if left:
            problem.append(left)
        return Trial(program.name, number.name, round(delay, 3), process.returncode, round(took, 3), finished,
                     early and not killed, '; '.join(problem))


def gone(leader: int) -> int:
    """Return how many of a group are left some time after its leader ended."""
    limit = time.monotonic() + 3.0
    while group(leader) and time.monotonic() < limit:
        time.sleep(0.05)
    return len(group(leader))


@contextmanager
def feeding(wanted: bool) -> Iterator[None]:
    """Have a plant and its torque run meanwhile."""
    names = ('plant_simulator', 'excitation') if wanted else ()
    feeders = [subprocess.Popen(
        [*command(name), '--ros-args', '-p', 'rate:=500.0'],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) for name in names]
    try:
        yield
    finally:
        for feeder in feeders:
            feeder.terminate()
            feeder.wait()


def inputs(folder: Path, seconds: int) -> dict[str, str]:
    """Make a recording and a scenario for the programs that read them; return where they are."""
    places = {'bag': str(folder / 'bag'), 'scenario': str(folder / 'scenario.yaml')}
    Path(places['scenario']).write_text(SCENARIO, encoding='utf-8')
    make = [*command('simulate_bag'), places['bag'], '--duration', str(seconds)]
    subprocess.run(make, check=True, stdout=subprocess.DEVNULL)
    return places


def delays(program: Program, runs: int, rng: random.Random) -> list[float]:
    """Return delays, one in each of as many equal parts of the program's life."""
    return [program.longest_s * (k + rng.random()) / runs for k in range(runs)]


def main() -> None:
    """Try every program; print a table and write JSON."""
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 8
    part = sys.argv[2] if len(sys.argv) > 2 else ''
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job would pass on "ignore"
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    os.environ['ROS_DOMAIN_ID'] = str(1 + os.getpid() % 100)
    os.environ['MPLBACKEND'] = 'Agg'
    rng = random.Random(1)
    trials = []
    with tempfile.TemporaryDirectory() as folder:
        places = inputs(Path(folder), seconds=20)
        for program in (item for item in PROGRAMS if part in item.name):
            with feeding(program.fed):
                for number in SIGNALS:
                    for delay in delays(program, runs, rng):
                        trials.append(attempt(program, number, delay, places))
                        if trials[-1].problem:
                            print(trials[-1], flush=True)
    print('| program | signal | tries | too early | ended before | exit codes | longest end s | problems |')
    print('|---|---|---|---|---|---|---|---|')
    for name, kind in dict.fromkeys((trial.program, trial.signal) for trial in trials):
        mine = [trial for trial in trials if (trial.program, trial.signal) == (name, kind)]
        codes = Counter(trial.code for trial in mine if not trial.finished and not trial.early)
        print(f'| {name} | {kind} | {len(mine)} | {sum(trial.early for trial in mine)} | '
              f'{sum(trial.finished for trial in mine)} | '
              f'{", ".join(f"{code}: {count}" for code, count in sorted(codes.items()))} | '
              f'{max(trial.took_s for trial in mine):.2f} | {sum(bool(trial.problem) for trial in mine)} |')
    tried = {trial.program for trial in trials}
    before = claims.read('ros_signals') or [] if part else []
    rows = [row for row in before if row['program'] not in tried] + [trial._asdict() for trial in trials]
    if rows:
        claims.write('ros_signals', rows)
    if any(trial.problem for trial in trials):
        sys.exit(1)


if __name__ == '__main__':
    main()
