"""identify_bag on recordings and arguments of clumsy users: one line, never a crash or a confident number."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from recordings import NAMES, START, record
from rosbags.rosbag2 import Reader

from flexmanip_ros.cli import monte_carlo, replay, reproduce_paper, simulate_bag, write_urdf
from flexmanip_ros.cli.identify_bag import main
from flexmanip_ros.errors import FlexmanipError
from flexmanip_ros.io import cdr
from flexmanip_ros.io.bag_writer import BagWriter
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.types import CaptureEvent, EventKind, JointRecord

MS = 1_000_000
PLAIN = '--set=payload_method=none'


def _records(count: int = 300, names: tuple[str, ...] = NAMES) -> list[JointRecord]:
    rng = np.random.default_rng(5)
    return [JointRecord(START + k * MS, names, *rng.normal(size=(3, 4))) for k in range(count)]


def _still(count: int, level: float) -> list[JointRecord]:
    values = level * np.array([0.3, 0.2, 0.01, 0.02])
    return [JointRecord(START + k * MS, NAMES, values, values, values) for k in range(count)]


def _bag(path: Path, records: list[JointRecord], *events: CaptureEvent, at: int = 0) -> Path:
    return record(path, [*records[:at], *events, *records[at:]])


def _run(capsys, *arguments: object) -> tuple[int, dict, str]:
    status = main([*(str(argument) for argument in arguments), '--json'])
    seen = capsys.readouterr()
    assert seen.err.count('\n') <= 1
    found = json.loads(seen.out.splitlines()[-1], parse_constant=pytest.fail) if seen.out else {}
    return status, found, seen.err


@pytest.mark.parametrize('level', [0.0, 1.0, -1e9, 1e-12])
@pytest.mark.parametrize('settings', [[], ['--set=estimator=paper'], ['--set=forgetting=constant']])
def test_signals_that_stand_still_are_never_tracking(capsys, tmp_path, level, settings):
    path = _bag(tmp_path / 'bag', _still(700, level))
    status, found, err = _run(capsys, path, PLAIN, *settings)
    assert (status, err) == (0, '')
    assert found['status'] == 'POORLY_EXCITED'
    assert found['frequencies_hz'] == []


def test_messages_that_lose_a_signal_on_the_way_are_reported_with_their_number(capsys, tmp_path):
    records = _records()
    short = [JointRecord(r.stamp_ns, r.names, r.position, np.empty(0), r.effort) for r in records]
    status, found, err = _run(capsys, _bag(tmp_path / 'bag', records[:200] + short[200:]), PLAIN)
    assert status == 0
    assert found['samples'] == 200
    assert 'of 300 messages 100 without a configured signal were left out' in err


def test_messages_out_of_order_are_reported_with_their_number(capsys, tmp_path):
    records = _records()
    swapped = [records[k ^ 1] for k in range(len(records))]
    _, _, err = _run(capsys, _bag(tmp_path / 'bag', swapped), PLAIN)
    assert '150 with a stamp older than the one before' in err
    twice = [record for record in records for _ in (0, 1)]
    _, found, err = _run(capsys, _bag(tmp_path / 'twice', twice), PLAIN)
    assert found['samples'] == 300
    assert '300 with the stamp of the one before' in err


@pytest.mark.parametrize('unit', [1000, 1_000_000])
@pytest.mark.parametrize('count', [10, 300])
def test_stamps_in_microseconds_or_milliseconds_are_an_error(capsys, tmp_path, unit, count):
    short = [record._replace(stamp_ns=START + (record.stamp_ns - START) // unit) for record in _records(count)]
    status, found, err = _run(capsys, _bag(tmp_path / 'bag', short), PLAIN)
    assert (status, found) == (2, {})
    assert err == ('identify_bag: header stamps are less than 50 microseconds apart; make the publisher fill in '
                   'header.stamp in seconds and nanoseconds\n')


def test_a_looped_recording_says_that_the_last_pass_counts(capsys, tmp_path):
    records = _records(1200)
    _, _, err = _run(capsys, _bag(tmp_path / 'bag', records + records), PLAIN)
    assert 'the stamps jumped back' in err


def test_a_joint_that_is_not_there_is_an_error_also_among_the_default_outputs(capsys, tmp_path):
    path = _bag(tmp_path / 'bag', _records(names=('joint1', 'joint2', 'link1_bend', 'link2_strain')))
    status, found, err = _run(capsys, path)
    assert (status, found) == (2, {})
    assert "'link2_bend/position'" in err
    assert 'link2_strain' in err


def test_a_capture_after_the_end_is_not_claimed(capsys, tmp_path):
    event = CaptureEvent(START + 400 * MS, EventKind.CAPTURE)
    status, found, err = _run(capsys, _bag(tmp_path / 'bag', _records(), event), PLAIN)
    assert status == 0
    assert found['capture_time_s'] is None
    assert 'not applied' in err


def test_a_given_capture_after_the_recorded_one_is_the_last(capsys, tmp_path):
    path = _bag(tmp_path / 'bag', _records(700), CaptureEvent(START + 300 * MS, EventKind.CAPTURE),
                CaptureEvent(START + 500 * MS, EventKind.RELEASE), at=250)
    status, found, err = _run(capsys, path, PLAIN, '--capture-time', 0.65)
    assert (status, err) == (0, '')
    assert (found['capture_time_s'], found['release_time_s']) == (0.65, 0.5)
    assert _run(capsys, path, PLAIN, '--capture-time', 0.25)[1]['capture_time_s'] == 0.25  # near 0.3, it is that one


@pytest.mark.parametrize(('stamps_ms', 'words'), [
    ([300, 300], ''), ([300, 450], ''), ([300, 360], 'the capture at 0.360 s was taken for the one at 0.300 s, as '
     'event_merge_time is 0.1 s: lower event_merge_time if it is another capture'),
    ([300, 360, 380], 'event_merge_time is 0.1 s (so were 1 more)')])
def test_a_capture_soon_after_another_of_the_same_topic_is_said_to_count_as_that_one(
        capsys, tmp_path, stamps_ms, words):
    path = _bag(tmp_path / 'bag', _records(700), *(CaptureEvent(START + at * MS, EventKind.CAPTURE)
                                                  for at in stamps_ms), at=250)
    status, _, err = _run(capsys, path, PLAIN)
    assert status == 0
    assert words in err
    assert bool(words) == bool(err)


def test_a_capture_that_is_commanded_and_detected_is_one_without_a_word(capsys, tmp_path):
    with BagWriter(tmp_path / 'bag', flush_period=None) as writer:
        for k, item in enumerate(_records(700)):
            writer.write('/joint_states', START + k * MS, item)
            if k in (300, 340):
                topic = '/capture_event' if k == 300 else '/capture_detected'
                writer.write(topic, START + k * MS, CaptureEvent(item.stamp_ns, EventKind.CAPTURE))
    status, found, err = _run(capsys, tmp_path / 'bag', PLAIN)
    assert (status, found['capture_time_s'], err) == (0, 0.3, '')


def test_an_event_without_a_stamp_is_applied_on_arrival_and_reported(capsys, tmp_path):
    status, _, err = _run(capsys, _bag(tmp_path / 'bag', _records(700), CaptureEvent(0, EventKind.CAPTURE),
                                       at=600), PLAIN)
    assert status == 0
    assert '1 event arrived more than rewind_time after its stamp' in err


@pytest.mark.parametrize(('at', 'kind'), [(0, EventKind.CAPTURE), (600, EventKind.RELEASE)],
                         ids=['latched', 'in the middle'])
def test_an_event_stamped_long_before_the_recording_is_reported_with_what_to_do(capsys, tmp_path, kind, at):
    path = _bag(tmp_path / 'bag', _records(700), CaptureEvent(0, kind), at=at)
    page = tmp_path / 'report.html'
    status, found, err = _run(capsys, path, PLAIN, '--report', page)
    assert status == 0
    assert found[f'{kind.value}_time_s'] == -START / 1e9
    words = (f'the stamp of a {kind.value} is 0.000000, 1700000000 s before the first sample: stamp an event with the '
             f'time of its samples, or give --{kind.value}-time')
    assert words in err
    assert words in page.read_text(encoding='utf-8')
    assert main([str(path), PLAIN]) == 0
    assert 'at -1700000000.000 s, before the first sample' in capsys.readouterr().out


def test_a_capture_before_the_recording_is_no_mistake_where_it_is_given_or_seconds_old(capsys, tmp_path):
    path = _bag(tmp_path / 'bag', _records(700), CaptureEvent(START - 5000 * MS, EventKind.CAPTURE))
    assert _run(capsys, path, PLAIN)[2] == ''
    status, found, err = _run(capsys, _bag(tmp_path / 'other', _records(700)), PLAIN, '--capture-time=-3600')
    assert (status, found['capture_time_s'], err) == (0, -3600.0, '')


@pytest.mark.parametrize('option', ['--validate-from', '--capture-time', '--release-time'])
@pytest.mark.parametrize('value', ['nan', 'inf', '-inf', '1e300', 'soon', ''])
def test_a_time_that_is_none_is_one_line_and_exit_2(capsys, tmp_path, option, value):
    with pytest.raises(SystemExit) as ended:
        main([str(tmp_path), f'{option}={value}'])
    assert ended.value.code == 2
    err = capsys.readouterr().err
    assert f"'{value}' is not a time in seconds" in err
    assert err.count('\n') == 1


def test_simulate_bag_wants_times_too(capsys, tmp_path):
    with pytest.raises(SystemExit) as ended:
        simulate_bag.main([str(tmp_path / 'bag'), '--capture-time=nan'])
    assert ended.value.code == 2
    assert 'not a time' in capsys.readouterr().err


@pytest.mark.parametrize('value', ['.inf', '-.inf', '.nan'])
def test_a_parameter_that_is_not_finite_is_rejected(capsys, tmp_path, value):
    status, _, err = _run(capsys, tmp_path, '--set', f'arm.link_length=[{value}, 3.0]')
    assert status == 2
    assert "'arm.link_length'" in err


def test_an_event_topic_asked_for_by_name_must_be_there(capsys, tmp_path):
    path = _bag(tmp_path / 'bag', _records(), CaptureEvent(START + 100 * MS, EventKind.CAPTURE))
    status, found, err = _run(capsys, path, PLAIN, '--capture-event', '/capture_evnt')
    assert (status, found) == (2, {})
    assert "no topic '/capture_evnt'; the event topics there are: /capture_event" in err


def test_messages_of_another_publisher_are_missed_by_nobody(capsys, tmp_path):
    grip = [JointRecord(START + k * MS + 1, ('finger',), *np.zeros((3, 1))) for k in range(300)]
    both = [record for pair in zip(_records(), grip, strict=True) for record in pair]
    assert _run(capsys, _bag(tmp_path / 'bag', both), PLAIN)[2] == ''


@pytest.mark.parametrize('option', ['--output', '--report'])
def test_a_name_too_long_is_said_before_the_work(capsys, tmp_path, option):
    for name in ('x' * 300, 'x' * 300 + '.csv'):
        path = _bag(tmp_path / f'bag{len(name)}', _records())
        status, _, err = _run(capsys, path, PLAIN, option, tmp_path / name)
        assert status == 2
        assert 'too long' in err


@pytest.mark.parametrize(('first', 'second', 'name'), [
    ('--output', '--report', 'a.csv'), ('--output', '--configurations', 'a.csv'),
    ('--suggest', '--save-arm', 'a.yaml')])
def test_two_outputs_cannot_be_one_file(capsys, tmp_path, first, second, name):
    path = _bag(tmp_path / 'bag', _records())
    status, _, err = _run(capsys, path, PLAIN, first, tmp_path / name, second, tmp_path / 'bag' / '..' / name)
    assert status == 2
    assert f'{first} and {second} are both' in err
    assert 'give two names' in err


@pytest.mark.parametrize('option', ['--output', '--report', '--save-arm', '--suggest', '--configurations'])
@pytest.mark.parametrize('reads_one_file', [False, True])
def test_nothing_is_written_into_the_recording_that_is_read(capsys, tmp_path, option, reads_one_file):
    path = _bag(tmp_path / 'bag', _records())
    before = {file: file.read_bytes() for file in path.iterdir()}
    for name in ('metadata.yaml', 'bag.mcap', 'new.yaml', 'new.csv', 'new'):
        source = path / 'bag.mcap' if reads_one_file else path
        status, _, err = _run(capsys, source, PLAIN, option, path / name)
        assert status == 2
        assert f'{option} ' in err
        assert 'is in the recording' in err
    assert {file: file.read_bytes() for file in path.iterdir()} == before


@pytest.mark.parametrize('option', ['--save-arm', '--suggest'])
def test_the_parameter_file_that_is_read_is_not_overwritten(capsys, tmp_path, option):
    path = _bag(tmp_path / 'bag', _records())
    params = tmp_path / 'mine.yaml'
    params.write_text('/**: {ros__parameters: {order: 4}}\n', encoding='utf-8')
    status, _, err = _run(capsys, path, '--params', params, option, tmp_path / 'bag' / '..' / 'mine.yaml')
    assert status == 2
    assert 'which --params reads' in err
    assert write_urdf.main(['--params', str(params), '--output', str(params)]) == 2
    assert 'which --params reads' in capsys.readouterr().err
    assert params.read_text(encoding='utf-8') == '/**: {ros__parameters: {order: 4}}\n'


@pytest.mark.parametrize(('places', 'words'), [
    ({'output': 'both.csv', 'configurations': 'both.csv'}, '--output and --configurations are both'),
    ({'save_arm': 'bag/arm.yaml'}, 'is in the recording')])
def test_the_function_behind_the_program_writes_no_two_outputs_to_one_file(tmp_path, places, words):
    path = _bag(tmp_path / 'bag', _records())
    request = replay.Request(path, IdentifierParameters(payload_method='none'), **{
        name: str(tmp_path / place) for name, place in places.items()})
    with pytest.raises(FlexmanipError, match=words):
        replay.identify(request)
    assert not (tmp_path / 'both.csv').exists()


def test_an_earlier_output_is_written_anew(capsys, tmp_path):
    path = _bag(tmp_path / 'bag', _records())
    table = tmp_path / 'estimates.csv'
    table.write_text('the last results\n', encoding='utf-8')
    assert _run(capsys, path, PLAIN, '--output', table)[0] == 0
    assert table.read_text(encoding='utf-8').startswith('stamp_ns,')


def test_detection_needs_angles_but_no_payload_method(capsys, tmp_path):
    path = _bag(tmp_path / 'bag', _records())
    assert _run(capsys, path, PLAIN, '--detect')[0] == 0
    status, _, err = _run(capsys, path, PLAIN, '--set=angles=[]', '--detect')
    assert status == 2
    assert 'without angles' in err


@pytest.mark.parametrize('bag', ['', '.', '/'])
def test_simulate_bag_wants_a_name_to_make(capsys, bag):
    assert simulate_bag.main([bag]) == 2
    err = capsys.readouterr().err
    assert 'defect' not in err
    assert err.count('\n') == 1


@pytest.mark.parametrize('program', [monte_carlo, reproduce_paper])
def test_a_seed_that_is_none_is_rejected_before_the_runs(capsys, program):
    with pytest.raises(SystemExit) as ended:
        program.main([*(['scenario.yaml'] if program is monte_carlo else []), '--first-seed=-5'])
    assert ended.value.code == 2
    assert "'-5' is not a whole number" in capsys.readouterr().err


def test_a_recording_that_is_not_there_leaves_the_last_results(capsys, tmp_path):
    table = tmp_path / 'estimates.csv'
    table.write_text('the last results\n', encoding='utf-8')
    assert main([str(tmp_path / 'typo'), '--output', str(table), PLAIN]) == 2
    assert 'does not exist' in capsys.readouterr().err
    assert table.read_text(encoding='utf-8') == 'the last results\n'
    folder = tmp_path / 'out'
    assert main([str(tmp_path / 'typo'), '--output', str(folder), PLAIN]) == 2
    assert not folder.exists()


@pytest.mark.parametrize(('names', 'level', 'status'), [(('wheel',), 0.0, 0), (NAMES, np.nan, 2)],
                         ids=['another machine', 'not finite'])
def test_however_many_unusable_messages_come_first_the_others_are_used(capsys, tmp_path, names, level, status):
    first = [JointRecord(START - (2500 - k) * MS, names, *np.full((3, len(names)), level)) for k in range(2500)]
    ended, found, _ = _run(capsys, _bag(tmp_path / 'bag', first + _records()), PLAIN)
    assert (ended, found['samples']) == (status, 300)


def test_stamps_below_zero_are_written_as_they_are(capsys, tmp_path):
    records = [record._replace(stamp_ns=record.stamp_ns - START - 10**12) for record in _records()]
    status, _, err = _run(capsys, _bag(tmp_path / 'bag', records), PLAIN, '--output', tmp_path / 'out')
    assert (status, err) == (0, '')
    with Reader(tmp_path / 'out') as reader:
        found = [(recorded_ns, cdr.stamp_ns(raw)) for topic, recorded_ns, raw in reader.messages()
                 if topic.topic == '/rpbsid_identifier/status']
    assert {recorded_ns for recorded_ns, _ in found} == {0}
    assert {stamp_ns for _, stamp_ns in found} <= {record.stamp_ns for record in records}


@pytest.mark.parametrize(('names', 'level'), [(('wheel',), 0.0), (NAMES, np.nan)],
                         ids=['another machine', 'not finite'])
def test_times_count_from_the_first_sample_whatever_came_before_it(capsys, tmp_path, names, level):
    first = [JointRecord(START - (500 - k) * MS, names, *np.full((3, len(names)), level)) for k in range(500)]
    table = tmp_path / 'out.csv'
    _, found, _ = _run(capsys, _bag(tmp_path / 'bag', first + _records()), PLAIN, '--capture-time=0.2',
                       '--output', table)
    assert found['capture_time_s'] == 0.2
    assert table.read_text(encoding='utf-8').splitlines()[1].startswith(f'{START},0.0,')


def test_an_event_too_old_that_comes_after_a_later_one_is_not_said_to_be_applied(capsys, tmp_path):
    events = CaptureEvent(START + 250 * MS, EventKind.RELEASE), CaptureEvent(START + 100 * MS, EventKind.CAPTURE)
    _, found, err = _run(capsys, _bag(tmp_path / 'bag', _records(700), *events, at=600), PLAIN)
    assert (found['capture_time_s'], found['release_time_s']) == (None, 0.25)
    assert 'applied on arrival, or not at all where a later one was known' in err
