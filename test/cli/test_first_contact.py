"""What somebody gets who gives identify_bag a recording and nothing else."""

from __future__ import annotations

import contextlib
import io
import json
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from recordings import START, record

from flexmanip_ros.cli import replay
from flexmanip_ros.cli.console import Report
from flexmanip_ros.cli.identify_bag import main
from flexmanip_ros.errors import ParameterError
from flexmanip_ros.io import bag
from flexmanip_ros.parameters import ExcitationParameters, IdentifierParameters, PlantParameters, configure
from flexmanip_ros.payload.capture_detection import watch, with_detected
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, EventKind, JointBlock, JointRecord

CAPTURE = CaptureEvent(START + 1_200_000_000, EventKind.CAPTURE)
PLANT = configure(PlantParameters, {'payload_mass': 20.0, 'snr_db': 40.0, 'noise': 'snr'})


def records(seconds: float = 1.7) -> list[JointRecord]:
    made = simulator.simulate(
        PLANT, excitation.sequence(ExcitationParameters(), round(seconds * PLANT.rate)), (CAPTURE,), START)
    return [item for item in simulator.records(made, ()) if isinstance(item, JointRecord)]


@pytest.fixture(scope='module')
def caught() -> list[JointRecord]:
    return records()


@pytest.fixture(scope='module')
def unannounced(caught: list[JointRecord], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp('bags') / 'unannounced', caught)


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    status = main([str(argument) for argument in arguments])
    seen = capsys.readouterr()
    return status, seen.out, seen.err


class Reported(NamedTuple):
    """How identify_bag with a report ended: its page, and what it printed."""

    page: str
    status: int
    out: str
    err: str


@pytest.fixture(scope='module')
def reported(unannounced: Path, tmp_path_factory: pytest.TempPathFactory) -> Reported:
    page, out, err = tmp_path_factory.mktemp('reported') / 'report.html', io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = main([str(unannounced), '--report', str(page)])
    return Reported(page.read_text(encoding='utf-8'), status, out.getvalue(), err.getvalue())


def test_a_capture_that_nobody_announced_is_found_and_its_payload_estimated(reported: Reported) -> None:
    _, status, out, err = reported
    assert (status, err) == (0, '')
    (at,) = re.findall(r'^events +found in the signals: capture at ([\d.]+) s$', out, re.MULTILINE)
    assert float(at) == pytest.approx(1.2, abs=0.02)
    assert 'TRACKING: tracking; the estimates can be used' in out
    (mass,) = re.findall(r'^payload +([\d.]+) kg, 95 % interval', out, re.MULTILINE)
    assert float(mass) == pytest.approx(20.0, rel=0.1)


def test_without_looking_the_payload_is_said_to_be_unknown_and_no_number_is_printed(
        unannounced: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, out, _ = run(capsys, unannounced, '--no-detect')
    assert 'none recorded, and not looked for (--no-detect)' in out
    (words,) = re.findall(r'^payload +(.*)$', out, re.MULTILINE)
    assert words.startswith('not known: ')
    assert 'kg' not in words


def test_an_arm_that_caught_nothing_is_said_to_be_empty(
        caught: list[JointRecord], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, out, _ = run(capsys, record(tmp_path / 'empty', caught[:1100]))
    assert 'none found in the signals, so the arm is taken as empty; give --capture-time' in out
    assert 'payload      none: the arm is taken as empty, 95 % interval 0 .. ' in out


def test_what_is_found_while_the_residuals_do_not_fit_is_called_a_guess(unannounced: Path) -> None:
    messages = replay.Messages(replay.Request(unannounced, IdentifierParameters()), Report())
    messages.first_ns = START
    messages._findings.events.append(CAPTURE)
    assert messages.search('TRACKING') == 'found in the signals: capture at 1.200 s'
    assert messages.search('INCONSISTENT').endswith('while the status is not TRACKING this is a guess')


def test_a_recording_too_short_to_tell_is_not_called_empty(
        caught: list[JointRecord], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, out, _ = run(capsys, record(tmp_path / 'short', caught[:300]))
    assert 'events       the signals cannot tell: ' in out


def test_where_events_are_announced_nobody_looks_unless_asked(
        caught: list[JointRecord], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    looked = []
    whole = with_detected

    def counted(*arguments):
        looked.append(arguments)
        return whole(*arguments)

    monkeypatch.setattr(replay.capture_detection, 'with_detected', counted)
    config, early = IdentifierParameters(), CaptureEvent(START + 200_000_000, EventKind.CAPTURE)
    short = record(tmp_path / 'short', [early, *caught[:400]])
    result = replay.identify(replay.Request(short, config))
    assert (looked, result.events) == ([], '')
    assert result.summary.capture_time_s == pytest.approx(0.2)
    place = record(tmp_path / 'announced', [CAPTURE, *caught])
    asked = replay.identify(replay.Request(place, config, detect=True))
    assert len(looked) == 1
    assert 'found in the signals' in asked.events
    assert asked.summary.capture_time_s == pytest.approx(1.2)  # the announced one stays
    given = replay.identify(replay.Request(short, config, bag.Topics(events=()), capture_time=0.2))
    assert (len(looked), given.events) == (1, '')


def test_a_topic_of_events_without_one_is_named(
        caught: list[JointRecord], tmp_path: Path) -> None:
    place = record(tmp_path / 'announced', [*caught[:300], CAPTURE])  # the event is in the part that is held out
    result = replay.identify(replay.Request(place, IdentifierParameters(), validate_from=0.25))
    assert result.events == 'none on /capture_event; --detect looks for them in the signals'


def test_configurations_that_are_held_out_do_not_count_as_seen(caught: list[JointRecord], tmp_path: Path) -> None:
    place, seen = record(tmp_path / 'bag', caught[:300]), []
    for limit in (None, 0.25):
        request = replay.Request(place, IdentifierParameters(), validate_from=limit, configurations='table.csv')
        messages = replay.Messages(request, Report())
        assert list(messages)
        seen.append(messages.angles_held(messages.signals()))
    assert len(seen[0]) == 300
    np.testing.assert_array_equal(seen[1], seen[0][:250])


@pytest.mark.parametrize(('parameters', 'words'), [
    ({'angles': ()}, 'captures cannot be found in the signals without angles'),
    ({'inputs': ('joint1/effort',)}, 'captures cannot be found in these signals'),
    ({'outputs': ('link1_bend/position', 'link2_bend/effort')}, 'captures cannot be found in these signals'),
    ({'payload_method': 'none'}, ''),
])
def test_signals_that_cannot_show_a_capture_end_nothing_unless_it_is_asked_for(
        caught: list[JointRecord], tmp_path: Path, parameters: dict[str, object], words: str) -> None:
    place = record(tmp_path / 'bag', caught[:300])
    config = configure(IdentifierParameters, parameters | {'order': 2, 'past_window': 6, 'future_window': 5})
    result = replay.identify(replay.Request(place, config))
    assert (words in result.events) if words else (result.events == '')
    assert result.summary.samples == 300
    if words:
        with pytest.raises(ParameterError, match=words):
            replay.identify(replay.Request(place, config, detect=True))


def test_blocks_reveal_the_events_of_single_messages_just_after_the_same_message(caught: list[JointRecord]) -> None:
    items: list[JointRecord] = [*caught[:600], *caught[650:]]  # a gap
    back = [record._replace(stamp_ns=record.stamp_ns - 5 * 10**9) for record in caught]  # then the clock is set back
    items += back
    fields = 'position', 'velocity', 'effort'
    blocks = [JointBlock(part[0].names, np.array([record.stamp_ns for record in part]),
                         *(np.array([getattr(record, name) for record in part]) for name in fields))
              for part in (items[k:k + 700] for k in range(0, len(items), 700))]

    def seen(given: list[JointBlock]) -> list[object]:
        out: list[object] = []
        for item in with_detected(watch(IdentifierParameters()), given):
            out += item.stamp_ns.tolist() if isinstance(item, JointBlock) else [item]
        return out

    single, together = seen([JointBlock.of(item) for item in items]), seen(blocks)
    assert single == together
    assert sum(isinstance(item, CaptureEvent) for item in single) == 2


def test_event_topics_of_a_recording_are_known_without_reading_it_also_where_it_is_damaged(
        caught: list[JointRecord], tmp_path: Path, unannounced: Path) -> None:
    assert bag.event_topics(unannounced) == ()
    assert bag.event_topics(tmp_path / 'nothing') == ()
    place = record(tmp_path / 'bag', [CAPTURE, *caught[:300]])
    assert bag.event_topics(place) == ('/capture_event',)
    (file,) = place.glob('*.mcap')
    file.write_bytes(file.read_bytes()[:-200])
    assert bag.event_topics(file) == ('/capture_event',)


def test_the_report_opens_with_the_answer_then_pictures_then_tables(reported: Reported) -> None:
    text = reported.page
    answer = text[text.index('Result</h2>'):text.index('<img')]
    assert re.search(r'Payload: [\d.]+ kg, 95 % interval [\d.]+ .. [\d.]+ kg, since 1\.2\d\d s', answer)
    assert 'found in the signals: capture at 1.2' in answer
    assert 'tracking; the estimates can be used' in answer
    assert len(re.findall(r'[\d.]+ &plusmn; [\d.]+ Hz', answer)) == 2
    assert text.rindex('<img') < text.index('<table')


def test_json_stays_the_last_line_and_has_the_time_of_the_capture_that_was_found(
        unannounced: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, out, _ = run(capsys, unannounced, '--json')
    assert json.loads(out.splitlines()[-1])['capture_time_s'] == pytest.approx(1.2, abs=0.02)
