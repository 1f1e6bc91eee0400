"""The program identify_bag, called as a user calls it."""

from __future__ import annotations

import csv
import json
import os
import shutil

import numpy as np
import pytest
from recordings import START, record
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from flexmanip_ros import messages, pipeline
from flexmanip_ros.cli.identify_bag import main
from flexmanip_ros.cli.simulate_bag import main as simulate
from flexmanip_ros.io import bag
from flexmanip_ros.io.outputs import matrices, write_file
from flexmanip_ros.io.parameter_file import read
from flexmanip_ros.parameters import ArmParameters, IdentifierParameters, PlantParameters, configure, flatten
from flexmanip_ros.types import CaptureEvent, Estimate, EventKind, JointRecord, StateSpace, Status

KEYS = ['samples', 'gaps', 'sample_time_s', 'wall_s', 'status', 'frequencies_hz', 'damping_ratios',
        'payload_mass_kg', 'payload_std_kg', 'payload_ci95_kg', 'consistency', 'capture_time_s',
        'release_time_s', 'payload_com_m', 'payload_com_std_m', 'payload_inertia_kgm2', 'payload_inertia_std_kgm2',
        'vaf_simulation_percent', 'vaf_prediction_percent', 'vaf_horizon_percent']
OTHER = {'payload_method': 'none', 'inputs': ['motor/effort'], 'outputs': ['arm/position', 'arm/velocity'],
         'angles': [], 'order': 2, 'past_window': 6, 'future_window': 4}
SETTINGS = [f'--set={name}={json.dumps(value)}' for name, value in OTHER.items()]


def _oscillator(count: int = 1500, dt: float = 0.01) -> list[JointRecord]:
    """A damped oscillation at 2 Hz driven by noise, as another machine would publish it."""
    rng = np.random.default_rng(3)
    omega, zeta = 2.0 * np.pi * 2.0, 0.05
    continuous = np.array([[0.0, 1.0], [-omega**2, -2.0 * zeta * omega]])
    from scipy.linalg import expm

    full = expm(np.block([[continuous, np.array([[0.0], [50.0]])], [np.zeros((1, 3))]]) * dt)
    x, records = np.zeros(2), []
    for k in range(count):
        u = rng.normal()
        noisy = x + rng.normal(size=2) * [0.005, 0.05]
        records.append(JointRecord(
            START + round(k * dt * 1e9), ('other', 'motor', 'arm'), np.array([0.0, 0.0, noisy[0]]),
            np.array([np.nan, 0.0, noisy[1]]), np.array([0.0, u, 0.0])))
        x = full[:2, :2] @ x + full[:2, 2] * u
    return records


@pytest.fixture(scope='module')
def recording(tmp_path_factory):
    return record(tmp_path_factory.mktemp('bags') / 'oscillator', _oscillator())


@pytest.fixture(scope='module')
def estimates(recording):
    """What the pipeline says about the recording."""
    return list(pipeline.run(configure(IdentifierParameters, OTHER), bag.read(recording)))


def _run(capsys, *arguments: object) -> tuple[int, str, str]:
    status = main([str(argument) for argument in arguments])
    seen = capsys.readouterr()
    return status, seen.out, seen.err


def test_json_has_exactly_the_promised_keys_on_the_last_line(recording, capsys):
    status, out, err = _run(capsys, recording, *SETTINGS, '--json', '--validate-from', 10)
    assert (status, err) == (0, '')
    found = json.loads(out.splitlines()[-1])
    assert list(found) == KEYS
    assert found['sample_time_s'] == pytest.approx(0.01)
    assert found['frequencies_hz'] == [pytest.approx(2.0, rel=0.05)]
    assert found['payload_mass_kg'] is None
    assert found['capture_time_s'] is None
    assert all(score > 80.0 for score in found['vaf_simulation_percent'])
    assert all(score > 80.0 for score in found['vaf_prediction_percent'])
    assert all(score > 80.0 for score in found['vaf_horizon_percent'])


def test_without_json_the_result_is_written_for_people(recording, capsys):
    status, out, _ = _run(capsys, recording, *SETTINGS)
    assert status == 0
    assert 'mode 1' in out
    assert 'Hz' in out


def test_a_horizon_beyond_what_is_held_out_is_said_with_both_times(recording, capsys):
    status, out, _ = _run(capsys, recording, *SETTINGS, '--validate-from', 12, '--horizon', 30)
    assert status == 0
    assert 'VAF ahead    unknown: 2.990 s are held out, too short for the --horizon of 30 s; give a shorter one' in out


def test_a_table_holds_what_the_pipeline_says(recording, estimates, capsys, tmp_path):
    for name in ('out.csv', 'out.npz', 'OUT.CSV'):
        assert _run(capsys, recording, *SETTINGS, '--output', tmp_path / name)[0] == 0
    with np.load(tmp_path / 'out.npz', allow_pickle=False) as stored:
        assert stored['stamp_ns'].tolist() == [estimate.stamp_ns for estimate in estimates]
        assert stored['A'].shape == (len(estimates), 2, 2)
        np.testing.assert_array_equal(stored['A'][-1], estimates[-1].model.A)
        assert stored['frequency_hz'][-1] == estimates[-1].modes[0].frequency_hz
    assert (tmp_path / 'OUT.CSV').read_bytes() == (tmp_path / 'out.csv').read_bytes()
    with (tmp_path / 'out.csv').open(encoding='utf-8') as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(estimates)
    assert float(rows[-1]['frequency1_hz']) == estimates[-1].modes[0].frequency_hz
    assert rows[-1]['payload_mass_kg'] == ''
    assert rows[-1]['status'] == estimates[-1].status.name


def test_a_table_without_any_mode_has_its_columns_all_the_same(recording, capsys, tmp_path):
    place = record(tmp_path / 'bag', _oscillator(5))
    assert _run(capsys, place, *SETTINGS, '--output', tmp_path / 'out.csv')[0] == 0
    with (tmp_path / 'out.csv').open(encoding='utf-8') as file:
        row = next(csv.DictReader(file))
    assert [row[name] for k in (1, 2) for name in (
        f'frequency{k}_hz', f'damping{k}_ratio', f'frequency{k}_std_hz', f'damping{k}_ratio_std')] == [''] * 8


def test_an_interrupt_while_a_file_is_written_keeps_the_old_one_and_leaves_no_scraps(tmp_path):
    def interrupted(file):
        file.write(b'half of')
        raise KeyboardInterrupt

    (tmp_path / 'out.npz').write_text('the last results', encoding='utf-8')
    with pytest.raises(KeyboardInterrupt):
        write_file(tmp_path / 'out.npz', interrupted)
    assert [file.read_text(encoding='utf-8') for file in tmp_path.iterdir()] == ['the last results']


def test_models_of_different_orders_share_a_table() -> None:
    """Of an arm that moves a larger order becomes two states a displacement once every configuration has its model."""
    def estimate(order: int) -> Estimate:
        model = StateSpace(np.eye(order), np.ones((order, 1)), np.ones((2, order)), np.zeros((2, 1)),
                           np.ones((order, 2)), 1e-3)
        return Estimate(0, Status.TRACKING, model, (), None)

    stored = matrices([estimate(6), estimate(4)])
    assert stored['A'].shape == (2, 6, 6)
    np.testing.assert_array_equal(stored['A'][1, :4, :4], np.eye(4))
    assert np.isnan(stored['A'][1, 4:]).all()


def test_an_interrupt_reports_and_writes_what_was_identified_until_then(recording, capsys, tmp_path, monkeypatch):
    whole = pipeline.replay

    def interrupted(*arguments):
        for count, found in enumerate(whole(*arguments), start=1):
            yield found
            if count == 100:
                raise KeyboardInterrupt

    monkeypatch.setattr(pipeline, 'replay', interrupted)
    status, out, err = _run(capsys, recording, *SETTINGS, '--output', tmp_path / 'out.csv')
    assert status == 130
    assert 'samples' in out
    assert 'interrupted' in err
    assert len((tmp_path / 'out.csv').read_text(encoding='utf-8').splitlines()) == 1 + 100


def test_a_recording_of_the_estimates_holds_what_the_node_would_publish(recording, estimates, capsys, tmp_path):
    assert _run(capsys, recording, *SETTINGS, '--output', tmp_path / 'out')[0] == 0
    last = [estimate for estimate in estimates if estimate.model is not None and estimate.model_is_new][-1]
    store = get_typestore(Stores.ROS2_JAZZY)
    with Reader(tmp_path / 'out') as reader:
        stored = {connection.topic: (stamp, store.deserialize_cdr(raw, connection.msgtype))
                  for connection, stamp, raw in reader.messages()}
    expected = dict(messages.outgoing(last, 'link2_tip'))
    assert set(stored) == {f'/rpbsid_identifier/{name}' for name in expected}
    for name, value in expected.items():
        stamp, message = stored[f'/rpbsid_identifier/{name}']
        assert stamp == last.stamp_ns
        if isinstance(value, messages.Diagnostics):
            assert [item.message for item in message.status] == [item.message for item in value.statuses]
        else:
            np.testing.assert_array_equal(message.data, value.data.ravel())


def test_an_existing_recording_is_kept_and_said_before_the_work(recording, capsys, tmp_path):
    (tmp_path / 'out').mkdir()
    status, _, err = _run(capsys, recording, *SETTINGS, '--output', tmp_path / 'out')
    assert status == 2
    assert 'exists already' in err


def test_a_recording_whose_name_is_not_utf_8_has_a_report(recording, capsys, tmp_path):
    place = tmp_path / os.fsdecode(b'caf\xe9')
    shutil.copytree(recording, place)
    assert _run(capsys, place, *SETTINGS, '--report', tmp_path / 'report.html')[0] == 0
    assert 'Identification of caf\\udce9' in (tmp_path / 'report.html').read_text(encoding='utf-8')


def test_the_report_is_one_page_that_needs_nothing_else(recording, capsys, tmp_path):
    page = tmp_path / 'report.html'
    assert _run(capsys, recording, *SETTINGS, '--report', page, '--validate-from', 10)[0] == 0
    text = page.read_text(encoding='utf-8')
    assert text.count('data:image/png;base64,') == 3
    assert 'http' not in text
    for word in ('Result', 'Signals', 'Frequencies', 'Validation', 'Model', 'Parameters', 'Messages'):
        assert f'>{word}</h2>' in text


def test_frequencies_over_configurations_need_a_model_of_every_one(recording, capsys, tmp_path):
    status, _, err = _run(capsys, recording, *SETTINGS, '--configurations', tmp_path / 'out.csv')
    assert status == 2
    assert 'moving_arm.md' in err


@pytest.mark.parametrize(('arguments', 'words'), [
    (['--configurations', 'out.csv', '--set', 'arm.link_length=[2.0]'], 'two angles'),
    (['--configurations', 'out.csv', '--set', 'decimation=2'], 'decimation 1'),
    (['--save-arm', 'out.yaml', '--set', 'payload_method=block'], 'payload_method structured')])
def test_a_file_that_the_parameters_leave_empty_is_refused_before_the_work(
        recording, capsys, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(pipeline, 'init', pytest.fail)
    status, out, err = _run(capsys, recording, *arguments)
    assert (status, out, list(tmp_path.iterdir())) == (2, '', [])
    assert words in err


def test_what_a_recording_does_not_give_costs_nothing_of_the_rest(capsys, tmp_path):
    place = tmp_path / 'short'
    assert simulate([str(place), '--duration', '0.3', '--capture-time', '-1']) == 0
    capsys.readouterr()
    table, page = tmp_path / 'out.csv', tmp_path / 'page.html'
    status, out, err = _run(capsys, place, '--no-detect', '--json', '--configurations', tmp_path / 'angles.csv',
                            '--output', table, '--report', page, '--validate-from', 0.02)
    assert status == 2
    assert json.loads(out)['samples'] == 20
    assert json.loads(out)['vaf_simulation_percent'] is None
    for words in ('there is no model yet at 0.02 s', '--configurations has nothing to write'):
        assert words in err
        assert words in page.read_text(encoding='utf-8')
    assert err.count('\n') == 1
    assert table.exists()
    assert str(table) in err
    assert 'angles.csv' not in err
    assert not (tmp_path / 'angles.csv').exists()


def test_a_capture_time_can_be_given_by_hand(recording, capsys):
    status, out, _ = _run(capsys, recording, *SETTINGS, '--json', '--capture-time', 5, '--release-time', 8)
    found = json.loads(out)
    assert status == 0
    assert (found['capture_time_s'], found['release_time_s']) == (5.0, 8.0)


def test_an_event_in_the_recording_is_found(capsys, tmp_path):
    path = record(tmp_path / 'bag', [*_oscillator(600), CaptureEvent(START + 3_000_000_000, EventKind.CAPTURE)])
    _, out, _ = _run(capsys, path, *SETTINGS, '--json')
    assert json.loads(out)['capture_time_s'] == 3.0


@pytest.mark.parametrize(('arguments', 'words'), [
    (('--params', 'a.yaml', '--params', 'b.yaml'), '--params was given twice'),
    (('--report', 'report.pdf'), 'does not end in .html'),
    (('--save-arm', 'arm.json'), 'does not end in .yaml'),
    (('--configurations', 'table.xlsx'), 'does not end in .csv'),
    (('--suggest', 'found.yaml', '--validate-from', '100'), 'no sample to score from 100 s on')])
def test_what_would_be_in_vain_is_said_before_the_work(capsys, recording, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    try:
        code, _, err = _run(capsys, recording, *arguments)
    except SystemExit as end:  # of the parser
        code, err = end.code, capsys.readouterr().err
    assert code == 2
    assert words in err
    assert list(tmp_path.iterdir()) == []


def test_what_the_arm_taught_is_saved_and_given_back_as_parameters(capsys, tmp_path):
    place, saved = tmp_path / 'faulty', tmp_path / 'arm.yaml'
    faults = {'torque_gain': (1.04, 0.97), 'bend_gain': (0.98, 1.02), 'bend_offset': (5e-4, -3e-4),
              'joint_viscous_friction': (0.8, 0.4)}
    given = [part for name, value in faults.items() for part in ('--set', f'arm.{name}={list(value)}')]
    # At 50 dB friction is known to 1 %, so 5 % does not depend on the processor's last bits.
    assert simulate([str(place), '--duration', '7', '--capture-time', '6', '--payload', '20', '--set', 'snr_db=50',
                     '--set', 'seed=3', *given]) == 0
    table = tmp_path / 'configurations.csv'
    code, *_ = _run(capsys, place, '--save-arm', saved, '--json', '--output', tmp_path / 'estimates',
                    '--configurations', table)
    assert code == 0
    with table.open(encoding='utf-8') as file:
        rows = list(csv.DictReader(file))
    assert [float(row['relative_angle_deg']) for row in rows] == pytest.approx(np.arange(0.0, 181.0, 2.5))
    assert all(float(row['frequency1_hz']) < float(row['frequency2_hz']) for row in rows if row['seen'] == '1')
    written = read(saved, 'rpbsid_identifier')
    assert set(flatten(ArmParameters(), 'arm.')) == set(written)  # nothing is lost where it is given back
    configure(PlantParameters, written)  # a simulated arm takes it too
    code, out, _ = _run(capsys, place, '--params', saved, '--json')
    result = json.loads(out.splitlines()[-1])
    assert result['status'] == 'TRACKING'
    assert result['payload_ci95_kg'][0] < 20.0 < result['payload_ci95_kg'][1]
    with Reader(tmp_path / 'estimates') as reader:
        store = get_typestore(Stores.ROS2_JAZZY)
        found = [store.deserialize_cdr(raw, one.msgtype) for one, _, raw in reader.messages()
                 if one.topic == '/rpbsid_identifier/arm_parameters']
    assert len(found) == 7  # one a second
    names = found[-1].layout.dim[0].label.split(',')
    values = found[-1].data.reshape(len(names), 2)
    assert values[names.index('joint1_torque_gain'), 0] == pytest.approx(1.04, rel=0.01)
    assert (values[:, 1] > 0.0).all()
    for name, value in faults.items():
        assert written[f'arm.{name}'] == pytest.approx(value, rel=0.05, abs=2e-5)
        for k, (found_value, truth) in enumerate(zip(written[f'arm.{name}'], value, strict=True)):
            part = 'link' if name.startswith('bend') else 'joint'
            published = f'{part}{k + 1}_{name.removeprefix("joint_")}'
            deviation = values[names.index(published), 1]
            assert abs(found_value - truth) < 3.0 * deviation, published
            assert deviation < (0.05 if 'friction' in name else 0.002) * abs(truth), published


def test_what_comes_before_a_fault_is_used_and_written(recording, capsys, tmp_path):
    content = next(recording.glob('*.mcap')).read_bytes()
    broken = tmp_path / 'broken.mcap'
    broken.write_bytes(content[:len(content) // 2])
    status, out, err = _run(capsys, broken, *SETTINGS, '--json', '--output', tmp_path / 'out.csv')
    assert status == 2
    assert err.count('\n') == 1
    assert 'damaged' in err
    assert 'out.csv' in err
    assert json.loads(out)['samples'] > 500
    assert len((tmp_path / 'out.csv').read_text(encoding='utf-8').splitlines()) > 100


@pytest.mark.parametrize(('arguments', 'words'), [
    (['--set', 'order=1000'], "parameter 'order'"),
    (['--set', 'ordre=4'], "did you mean 'order'"),
    (['--set', 'inputs=[motor2/effort]'], "'motor2/effort'"),
    (['--params', 'nothing.yaml'], 'does not exist'),
    (['--validate-from', '100'], 'leaves no samples'),
    (['--horizon', '0.5'], '--horizon is given without --validate-from'),
    (['--validate-from', '0'], 'leaves no samples'),
    (['--output', 'no/such/folder/out.csv'], 'does not exist'),
    (['--report', 'no/such/folder/out.html'], 'does not exist'),
    (['--joint-states', '/elsewhere'], 'the topics there are'),
])
def test_bad_arguments_are_one_line_and_exit_2(recording, capsys, arguments, words):
    status, _, err = _run(capsys, recording, *SETTINGS, *arguments)
    assert status == 2
    assert words in err
    assert err.count('\n') == 1


@pytest.mark.parametrize('arguments', [[], ['a', 'b'], ['bag', '--unknown'], ['bag', '--validate-from', 'x'],
                                       ['bag', '--horizon', '0']])
def test_a_command_line_that_cannot_be_read_exits_2(capsys, arguments):
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    assert capsys.readouterr().err.count('\n') == 1


def test_help_lists_examples_and_every_parameter(capsys):
    with pytest.raises(SystemExit) as caught:
        main(['--help'])
    assert caught.value.code == 0
    out = capsys.readouterr().out
    assert 'arm.bending_stiffness' in out
    assert 'examples:' in out


def test_faulty_messages_are_left_out_counted_and_reported(capsys, tmp_path):
    records = _oscillator(600)
    records[100].position[2] = np.nan
    short = records[200]
    records[200] = JointRecord(short.stamp_ns, short.names, short.position[:2], short.velocity, short.effort)
    status, out, err = _run(capsys, record(tmp_path / 'bag', records), *SETTINGS, '--json')
    assert status == 2
    assert '2 of 600 messages' in err
    assert "names but 2 values in 'position'" in err
    assert json.loads(out)['samples'] == 598


def test_a_recording_of_nothing_but_nan_is_rejected(capsys, tmp_path):
    records = _oscillator(50)
    for one in records:
        one.effort[:] = np.nan
    status, out, err = _run(capsys, record(tmp_path / 'bag', records), *SETTINGS, '--json',
                            '--output', tmp_path / 'out')
    assert (status, out) == (2, '')
    assert 'NaN' in err
    assert not (tmp_path / 'out').exists()


def _at(*milliseconds: float) -> list[JointRecord]:
    rng = np.random.default_rng(1)
    return [JointRecord(round(at * 1e6), ('arm', 'motor'), rng.normal(size=2), rng.normal(size=2),
                        rng.normal(size=2)) for at in milliseconds]


GRIPPER = JointRecord(500_000, ('finger',), np.zeros(1), np.empty(0), np.empty(0))


@pytest.mark.parametrize(('records', 'samples'), [
    (_at(0), 1), (_at(0, 1), 2), (_at(*range(19)), 19),
    ([*_at(*range(400)), *_at(*range(300))], None),
    ([*_at(*range(100)), *_at(*range(200, 300))], 200),
    ([one for pair in zip(_at(*range(200)), [GRIPPER] * 200, strict=True) for one in pair], 200),
    (_at(*np.arange(300) + np.random.default_rng(2).normal(size=300) * 0.1), 300),
    (_at(*np.arange(60) * 1e6), 60),
], ids=['one', 'two', 'short', 'looped', 'hole', 'another publisher', 'jitter', 'slow'])
def test_odd_recordings_give_a_status(capsys, tmp_path, records, samples):
    path = record(tmp_path / 'bag', records)
    status, out, err = _run(capsys, path, *SETTINGS, '--json', '--output', tmp_path / 'out.csv')
    assert status == 0
    assert err == '' or 'older than the one before' in err
    found = json.loads(out)
    assert samples is None or found['samples'] == samples
    assert found['status'] in Status.__members__


def test_a_defect_is_one_line_and_not_taken_for_bad_input(recording, capsys, monkeypatch):
    def broken(*arguments: object) -> None:
        raise ZeroDivisionError('somewhere')

    monkeypatch.setattr(pipeline, 'absorb', broken)
    status, _, err = _run(capsys, recording, *SETTINGS)
    assert status == 1
    assert 'ZeroDivisionError: somewhere' in err
    assert err.count('\n') == 1
