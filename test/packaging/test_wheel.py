"""The package installs with pip: an sdist and a wheel, whose offline programs need no ROS."""

from __future__ import annotations

import re
import tarfile
import zipfile
from email.parser import HeaderParser
from pathlib import Path

import pytest
from fresh_environment import Fresh

NODES = ('plant_simulator', 'excitation', 'capture_trigger', 'rpbsid_identifier', 'payload_controller')
OFFLINE = ('identify_bag', 'simulate_bag', 'reproduce_paper', 'monte_carlo', 'write_urdf')

pytestmark = pytest.mark.timeout(2400)  # libraries are downloaded and kernels compiled, on a machine that may be busy


def metadata(wheel: Path) -> list[str]:
    with zipfile.ZipFile(wheel) as archive:
        name = next(name for name in archive.namelist() if name.endswith('.dist-info/METADATA'))
        return HeaderParser().parsestr(archive.read(name).decode()).get_all('Requires-Dist') or []


def test_the_sdist_holds_what_a_wheel_is_built_from(sdist: Path) -> None:
    with tarfile.open(sdist) as archive:
        names = {name.partition('/')[2] for name in archive.getnames()}
    assert names >= {'setup.py', 'setup.cfg', 'pyproject.toml', 'package.xml', 'README.md', 'LICENSE',
                     'config/arms/quanser.yaml', 'launch/demo.launch.py', 'resource/flexmanip_ros',
                     'flexmanip_ros/py.typed'}


def test_without_the_extra_the_wheel_asks_for_no_ros_package(wheel: Path) -> None:
    always = [line for line in metadata(wheel) if 'extra ==' not in line]
    assert any(line.startswith('rosbags') for line in always)
    assert [line for line in always if line.startswith('ros-') or 'rclpy' in line] == []
    assert any(line.startswith('ros-jazzy-rclpy') and 'extra == "ros"' in line.replace("'", '"')
               for line in metadata(wheel))


def test_the_wheel_has_ordinary_console_scripts_and_the_shared_files(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        points = next(name for name in names if name.endswith('.dist-info/entry_points.txt'))
        scripts = set(re.findall(r'^(\w+) = ', archive.read(points).decode(), re.MULTILINE))
    assert set(NODES) | set(OFFLINE) <= scripts
    assert not [name for name in names if 'lib/flexmanip_ros' in name or '/scripts/' in name]
    assert any(name.endswith('.data/data/share/flexmanip_ros/config/scenarios/capture.yaml') for name in names)


def test_a_fresh_environment_has_no_ros_and_its_scripts_lie_in_bin(fresh: Fresh) -> None:
    assert not fresh.has_ros
    assert {path.name for path in fresh.bin.iterdir()} >= {*OFFLINE, *NODES, 'demo'}
    assert (fresh.bin.parent / 'share/flexmanip_ros/config/scenarios/capture.yaml').is_file()


def test_a_node_without_ros_says_what_it_lacks(fresh: Fresh) -> None:
    assert fresh.node.returncode == 1
    assert "pip install 'flexmanip_ros[ros]'" in fresh.node.stderr.splitlines()[-1]
