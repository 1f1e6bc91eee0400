"""identify_bag --suggest and --smooth on machines that nobody described."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from recordings import START, record
from scipy.linalg import block_diag, expm

from flexmanip_ros.cli.identify_bag import main
from flexmanip_ros.cli.suggest import Found, _recording, choose_signals, suggest
from flexmanip_ros.errors import ParameterError
from flexmanip_ros.io.bag import Topics
from flexmanip_ros.io.parameter_file import load
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.studies import suggestion
from flexmanip_ros.types import CaptureEvent, EventKind, JointRecord

DT = 0.004
NAMES = ('hub', 'gauge', 'lamp')
MODES = ((1.5, 0.05), (9.0, 0.02))
"""Frequency [Hz] and damping ratio of each mode of the machine; both sensors see both."""

GRIPPER = JointRecord(0, ('finger',), np.array([0.1]), np.empty(0), np.empty(0))
"""A message of another publisher on the same topic, which does not fill in its stamp."""


@lru_cache
def _machine(count: int = 2500, slower_from: int | None = None) -> tuple[JointRecord, ...]:
    """Return a hub that is driven by steps, with a strain gauge behind it, 250 Hz, noise of 1 %."""
    rng = np.random.default_rng(8)

    def discrete(scale: float) -> tuple[np.ndarray, np.ndarray]:
        blocks, inputs = [], []
        for frequency, damping in MODES:
            omega = 2.0 * np.pi * frequency * scale
            blocks.append(np.array([[0.0, 1.0], [-omega ** 2, -2.0 * damping * omega]]))
            inputs.append([[0.0], [omega]])
        full = np.zeros((5, 5))
        full[:4, :4], full[:4, 4:] = block_diag(*blocks), np.vstack(inputs)
        stepped = expm(full * DT)
        return stepped[:4, :4], stepped[:4, 4]

    seen = np.array([[9.0, 0.0, 12.0, 0.0], [-4.0, 0.0, 24.0, 0.0]])
    x, records = np.zeros(4), []
    A, B = discrete(1.0)
    u = np.repeat(rng.choice([-1.0, 1.0], size=count // 12 + 1), 12)[:count]
    for k in range(count):
        if k == slower_from:
            A, B = discrete(0.8)
        y = seen @ x + rng.normal(size=2) * [0.03, 0.05]
        records.append(JointRecord(START + round(k * DT * 1e9), NAMES, np.array([*y, 7.0]), np.empty(0),
                                   np.array([u[k], 0.0, 0.0])))
        x = A @ x + B * u[k]
    return tuple(records)


@pytest.fixture(scope='module')
def recording(tmp_path_factory):
    return record(tmp_path_factory.mktemp('bags') / 'machine', _machine())


@pytest.fixture(scope='module')
def suggested(recording, tmp_path_factory):
    """The file that was suggested for the first half, and what is told while it is."""
    place = tmp_path_factory.mktemp('suggested') / 'machine.yaml'
    with pytest.MonkeyPatch.context() as patch:
        said: list[str] = []
        patch.setattr('builtins.print', lambda *parts, **_: said.append(' '.join(map(str, parts))))
        status = main([str(recording), '--suggest', str(place), '--validate-from', '5', '--json'])
    assert status == 0
    return place, '\n'.join(said)


def _json(capsys, *arguments: object) -> dict:
    assert main([*map(str, arguments), '--json']) == 0
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def test_every_signal_is_listed_with_its_rate(suggested):
    _, said = suggested
    assert 'hub/effort                   250 Hz   -1 .. 1' in said
    assert 'lamp/position                250 Hz   stands still at 7' in said


def test_what_moves_is_chosen_and_every_choice_has_a_line_in_the_file_too(suggested):
    place, said = suggested
    config = load(IdentifierParameters, 'rpbsid_identifier', place)
    assert config.inputs == ('hub/effort',)
    assert config.outputs == ('hub/position', 'gauge/position')
    assert (config.angles, config.payload_method) == ((), 'none')
    text = place.read_text(encoding='utf-8')
    for name in ('inputs', 'outputs', 'payload_method', 'decimation', 'past_window', 'future_window', 'order',
                 'direct_feedthrough', 'forgetting, refinement', 'regularization'):
        assert f'suggested    {name}: ' in said
        assert f'# * {name}: ' in text


def test_the_suggested_file_predicts_better_than_the_defaults_and_finds_the_modes(recording, suggested, capsys):
    place, said = suggested
    found = _json(capsys, recording, '--params', place, '--validate-from', 5)
    plain = _json(capsys, recording, '--set=inputs=[hub/effort]', '--set=outputs=[hub/position, gauge/position]',
                  '--set=payload_method=none', '--set=angles=[]', '--validate-from', 5)
    assert min(found['vaf_horizon_percent']) > 90.0
    assert np.mean(found['vaf_horizon_percent']) >= np.mean(plain['vaf_horizon_percent']) - 0.1
    for frequency, _ in MODES:
        assert min(abs(np.array(found['frequencies_hz']) - frequency)) < 0.05 * frequency
    at_once = json.loads(said.splitlines()[-1])
    assert at_once['vaf_horizon_percent'] == found['vaf_horizon_percent']


@pytest.mark.parametrize('decimation', [1, 2, 3])
def test_a_model_with_modes_that_nothing_determines_is_not_tracking_whatever_its_rate(recording, capsys, decimation):
    for order, tracking in ((4, True), (10, False)):
        found = _json(capsys, recording, '--set=inputs=[hub/effort]', '--set=outputs=[hub/position, gauge/position]',
                      '--set=payload_method=none', '--set=angles=[]', '--set=refinement=none',
                      '--set=forgetting_factor=[1.0, 1.0, 1.0]', '--set=direct_feedthrough=true',
                      '--set=past_window=20', '--set=future_window=10', f'--set=order={order}',
                      f'--set=decimation={decimation}')
        assert (found['status'] == 'TRACKING') is tracking


def test_a_capture_that_is_told_divides_a_recording_as_one_that_it_holds(recording, tmp_path):
    records = _machine()
    capture = CaptureEvent(records[0].stamp_ns + 3_000_000_000, EventKind.CAPTURE)
    announced = record(tmp_path / 'announced', [capture, *records])
    beside = record(tmp_path / 'beside', (GRIPPER, *records))
    given = {'order': 4, 'decimation': 5}  # the whole search is another test's; the reasons tell every error
    found = [suggest(str(source), str(tmp_path / 'some.yaml'), given, Topics(), None, 0.25, events_s)
             for source, events_s in ((announced, ()), (beside, (3.0,)), (recording, ()))]
    held, told, whole = (
        (config, [line for line in lines if line.startswith('suggested')]) for config, lines in found)
    assert told == held
    assert told != whole


def test_the_time_to_look_at_counts_from_the_first_message_of_the_machine(tmp_path):
    blocks, _ = _recording(str(record(tmp_path / 'beside', (GRIPPER, *_machine()))), Topics(), 2.0, lambda *_: None)
    assert sum(len(block.stamp_ns) for block in blocks if block.names == NAMES) == round(2.0 / DT)


def test_what_is_set_stays_as_it_is(recording, tmp_path, capsys):
    place = tmp_path / 'set.yaml'
    _json(capsys, recording, '--suggest', place, '--set=order=4', '--set=decimation=5', '--set=model_rate=2.0',
          '--set=outputs=[gauge/position]')
    config = load(IdentifierParameters, 'rpbsid_identifier', place)
    assert (config.order, config.decimation, config.model_rate, config.outputs) == (4, 5, 2.0, ('gauge/position',))


def test_a_recording_of_other_joints_names_them_and_the_command(recording, capsys):
    assert main([str(recording)]) == 2
    err = capsys.readouterr().err
    assert 'the joints there are: hub, gauge, lamp' in err
    assert f'identify_bag {recording} --suggest FILE.yaml' in err
    assert err.count('\n') == 1


@pytest.mark.parametrize(('arguments', 'words'), [
    (['--set=inputs=[motor/effort]'], 'the signals there are: gauge/effort'),
    (['--set=inputs=[lamp/effort]'], 'no signal of inputs moves'),
    (['--set=arm.tip_mass=3.0'], "'joint1/position' of parameter 'angles' is not in the messages"),
    (['--set=ordre=4'], "did you mean 'order'"),
    (['--set=order=1000'], "parameter 'order'"),
    (['--validate-from', '0'], 'no sample before 0 s'),
    (['--validate-from', '0.2'], 'too few'),
])
def test_what_cannot_be_suggested_is_one_line(recording, tmp_path, capsys, arguments, words):
    assert main([str(recording), '--suggest', str(tmp_path / 'no.yaml'), *arguments]) == 2
    err = capsys.readouterr().err
    assert words in err
    assert err.count('\n') == 1
    assert not (tmp_path / 'no.yaml').exists()


def test_a_place_that_cannot_be_written_is_said_before_the_work(recording, capsys):
    assert main([str(recording), '--suggest', 'no/such/folder/file.yaml']) == 2
    assert 'does not exist' in capsys.readouterr().err


@pytest.mark.parametrize(('option', 'place', 'words'), [
    ('--output', 'no/such/folder/out.csv', 'does not exist'), ('--output', '', 'exists already'),
    ('--report', 'page.pdf', 'does not end in .html'), ('--save-arm', 'no/such/arm.yaml', 'does not exist')])
def test_a_place_that_cannot_be_written_is_said_before_the_search(
        recording, tmp_path, capsys, option, place, words):
    assert main([str(recording), '--suggest', str(tmp_path / 'found.yaml'), option, str(tmp_path / place)]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / 'found.yaml').exists()


def _found(*names: str) -> list[Found]:
    return [Found(name, -1.0, 1.0, 0.5, 100.0, 0, 100) for name in names]


def test_signals_whose_names_say_what_they_are_are_taken_by_name():
    chosen, _ = choose_signals(_found(
        'joint1/position', 'joint1/effort', 'joint2/effort', 'link1_bend/position', 'link2_bend/position'), {})
    assert chosen['inputs'] == ('joint1/effort', 'joint2/effort')
    assert chosen['outputs'] == ('link1_bend/position', 'link2_bend/position')


def test_a_robot_whose_first_two_joints_have_the_names_of_the_arm_has_every_effort():
    joints = [f'joint{k}' for k in range(1, 7)]
    signals = _found(*(f'{joint}/{kind}' for joint in joints for kind in ('position', 'effort')))
    chosen, _ = choose_signals(signals, {})
    assert chosen['inputs'] == tuple(f'{joint}/effort' for joint in joints)
    assert chosen['outputs'] == tuple(f'{joint}/position' for joint in joints)


def test_a_given_arm_keeps_its_payload_method():
    signals = _found('joint1/effort', 'joint2/effort', 'link1_bend/position')
    assert choose_signals(signals, {'arm.tip_mass': 3.0})[0]['payload_method'] == 'structured'
    assert choose_signals(signals, {})[0]['payload_method'] == 'none'


def test_an_arm_of_one_link_needs_no_angle_of_a_second(tmp_path, capsys):
    path = record(tmp_path / 'bag', tuple(
        item._replace(names=('joint1', 'link1_bend', 'lamp')) for item in _machine(250)))
    place = tmp_path / 'one.yaml'
    _json(capsys, path, '--suggest', place, '--set=arm.link_length=[0.41]', '--set=arm.linear_density=[1.0]',
          '--set=arm.bending_stiffness=[1.0]', '--set=arm.modes=1', '--set=order=4', '--set=decimation=2')
    assert load(IdentifierParameters, 'rpbsid_identifier', place).payload_method == 'structured'


@pytest.mark.parametrize(('errors', 'ridge'), [
    ({1e-6: 0.05, 1e-4: 0.0505, 1e-3: 0.051}, 1e-3),  # the moments' choice is nearly as good
    ({1e-6: 0.05, 1e-4: 0.051, 1e-3: 0.3}, 1e-4),  # the largest that is nearly as good
    ({1e-6: 1.0, 1e-4: 0.6, 1e-3: 20.0}, 1e-3),  # no run tells anything
])
def test_the_ridge_is_that_of_the_moments_unless_a_run_of_the_identifier_gains(errors, ridge):
    assert suggestion._ridge(errors, 1e-3) == ridge


def test_without_an_effort_that_moves_the_inputs_are_asked_for():
    with pytest.raises(ParameterError, match=r'--set inputs='):
        choose_signals(_found('a/position', 'b/velocity'), {})


def test_efforts_that_stand_still_are_named():
    still = replace(_found('a/effort')[0], low=0.05, high=0.05, std=0.0)
    with pytest.raises(ParameterError, match='these stand still: a/effort'):
        choose_signals([still, *_found('a/position')], {})


def test_a_recording_too_short_to_be_scored_asks_for_a_longer_one(tmp_path, capsys):
    path = record(tmp_path / 'bag', _machine(65))
    assert main([str(path), '--suggest', str(tmp_path / 'no.yaml')]) == 2
    err = capsys.readouterr().err
    assert 'record for longer' in err
    assert err.count('\n') == 1


def test_a_signal_that_is_not_finite_at_times_serves_and_one_that_mostly_is_not_is_named():
    some, most = (replace(found, broken=broken) for found, broken in zip(
        _found('a/effort', 'b/effort'), (30, 70), strict=True))
    chosen, _ = choose_signals([some, most, *_found('c/position')], {})
    assert chosen['inputs'] == ('a/effort',)
    with pytest.raises(ParameterError, match='most values are not finite of b/effort'):
        choose_signals([most, *_found('c/position')], {})


def test_smooth_gives_each_stretch_its_modes_with_a_band(tmp_path, capsys):
    change = 1300
    capture = CaptureEvent(START + round(change * DT * 1e9), EventKind.CAPTURE)
    path = record(tmp_path / 'bag', [capture, *_machine(2500, change)])
    page = tmp_path / 'report.html'
    found = _json(capsys, path, '--smooth', '--report', page, '--set=inputs=[hub/effort]',
                  '--set=outputs=[hub/position, gauge/position]', '--set=payload_method=none', '--set=angles=[]',
                  '--set=past_window=20', '--set=future_window=10')
    assert [part['samples'] for part in found['smoothed']] == [change, 2500 - change]
    for part, scale in zip(found['smoothed'], (1.0, 0.8), strict=True):
        assert part['method'] == 'maximum likelihood'
        for (frequency, damping), hz, std, ratio in zip(
                MODES, part['frequencies_hz'], part['frequencies_std_hz'], part['damping_ratios'], strict=True):
            assert abs(hz - scale * frequency * np.sqrt(1.0 - damping ** 2)) < 4.0 * std
            assert std < 0.01 * frequency
            assert ratio == pytest.approx(damping, rel=0.2)
    assert 'maximum likelihood' in page.read_text(encoding='utf-8')


def test_without_smooth_the_json_has_no_such_key(tmp_path, capsys):
    path = record(tmp_path / 'bag', _machine(300))
    assert 'smoothed' not in _json(capsys, path, '--set=inputs=[hub/effort]', '--set=outputs=[hub/position]',
                                   '--set=payload_method=none', '--set=angles=[]')
