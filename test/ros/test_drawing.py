"""The drawn arm against what the simulator says of the same arm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from visualization_msgs.msg import Marker

from flexmanip_ros.parameters import ArmParameters, IdentifierParameters
from flexmanip_ros.ros.arm_markers import ArmMarkers, draw
from flexmanip_ros.types import JointRecord, Payload, Status

ARM = ArmParameters(link_length=(3.0, 2.0), sensor_position=(0.5, 0.4))


def test_a_straight_arm_is_two_straight_lines_from_joint_to_joint() -> None:
    drawn = draw(ARM, np.array([np.pi / 2, -np.pi / 2]), np.zeros(2))
    np.testing.assert_allclose(drawn.links[0, [0, -1]], [[0.0, 0.0], [0.0, 3.0]], atol=1e-12)
    np.testing.assert_allclose(drawn.links[1, [0, -1]], [[0.0, 3.0], [2.0, 3.0]], atol=1e-12)
    assert drawn.tip_angle == pytest.approx(0.0)


@pytest.mark.parametrize('convention', ['encoder', 'chord'])
def test_the_deflection_of_the_sensor_point_from_the_chord_is_the_bend(convention: str) -> None:
    arm = replace(ARM, angle_convention=convention)
    bends = np.array([0.02, -0.03])
    drawn = draw(arm, np.array([0.7, 0.4]), bends, points=11)  # 0.5 and 0.4 of a link are points
    for link, index in ((0, 5), (1, 4)):
        root, tip, there = drawn.links[link, 0], drawn.links[link, -1], drawn.links[link, index]
        along = (tip - root) / np.linalg.norm(tip - root)
        assert np.linalg.norm(tip - root) == pytest.approx(arm.link_length[link])
        assert along[0] * (there - root)[1] - along[1] * (there - root)[0] == pytest.approx(bends[link])


def test_an_encoder_reads_the_slope_of_the_root_from_the_tip_before_it() -> None:
    angles = np.array([0.3, 0.5])
    drawn = draw(ARM, angles, np.array([0.02, 0.01]), points=2001)
    first, last = (np.diff(line, axis=1) for line in (drawn.links[:, :2], drawn.links[:, -2:]))
    slopes, tips = (np.arctan2(part[:, 0, 1], part[:, 0, 0]) for part in (first, last))
    assert slopes[0] == pytest.approx(angles[0], abs=1e-4)
    assert slopes[1] - tips[0] == pytest.approx(angles[1], abs=1e-4)
    assert drawn.tip_angle == pytest.approx(tips[1], abs=1e-4)


def test_chord_angles_are_absolute() -> None:
    arm = replace(ARM, angle_convention='chord')
    drawn = draw(arm, np.array([0.3, 0.5]), np.array([0.02, 0.01]))
    chords = drawn.links[:, -1] - drawn.links[:, 0]
    np.testing.assert_allclose(np.arctan2(chords[:, 1], chords[:, 0]), [0.3, 0.5])


def test_no_text_is_shown_before_the_first_estimate() -> None:
    """RViz never draws a text that began empty."""
    config = IdentifierParameters()
    names = tuple(name.rpartition('/')[0] for name in (*config.angles, *config.outputs[:2]))
    record = JointRecord(0, names, np.zeros(4), np.zeros(4), np.zeros(4))
    known = Payload(20.0, 0.1, 19.8, 20.2, 1.0, Status.TRACKING)
    for payload, action in ((None, Marker.DELETE), (known, Marker.ADD), (None, Marker.DELETE)):
        drawn = ArmMarkers(config).message(record, payload)
        assert drawn is not None
        text = next(marker for marker in drawn.markers if marker.ns == 'payload')
        assert text.action == action
        assert text.scale.x > 0.0  # else its spaces are those of letters of 1 m
