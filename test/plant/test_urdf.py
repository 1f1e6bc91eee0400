"""The URDF: read by the ROS parser, and its tip where the plant's tip is."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from flexmanip_ros.arm import manipulator
from flexmanip_ros.cli import write_urdf
from flexmanip_ros.cli.write_urdf import urdf
from flexmanip_ros.errors import ModelError, ParameterError
from flexmanip_ros.io.parameter_file import load_arm
from flexmanip_ros.parameters import ArmParameters
from flexmanip_ros.types import Array

ARM = ArmParameters(shape_functions='sines', modes=1, sensor_position=(0.5, 0.4), shortening=False)
ROBOT = pytest.importorskip('urdf_parser_py.urdf').URDF.from_xml_string(urdf(ARM).encode())
JOINTS = {joint.name: joint for joint in ROBOT.joints}
NAMED = {'joint1', 'joint2', 'link1_bend', 'link2_bend'}


def place(link: str, states: dict[str, float]) -> Array:
    """Planar pose (3, 3) of a link for JointState positions, as robot_state_publisher finds it."""
    pose = np.eye(3)
    while link in ROBOT.parent_map:
        name, link = ROBOT.parent_map[link]
        joint = JOINTS[name]
        value = states.get(name, 0.0)
        if joint.mimic:
            value = joint.mimic.multiplier * states[joint.mimic.joint] + joint.mimic.offset
        own = np.eye(3)
        own[:2, 2] = joint.origin.xyz[:2]
        if joint.type == 'continuous':
            own[:2, :2] = [[np.cos(value), -np.sin(value)], [np.sin(value), np.cos(value)]]
        elif joint.type == 'prismatic':
            own[:2, 2] += value * np.array(joint.axis[:2])
        pose = own @ pose
    return pose


def states_of(q: Array) -> dict[str, float]:
    names = ('joint1', 'joint2', 'link1_bend', 'link2_bend')
    return dict(zip(names, manipulator.manipulator(ARM).output @ q, strict=True))


def test_the_parser_reads_a_tree_of_the_documented_frames() -> None:
    assert ROBOT.get_root() == 'base_link'
    assert NAMED.issubset(JOINTS)
    assert {'link2_tip', 'link1_end', 'link2_end'} <= {link.name for link in ROBOT.links}
    for name, joint in JOINTS.items():
        if name not in NAMED and joint.type != 'fixed':
            assert joint.mimic.joint in ('link1_bend', 'link2_bend')


def test_masses_are_the_arms() -> None:
    masses = [link.inertial.mass for link in ROBOT.links if link.inertial]
    assert sum(masses) == pytest.approx(2 * 15.0 + 10.0 + 10.0)


@pytest.mark.parametrize('bends', [(0.0, 0.0), (0.05, -0.03), (-0.1, 0.1)])
def test_the_tip_is_where_the_plant_has_it(bends: tuple[float, float]) -> None:
    q = np.array([0.6, 1.3, *bends])
    tip = place('link2_tip', states_of(q))
    reach = 3.0 - np.pi**2 * np.square(bends) / 12.0  # a bent link keeps its length and shortens its chord
    chords = [L * np.array([np.cos(a), np.sin(a)]) for a, L in zip(q[:2], reach, strict=True)]
    assert tip[:2, 2] == pytest.approx(sum(chords), abs=5e-4)
    heading = np.arctan2(tip[1, 0], tip[0, 0])
    assert heading == pytest.approx(q[1] - np.pi / 3 * q[3], abs=1e-3)


def test_the_sensors_sit_on_the_bent_links() -> None:
    q = np.array([0.6, 1.3, 0.05, -0.03])
    states = states_of(q)
    sensor = place('link1_bend_sensor', states)[:2, 2]
    e, n = np.array([np.cos(0.6), np.sin(0.6)]), np.array([-np.sin(0.6), np.cos(0.6)])
    assert sensor == pytest.approx(1.5 * e + 0.05 * n, abs=1e-9)
    middle = place('link1_segment7', states)[:2, 2]
    assert middle == pytest.approx(sensor, abs=3e-3)


def test_one_segment_cannot_bend() -> None:
    with pytest.raises(ModelError, match='segments'):
        urdf(ARM, segments=1)


def test_an_arm_of_chord_angles_is_refused_as_its_joints_would_be_drawn_wrong(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert write_urdf.main(['--set', 'arm.angle_convention=chord']) == 2
    told = capsys.readouterr()
    assert told.out == ''
    assert 'publish encoder angles and give arm.angle_convention encoder' in told.err


def test_more_segments_than_any_viewer_draws_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    """A hundred million of them would fill the memory before anything is written."""
    with pytest.raises(SystemExit, match='2'):
        write_urdf.main(['--segments', '100000000'])
    assert "'100000000' is not a whole number from 0 to 10000" in capsys.readouterr().err


def test_the_program_writes_what_the_library_makes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str],
) -> None:
    target = tmp_path / 'arm.urdf'
    assert write_urdf.main(['--segments', '4', '--output', str(target)]) == 0
    assert target.read_text() == urdf(ArmParameters(), 4)
    assert write_urdf.main(['--set', 'arm.modes=many']) == 2
    assert 'arm.modes' in capsys.readouterr().err
    assert write_urdf.main(['--set', 'arm.link_length=[1e120, 1.0]']) == 2
    assert "'arm.link_length' is 1e+120 m; give a value from 1e-09 to 1e+06 m" in capsys.readouterr().err


@pytest.mark.parametrize('place', ['.', '/', ''])
def test_a_place_that_is_no_file_is_one_line(place: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert write_urdf.main(['--output', place]) == 2
    told = capsys.readouterr()
    assert (told.out, told.err) == ('', f"write_urdf: '{place}' is a directory; give a file name\n")


def test_the_program_needs_no_library_of_recordings(tmp_path: Path) -> None:
    code = "import sys; sys.modules['rosbags'] = None; from flexmanip_ros.cli import write_urdf; " \
           "sys.exit(write_urdf.main(['--output', sys.argv[1]]))"
    done = subprocess.run(
        [sys.executable, '-c', code, tmp_path / 'arm.urdf'], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, '')


@pytest.mark.parametrize('section', ['/**', 'rpbsid_identifier', 'plant_simulator'])
def test_the_arm_of_any_parameter_file_is_drawn(section: str, tmp_path: Path) -> None:
    path = tmp_path / 'my_arm.yaml'
    more = {'/**': 'order: 6', 'rpbsid_identifier': 'order: 6', 'plant_simulator': 'rate: 500.0'}[section]
    path.write_text(f'{section}:\n  ros__parameters: {{{more}, arm: {{joint_mass: 1.2, bend_delay: -0.001}}}}\n',
                    encoding='utf-8')
    assert load_arm(path).joint_mass == 1.2  # of a measured arm, whose bends may come before its angles
    path.write_text(f'{section}:\n  ros__parameters: {{{more}}}\n', encoding='utf-8')
    with pytest.raises(ParameterError, match=r'has no parameters arm'):
        load_arm(path)
