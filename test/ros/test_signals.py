"""A signal at any moment: a few moments here, every program at many in ``benchmarks/ros_signals.py``."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / 'benchmarks'))

import ros_signals

INT, TERM, KILL = ros_signals.SIGNALS
SHORT = """
name: signals
duration: 0.6
capture_time: 0.3
window: [0.5, 0.6]
"""
"""A study whose runs take a second: one that is under way is ended before its program."""


@pytest.fixture(scope='module')
def places(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Return a recording and a scenario for the programs that read them."""
    found = ros_signals.inputs(tmp_path_factory.mktemp('inputs'), seconds=5)
    Path(found['scenario']).write_text(SHORT, encoding='utf-8')
    return found


@pytest.fixture(autouse=True)
def interrupts(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Let Ctrl-C through to what is started, though the tests may run in the background."""
    monkeypatch.setenv('ROS_DOMAIN_ID', str(1 + (os.getpid() + 70) % 100))
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(('name', 'number', 'delay'), [
    ('plant_simulator', INT, 0.4),  # modules are imported
    ('plant_simulator', TERM, 2.5),
    ('rpbsid_identifier', INT, 1.2),  # kernels are loaded
    ('rpbsid_identifier', TERM, 3.5),
    ('rpbsid_identifier', KILL, 3.5),
    ('payload_controller', INT, 1.2),
    ('payload_adapter', TERM, 1.2),
    ('simulate_bag', INT, 1.4),
    ('simulate_bag', KILL, 1.4),
    ('identify_bag', TERM, 1.2),
    ('identify_bag to a bag', INT, 1.4),
    ('monte_carlo', TERM, 2.5),
    ('monte_carlo', KILL, 2.5),
])
def test_a_signal_ends_a_program_cleanly_and_leaves_whole_files(
        name: str, number: signal.Signals, delay: float, places: dict[str, str]) -> None:
    (program,) = (item for item in ros_signals.PROGRAMS if item.name == name)
    trial = ros_signals.attempt(program, number, delay, places)
    assert trial.problem == ''
    assert trial.took_s < 20.0


@pytest.mark.parametrize('moment', ['rclpy.init', 'flexmanip_ros.cli.console.parser', 'rclpy.node.Node.__init__'])
def test_a_signal_while_a_node_starts_ends_it_as_any_other(moment: str) -> None:
    where, _, name = moment.rpartition('.')
    owner = where if where != 'rclpy.node.Node' else 'rclpy.node'
    holder = owner if where == owner else 'rclpy.node.Node'
    begin = (f'import os, signal, sys, {owner}, flexmanip_ros.ros.nodes.excitation as node\n'
             f'before = {holder}.{name}\n'
             'def interrupted(*given, **named):\n'
             '    os.kill(os.getpid(), signal.SIGINT)\n'
             '    return before(*given, **named)\n'
             f'{holder}.{name} = interrupted\n'
             'sys.exit(node.main([]))')
    ended = subprocess.run([sys.executable, '-c', begin], text=True, capture_output=True, timeout=60.0)
    assert (ended.returncode, ended.stderr) == (0, '')


def test_a_signal_that_a_callback_from_c_loses_ends_a_node_that_compiles_for_long() -> None:
    begin = ('import contextlib, os, signal, sys, time, flexmanip_ros.ros.nodes.excitation as node\n'
             'def start(self):\n'
             '    with contextlib.suppress(KeyboardInterrupt):\n'
             '        os.kill(os.getpid(), signal.SIGINT)\n'
             '        time.sleep(1000.0)\n'
             '    time.sleep(1000.0)\n'
             'node.Excitation.start = start\n'
             'sys.exit(node.main([]))')
    ended = subprocess.run([sys.executable, '-c', begin], text=True, capture_output=True, timeout=100.0)
    assert ended.returncode == 0
    assert 'Traceback' not in ended.stderr
