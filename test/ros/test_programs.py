"""The nodes and the demonstration as programs: what a shell sees."""

from __future__ import annotations

import base64
import errno
import importlib
import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from unittest.mock import Mock
from urllib.error import URLError
from urllib.request import urlopen

import pytest
from rich.console import Console
from rosbags.interfaces import QosDurability
from rosbags.rosbag2 import Reader

from flexmanip_ros import messages
from flexmanip_ros.errors import BagError, ParameterError
from flexmanip_ros.io import bag
from flexmanip_ros.ros.composition import DRAIN_TIMEOUT_S
from flexmanip_ros.types import CaptureEvent, EventKind, JointRecord

NODES = ('plant_simulator', 'excitation', 'capture_trigger', 'rpbsid_identifier', 'live_view')


def module(name: str) -> str:
    return 'flexmanip_ros.ros.demo' if name == 'demo' else f'flexmanip_ros.ros.nodes.{name}'


DOMAIN = str(1 + (os.getpid() + 50) % 100)


def start(name: str, *arguments: str) -> subprocess.Popen[str]:
    environment = {**os.environ, 'ROS_DOMAIN_ID': DOMAIN, 'MPLBACKEND': 'Agg'}
    return subprocess.Popen(
        [sys.executable, '-m', module(name), *arguments], env=environment, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def run(name: str, *arguments: str, timeout: float = 60.0) -> tuple[int, str, str]:
    process = start(name, *arguments)
    out, err = process.communicate(timeout=timeout)
    return process.returncode, out, err


@pytest.fixture
def signals() -> Iterator[None]:
    """Give the test run its signal handlers back."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def alone(signals: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep a demonstration in this process to a domain of its own."""
    monkeypatch.setenv('ROS_DOMAIN_ID', DOMAIN)


def call(name: str, *arguments: str) -> int:
    """Run the main function of a program in this process."""
    main = importlib.import_module(module(name)).main
    try:
        return int(main([name, *arguments]))
    except SystemExit as left:
        return int(left.code or 0)


@pytest.mark.parametrize('name', [*NODES, 'demo'])
def test_help_says_what_it_is_with_its_parameters(
        name: str, signals: None, capsys: pytest.CaptureFixture[str]) -> None:
    assert call(name, '--help') == 0
    out, err = capsys.readouterr()
    assert err == ''
    assert name in out
    assert 'default' in out if name == 'demo' else 'parameters:' in out


@pytest.mark.parametrize(('name', 'arguments', 'said'), [
    ('capture_trigger', ['--ros-args', '-p', 'mode:=magic'], 'choose one of service, time, auto'),
    ('excitation', ['--ros-args', '-p', 'amplitud:=[1.0, 1.0]'], "did you mean 'amplitude'?"),
    ('plant_simulator', ['--ros-args', '--params-file', 'nowhere.yaml'],
     "plant_simulator: parameter file 'nowhere.yaml' does not exist; check the path"),
    ('plant_simulator', ['--ros-args', '--foo'], "unknown ROS arguments ['--foo']; after --ros-args give -p"),
    ('plant_simulator', ['--ros-args', '-p', 'arm.link_length:=[1, 2.0]'], 'each number with a point such as 1.0'),
    ('rpbsid_identifier', ['--ros-args', '-p', 'future_window:=30'], 'cannot exceed past_window (10)'),
    ('rpbsid_identifier', ['--nonsense'], 'unrecognized arguments: --nonsense'),
    ('capture_trigger', ['--ros-args', '-p', 'qos_overrides./joint_states.subscription.reliability:=magic'],
     "qos_overrides of 'joint_states'"),
    ('live_view', ['--ros-args', '-p', 'window:=7'], 'window'),
    ('demo', ['--capture-time', '7'], "'capture_time' is 7 s; it must come before the end"),
    ('demo', ['--duration', 'long'], 'invalid float value'),
])
def test_bad_input_ends_with_one_clear_line_and_code_2(
        name: str, arguments: list[str], said: str, signals: None, capfd: pytest.CaptureFixture[str]) -> None:
    assert call(name, *arguments) == 2
    err = capfd.readouterr().err
    assert said in err
    assert 'usage:' not in err
    assert 'Traceback' not in err


@pytest.mark.parametrize(('text', 'said'), [
    ('plant_simulator:\n  ros__parameters:\n\trate: 100.0\n', "' is not valid YAML in line 3: found character '\\t'"),
    ('/**: {ros__parameters: {arm: {link_length: [1, 2.0]}}}', 'write [1.0, 2.0]'),
])
def test_a_parameter_file_that_ros_cannot_read_is_named_with_what_is_wrong(
        text: str, said: str, tmp_path: Path, signals: None, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / 'plant.yaml').write_text(text, encoding='utf-8')
    assert call('plant_simulator', '--ros-args', '--params-file', str(tmp_path / 'plant.yaml')) == 2
    (line,) = (line for line in capfd.readouterr().err.splitlines() if line.startswith('plant_simulator: '))
    assert f"parameter file '{tmp_path / 'plant.yaml'}" in line
    assert said in line


def test_a_process_says_it_too() -> None:
    code, out, err = run('capture_trigger', '--ros-args', '-p', 'lead_tim:=1.0')
    assert (code, out) == (2, '')
    assert err == "capture_trigger: unknown parameter 'lead_tim'; did you mean 'lead_time'?\n"


def test_a_node_works_without_stderr() -> None:
    shell = f'timeout --preserve-status --signal INT 5 "$0" -m {module("capture_trigger")} 2>&-'
    assert subprocess.run(['sh', '-c', shell, sys.executable], check=False).returncode == 0


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_node_cleanly(number: int) -> None:
    process = start('capture_trigger', '--ros-args', '-p', 'mode:=time', '--log-level', 'debug')
    assert process.stderr is not None
    for line in process.stderr:  # debug output begins when the node is up
        if 'capture_trigger' in line or 'rcl' in line:
            break
    time.sleep(1.0)  # in the executor by now; earlier is fine too, and tried by the demonstration's test
    process.send_signal(number)
    deadline = time.monotonic() + 20.0
    while process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
        process.send_signal(number)  # launch sends one, the terminal another: none may cut the end short
    _, err = process.communicate(timeout=20)
    assert process.returncode == 0
    assert 'Traceback' not in err


def test_the_demonstration_is_seen_live_recorded_drawn_and_replayed_bit_for_bit(tmp_path: Path) -> None:
    process = start('demo', str(tmp_path / 'out'), '--view', '--duration', '2', '--capture-time', '1', '--rate', '500',
                    '--ros-args', '-p', 'live_view:port:=0')
    assert process.stdout is not None
    url = next(word for line in process.stdout for word in line.split() if word.startswith('http://'))
    samples, events = 0, []
    with urlopen(url + 'events', timeout=60) as stream:
        for line in stream:
            if line.startswith(b'data: {') and not events:
                frame = json.loads(line[6:])
                samples += len(base64.b64decode(frame.get('samples', {'data': ''})['data'])) // 28
                events += frame.get('events', [])
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, out + err
    assert 'bit for bit' in out
    assert '0 lost' in out
    assert samples > 100
    assert events == [[1.0, True]]
    with pytest.raises(URLError):  # it ended with the demonstration
        urlopen(url, timeout=5)
    folder = tmp_path / 'out' / 'run_001'
    items = list(bag.read(folder / 'bag'))
    recorded = [item for item in items if isinstance(item, JointRecord)]
    (event,) = (item for item in items if isinstance(item, CaptureEvent))
    assert len(recorded) >= 1000
    assert {b.stamp_ns - a.stamp_ns for a, b in pairwise(recorded)} == {2_000_000}
    assert event == CaptureEvent(recorded[0].stamp_ns + 1_000_000_000, EventKind.CAPTURE)
    assert (folder / 'overview.png').stat().st_size > 20_000


def test_a_demonstration_with_lost_samples_ends_at_once_and_records_what_was_offered(
        tmp_path: Path, alone: None, capfd: pytest.CaptureFixture[str]) -> None:
    began = time.monotonic()
    code = call('demo', str(tmp_path), '--duration', '1', '--capture-time', '0.5', '--rate', '500',
                '--ros-args', '-p', 'plant_simulator:sensors.drop_probability:=0.2')
    assert code == 0, capfd.readouterr()
    assert time.monotonic() - began < DRAIN_TIMEOUT_S
    with Reader(tmp_path / 'run_001' / 'bag') as reader:
        latched = {item.topic.rpartition('/')[2]: item.ext.offered_qos_profiles[0].durability ==
                   QosDurability.TRANSIENT_LOCAL for item in reader.connections}
    assert {'model', 'payload', 'payload_estimate', 'status', 'modes'} <= latched.keys()
    assert latched == {name: name == 'capture_event' or name in messages.LATCHED for name in latched}


def test_a_demonstration_whose_plant_fails_ends_with_the_reason(
        tmp_path: Path, alone: None, capfd: pytest.CaptureFixture[str]) -> None:
    assert call('demo', str(tmp_path), '--ros-args', '-p', 'excitation:amplitude:=[1.0e7, 1.0e7]') == 1
    assert capfd.readouterr().err.splitlines()[-1].startswith('demo: the simulation diverged')


def test_an_interrupted_demonstration_leaves_a_readable_bag(tmp_path: Path) -> None:
    process = start('demo', str(tmp_path), '--duration', '60', '--rate', '500',
                    '--ros-args', '-p', 'rpbsid_identifier:payload_method:=none')
    assert process.stdout is not None
    for line in process.stdout:
        if ' / 60.0 s' in line:
            break
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=30)
    assert process.returncode == 128 + signal.SIGINT, out + err
    assert 'interrupted' in out
    assert 'Traceback' not in err
    assert sum(isinstance(item, JointRecord) for item in bag.read(tmp_path / 'run_001' / 'bag')) > 100


@pytest.mark.parametrize(('error', 'code', 'said'), [
    (KeyboardInterrupt(), 130, 'interrupted\n'),  # no bag was begun
    (OSError(errno.ENOSPC, 'No space left on device'), 1, 'demo: No space left on device; what was written before'),
])
def test_a_demonstration_that_ends_early_says_why_and_what_there_is(
        tmp_path: Path, signals: None, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str],
        error: BaseException, code: int, said: str) -> None:
    from flexmanip_ros.ros import demo

    monkeypatch.setattr(demo, '_init', lambda *_: None)
    monkeypatch.setattr(demo, '_run', Mock(side_effect=error))
    assert call('demo', str(tmp_path)) == code
    assert said in ''.join(capfd.readouterr())


@pytest.mark.parametrize('number', [1033, 1049, 1099, 7])
def test_a_demonstration_looks_for_a_free_domain_on_nine_others(
        monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    from flexmanip_ros.ros import demo

    tried: list[int | None] = []
    monkeypatch.setattr(demo.rclpy, 'init', lambda domain_id, **_: tried.append(domain_id))
    monkeypatch.setattr(demo.rclpy, 'shutdown', lambda: None)
    monkeypatch.setattr(demo, '_occupied', lambda: True)
    monkeypatch.setattr(demo.os, 'getpid', lambda: number)
    with pytest.raises(ParameterError, match='no free ROS domain'):
        demo._init([], Console())
    assert tried[0] is None
    assert len(set(tried)) == 10
    assert all(1 <= domain <= 100 for domain in tried[1:] if domain is not None)


def test_runs_never_share_a_folder(tmp_path: Path) -> None:
    from flexmanip_ros.ros.demo import new_folder

    (tmp_path / 'run_007').mkdir()
    assert [new_folder(tmp_path).name, new_folder(tmp_path).name] == ['run_008', 'run_009']


def test_a_full_disk_ends_the_recording_with_the_reason_and_keeps_what_was_written(tmp_path: Path) -> None:
    environment = {**os.environ, 'ROS_DOMAIN_ID': DOMAIN}
    limit = 120_000  # bytes a file may have; the real error of a real write

    def small_files() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    process = subprocess.run(
        [sys.executable, '-m', 'flexmanip_ros.ros.demo', str(tmp_path), '--duration', '1',
         '--capture-time', '0.5', '--rate', '500', '--ros-args', '-p', 'rpbsid_identifier:payload_method:=none'],
        env=environment, text=True, capture_output=True, timeout=120, preexec_fn=small_files, check=False)
    assert process.returncode == 1, process.stdout + process.stderr
    assert 'free some space' in process.stdout
    assert 'Traceback' not in process.stderr
    kept: list[object] = []
    with pytest.raises(BagError):
        kept.extend(bag.read(tmp_path / 'run_001' / 'bag'))
    assert len(kept) > 100
