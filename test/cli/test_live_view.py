"""The program live_view with a recording, called as a user calls it; and the recording inside a report."""

from __future__ import annotations

import base64
import html
import json
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np
import pytest
from browser import Browser
from recordings import START, record

from flexmanip_ros.cli import identify_bag, live_view
from flexmanip_ros.cli.console import Report
from flexmanip_ros.cli.replay import Request
from flexmanip_ros.errors import BagError
from flexmanip_ros.io import bag
from flexmanip_ros.parameters import ExcitationParameters, IdentifierParameters, PlantParameters
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, EventKind, JointBlock, JointRecord
from flexmanip_ros.view.screen import Screen, of_identifier

COUNT = 3000
WITHOUT_ROS = """
import sys
class Block:
    def find_spec(self, name, path=None, target=None):
        if name.split('.')[0] in ('rclpy', 'sensor_msgs', 'std_msgs', 'matplotlib'):
            raise ModuleNotFoundError(f'{name} is blocked here', name=name)
sys.meta_path.insert(0, Block())
from flexmanip_ros.cli.live_view import main
sys.exit(main())
"""


@pytest.fixture(scope='module')
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The simulated arm catches 20 kg after 1.5 s."""
    path = tmp_path_factory.mktemp('live_view') / 'caught'
    event = CaptureEvent(START + 1_500_000_000, EventKind.CAPTURE)
    run = simulator.simulate(PlantParameters(), excitation.sequence(ExcitationParameters(), COUNT), (event,), START)
    return record(path, [event, *(item for item in simulator.records(run) if isinstance(item, JointRecord))])


@pytest.fixture(scope='module')
def playing(recording: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    process = subprocess.Popen([sys.executable, '-c', WITHOUT_ROS, str(recording), '--port', '0', '--speed', '2'],
                               stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    line = process.stdout.readline()
    found = re.search(r'http://127\.0\.0\.1:\d+/', line)
    assert found, process.communicate(timeout=20)
    yield process, found[0]
    process.kill()
    process.communicate(timeout=20)


def shown(page: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return layout and recording inside a page."""
    found = [json.loads(re.findall(rf'<script id="{name}" type="application/json">(.*?)</script>', page)[0])
             for name in ('layout', 'recording')]
    return found[0], found[1]


def rows(frame: dict[str, Any], layout: dict[str, Any]) -> Any:
    return np.frombuffer(base64.b64decode(frame['samples']['data']), '<f4').reshape(-1, 1 + layout['columns'])


def test_a_page_holds_the_recording_and_what_is_identified_without_ros(
        playing: tuple[subprocess.Popen[str], str]) -> None:
    layout, frame = shown(urlopen(playing[1], timeout=10).read().decode())
    assert layout['speed'] == 2
    assert len(rows(frame, layout)) == COUNT
    assert frame['events'] == [[1.5, True]]
    _, status, mass, std, low, high, _ = frame['payloads'][-1]
    assert layout['statuses'][status][0] == 'TRACKING'
    assert low < 20.0 < high
    assert abs(mass - 20.0) < 4.0 * std
    assert frame['models']


def test_without_a_recording_it_says_that_ros_is_needed() -> None:
    done = subprocess.run([sys.executable, '-c', WITHOUT_ROS], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout) == (2, '')
    assert 'is not installed; install ROS, or give a recording' in done.stderr
    assert done.stderr.count('\n') == 1


def test_of_a_damaged_recording_everything_before_the_damage_is_shown(
        recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = bag.read_blocks

    def damaged(*arguments: Any) -> Iterator[JointBlock | CaptureEvent]:
        for count, item in enumerate(whole(*arguments)):
            if count == 2:
                raise BagError('it ends here', 'record again')
            yield item

    monkeypatch.setattr(bag, 'read_blocks', damaged)
    config = IdentifierParameters()
    screen = Screen(of_identifier(config, 'damaged'))
    assert 'it ends here' in str(live_view.read(Request(recording, config), screen, Report()))
    assert screen.frame()['samples']
    with pytest.raises(BagError, match='does not exist'):
        live_view.read(Request('nowhere', config), Screen(screen.source), Report())


def test_a_browser_plays_it(playing: tuple[subprocess.Popen[str], str], tmp_path: Path) -> None:
    browser = Browser(tmp_path / 'profile')
    try:
        browser.open(playing[1])
        browser.wait("document.getElementById('pause').innerText === 'Play'")  # the end was reached
        assert browser.text('where') == 'caught · 3.00 s of 3.00 s'
        assert browser.text('status').startswith('TRACKING')
        assert re.match(r'(19\.\d+|20\.\d+) kg\n95 %: ', browser.text('mass'))
        assert browser.text('alarm') == ''
        seek = "const bar = document.getElementById('playhead'); bar.value = {}; bar.oninput(); draw()"
        browser.value(f'(() => {{ {seek.format(1.4)} }})()')
        assert browser.text('where') == 'caught · 1.40 s of 3.00 s'
        assert browser.text('mass').startswith('0.0')
        # Some recordings begin with intervals of hundreds of kilograms; the scale is that of the settled ones.
        wide = 'row => row.time >= 1.5 && row.time < 1.9'
        assert browser.value(f'payloads.filter({wide}).map(row => [row.low, row.high] = [0, 755]).length') == 20
        browser.value(f'(() => {{ {seek.format(3)} }})()')
        low, high = browser.value('[scales.payload.low, scales.payload.high]')
        assert -5.0 < low <= 0.0
        assert 20.0 < high < 40.0
        browser.value(f'(() => {{ payloads.forEach(row => {{ row.high = 755; }}); {seek.format(3)} }})()')
        assert browser.value('scales.payload.high') > 755.0  # one that stays wide is shown as wide as it is
        assert browser.complaints == []
    finally:
        browser.close()


def test_an_interrupt_ends_it_with_code_0(playing: tuple[subprocess.Popen[str], str]) -> None:
    process, _ = playing
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=20)
    assert (process.returncode, err) == (0, '')


@pytest.mark.parametrize(('arguments', 'said'), [
    (['no_such_bag'], "bag 'no_such_bag' does not exist"),
    (['bag', '--speed', '0'], "'0' is no speed"),
    (['bag', '--speed', 'fast'], "'fast' is no speed"),
    (['bag', '--port', '70000'], '70000 is more than 65535'),
    (['--speed', '2'], 'no recording is given'),
])
def test_bad_input_is_told_in_one_line_with_code_2(
        arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        code = live_view.main(arguments)
    except SystemExit as left:
        code = int(left.code or 0)
    err = capsys.readouterr().err
    assert code == 2
    assert said in err
    assert err.count('\n') == 1


def test_the_report_of_a_looped_recording_shows_the_last_pass_alone(recording: Path, tmp_path: Path) -> None:
    pytest.importorskip('matplotlib')
    messages = list(bag.read(recording))[:600]  # the capture is later: one pass and another are all that counts
    record(tmp_path / 'looped', [*messages, *messages])
    path = tmp_path / 'report.html'
    assert identify_bag.main([str(tmp_path / 'looped'), '--report', str(path)]) == 0
    (inner,) = re.findall(r'<iframe title="[^"]+" srcdoc="([^"]*)"></iframe>', path.read_text(encoding='utf-8'))
    _, frame = shown(html.unescape(inner))
    times = [row[0] for row in frame['payloads']]
    assert len(times) > 10
    assert times == sorted(set(times))


def test_the_report_of_identify_bag_plays_the_recording(recording: Path, tmp_path: Path) -> None:
    pytest.importorskip('matplotlib')
    path, count = tmp_path / 'report.html', 2000
    short = record(tmp_path / 'caught', list(bag.read(recording))[:1 + count])  # the event comes first
    assert identify_bag.main([str(short), '--report', str(path)]) == 0
    (inner,) = re.findall(r'<iframe title="[^"]+" srcdoc="([^"]*)"></iframe>', path.read_text(encoding='utf-8'))
    layout, frame = shown(html.unescape(inner))
    assert not layout['playing']
    assert len(rows(frame, layout)) == count
    assert frame['events'] == [[1.5, True]]
    assert layout['statuses'][frame['payloads'][-1][1]][0] == 'TRACKING'
    assert frame['payloads'][-1][2] == pytest.approx(20.0, abs=1.0)
    browser = Browser(tmp_path / 'profile')
    try:
        browser.open(path.as_uri())
        within = "document.querySelector('iframe').contentWindow.document.getElementById('{}').innerText"
        browser.wait(within.format('status') + ".startsWith('TRACKING')")
        assert browser.value(within.format('where')) == 'caught · 2.00 s of 2.00 s'
        assert browser.complaints == []
    finally:
        browser.close()
