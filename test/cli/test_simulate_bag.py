"""The program simulate_bag, called as a user calls it."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest

from flexmanip_ros.cli.simulate_bag import START_NS, main
from flexmanip_ros.io import bag
from flexmanip_ros.parameters import ExcitationParameters, PlantParameters, configure
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, EventKind, JointRecord


def _simulate(folder: Path, *arguments: str) -> Path:
    path = folder / 'recording'
    assert main([str(path), '--duration', '0.2', *arguments]) == 0
    return path


def test_the_recording_holds_the_samples_and_events_of_the_simulator(tmp_path):
    path = _simulate(tmp_path, '--capture-time', '0.1', '--release-time', '0.15', '--seed', '5',
                     '--payload', '50')
    items = list(bag.read(path))
    events = (CaptureEvent(START_NS + 100_000_000, EventKind.CAPTURE),
              CaptureEvent(START_NS + 150_000_000, EventKind.RELEASE))
    plant = configure(PlantParameters, {'seed': 5, 'payload_mass': 50.0})
    expected = simulator.simulate(plant, excitation.sequence(ExcitationParameters(), 200), events, START_NS)
    records = [item for item in items if isinstance(item, JointRecord)]
    np.testing.assert_array_equal([record.position for record in records], expected.position)
    np.testing.assert_array_equal([record.velocity for record in records], expected.velocity)
    assert tuple(item for item in items if isinstance(item, CaptureEvent)) == events
    first_after = items[items.index(events[0]) + 1]
    assert first_after.stamp_ns == events[0].stamp_ns


def test_the_truth_stands_beside_the_recording(tmp_path):
    path = _simulate(tmp_path, '--capture-time', '0.1', '--set', 'arm.modes=5')
    truth = json.loads(path.with_name('recording.truth.json').read_text(encoding='utf-8'))
    assert truth['payload_mass_kg'] == 20.0
    assert truth['capture_time_s'] == 0.1
    assert truth['release_time_s'] is None
    assert truth['frequencies_before_hz'] == pytest.approx([5.757197, 6.893488], abs=2e-6)
    assert truth['frequencies_after_hz'] == pytest.approx([5.63383, 6.54451], abs=1e-5)
    assert truth['plant']['arm.modes'] == 5


@pytest.mark.parametrize(('arguments', 'lowest_hz'), [  # a point of 20 kg: 5.634 Hz; the empty arm: 5.757 Hz
    (['--capture-time', '0.1', '--set', 'payload_inertia=2.0'], 5.05), (['--capture-time', '-1'], 5.757)])
def test_the_true_frequencies_are_those_of_what_is_held(tmp_path, arguments, lowest_hz):
    path = _simulate(tmp_path, *arguments)
    truth = json.loads(path.with_name('recording.truth.json').read_text(encoding='utf-8'))
    assert truth['frequencies_after_hz'][0] == pytest.approx(lowest_hz, abs=0.005)


ONE_LINK = ('arm.link_length=[2.0]', 'arm.linear_density=[3.0]', 'arm.bending_stiffness=[2000.0]',
            'arm.sensor_position=[0.4]', 'arm.gravity=[0.0, -9.81]')


@pytest.mark.parametrize(('settings', 'modes'), [
    ((*ONE_LINK, 'initial_angles=[-1.5707963]'), 1), (('locked=true',), 2),
    ((*ONE_LINK, 'initial_angles=[0.0]', 'locked=true'), 1)], ids=['hangs', 'locked', 'sags'])
def test_an_arm_that_hangs_or_is_clamped_rings_at_its_true_frequencies(tmp_path, settings, modes):
    path = _simulate(tmp_path, '--duration', '12', '--payload', '5', '--capture-time', '0.001', *itertools.chain(
        *(('--set', item) for item in (*settings, 'noise=none', 'excitation.shape=zero', 'object_velocity=[0.1, 0.03]',
                                       'arm.damping_ratio=0.003'))))
    truth = json.loads(path.with_name('recording.truth.json').read_text(encoding='utf-8'))
    bend = np.array([item.position[-1] for item in bag.read(path) if isinstance(item, JointRecord)])[10:]
    power = np.abs(np.fft.rfft(np.hanning(len(bend)) * (bend - bend.mean()), 1 << 22))
    hertz = np.fft.rfftfreq(1 << 22, 0.001)
    for known in truth['frequencies_after_hz'][:modes]:
        near = np.abs(hertz / known - 1.0) < 0.1
        assert hertz[near][power[near].argmax()] == pytest.approx(known, rel=3e-3)


def test_the_same_arguments_give_the_same_bytes(tmp_path):
    contents = []
    for folder in ('a', 'b'):
        (tmp_path / folder).mkdir()
        path = _simulate(tmp_path / folder)
        contents.append((path / 'recording.mcap').read_bytes())
    assert contents[0] == contents[1]


def test_parameters_come_from_the_file_then_set_then_named_arguments(tmp_path):
    file = tmp_path / 'params.yaml'
    file.write_text('plant_simulator: {ros__parameters: {payload_mass: 1.0, rate: 500.0, noise: none}}\n'
                    'excitation: {ros__parameters: {amplitude: [3.0, 2.0]}}\n', encoding='utf-8')
    path = _simulate(tmp_path, '--params', str(file), '--set', 'payload_mass=2.0', '--payload', '3.0',
                     '--set', 'excitation.period=[0.05, 0.05]')
    truth = json.loads(path.with_name('recording.truth.json').read_text(encoding='utf-8'))
    assert truth['plant']['payload_mass'] == 3.0
    assert truth['sample_time_s'] == 0.002
    assert truth['excitation']['amplitude'] == [3.0, 2.0]
    assert sum(isinstance(item, JointRecord) for item in bag.read(path)) == 100


def test_the_torque_of_an_arm_of_one_link_is_given_for_one_joint(tmp_path):
    file = tmp_path / 'params.yaml'
    file.write_text('/**: {ros__parameters: {initial_angles: [0.5]}}\n', encoding='utf-8')
    path = _simulate(tmp_path, '--params', str(file), '--set', 'arm.link_length=[2.0]', '--capture-time', '0.1',
                     '--set', 'excitation.amplitude=[10.0]')
    truth = json.loads(path.with_name('recording.truth.json').read_text(encoding='utf-8'))
    assert truth['excitation']['amplitude'] == [10.0]
    assert truth['excitation']['arm.link_length'] == truth['plant']['arm.link_length'] == [2.0]


@pytest.mark.parametrize(('arguments', 'words'), [
    (['--set', 'excitation.amplitude=[10.0]'],
     "'excitation.amplitude' has 1 element, but arm.link_length has 2; give 2 numbers"),
    (['--set', 'payload_mas=2'], "did you mean 'payload_mass'"),
    (['--set', 'excitation.shape=sine'], 'choose one of'),
    (['--set', 'excitation.rate=500.0'], "the torque's 'rate' follows the plant; give the plant's 'rate' instead"),
    (['--set', 'excitation.arm.tip_mass=3.0'], "give the plant's 'arm.tip_mass' instead"),
    (['--payload', '-1'], "parameter 'payload_mass'"),
    (['--duration', '0'], '--duration'),
    (['--params', 'nothing.yaml'], 'does not exist'),
    (['--capture-time', '9'], 'the run ends at 6 s'),
    (['--capture-time', '5.9995'], 'the capture comes after the last sample, which is at 5.999 s'),
    (['--release-time', '2'], 'nothing is caught before'),
    (['--capture-time', '-1', '--release-time', '2'], 'nothing is caught before'),
])
def test_bad_arguments_are_one_line_and_exit_2(tmp_path, capsys, arguments, words):
    assert main([str(tmp_path / 'bag'), *arguments]) == 2
    err = capsys.readouterr().err
    assert words in err
    assert err.count('\n') == 1
    assert not (tmp_path / 'bag').exists()


def test_an_existing_recording_is_kept(tmp_path, capsys):
    path = _simulate(tmp_path)
    assert main([str(path)]) == 2
    assert 'exists already' in capsys.readouterr().err
