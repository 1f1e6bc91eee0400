"""The arm as viewers see it: ~/arm, whose shape is what the simulator says of the same arm."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from identifier_harness import CAPTURE, Live, recording
from ros_harness import Ros
from visualization_msgs.msg import Marker, MarkerArray

from flexmanip_ros.parameters import ArmParameters, IdentifierParameters, configure
from flexmanip_ros.ros import conversions
from flexmanip_ros.ros.arm_markers import ArmMarkers, draw, words
from flexmanip_ros.ros.nodes.rpbsid_identifier import TOPICS
from flexmanip_ros.types import JointRecord, Payload, Status

LAYOUTS = Path(__file__).resolve().parents[2] / 'config' / 'layouts'
RECORD = JointRecord(1_500_000_000, ('link2_bend', 'joint2', 'joint1', 'link1_bend'),
                     np.array([0.01, 0.5, 0.3, 0.02]), np.empty(0), np.empty(0))
ARM = ArmParameters(link_length=(3.0, 2.0), sensor_position=(0.5, 0.4))
HELD = Payload(20.0, 0.1, 19.8, 20.2, 1.0, Status.TRACKING, com=(0.1, 0.0, 0.0))


def by_name(drawn: MarkerArray | None) -> dict[str, Any]:
    assert drawn is not None
    return {f'{item.ns}{item.id}': item for item in drawn.markers}


def test_a_straight_arm_is_two_straight_lines_from_joint_to_joint() -> None:
    links, tip_angle = draw(ARM, np.array([np.pi / 2, -np.pi / 2]), np.zeros(2))
    np.testing.assert_allclose(links[0, [0, -1]], [[0.0, 0.0], [0.0, 3.0]], atol=1e-12)
    np.testing.assert_allclose(links[1, [0, -1]], [[0.0, 3.0], [2.0, 3.0]], atol=1e-12)
    assert tip_angle == pytest.approx(0.0)


@pytest.mark.parametrize('convention', ['encoder', 'chord'])
def test_the_deflection_of_the_sensor_point_from_the_chord_is_the_bend(convention: str) -> None:
    arm = replace(ARM, angle_convention=convention)
    bends = np.array([0.02, -0.03])
    links, _ = draw(arm, np.array([0.7, 0.4]), bends, points=11)  # 0.5 and 0.4 of a link are points
    for link, index in ((0, 5), (1, 4)):
        root, tip, there = links[link, 0], links[link, -1], links[link, index]
        along = (tip - root) / np.linalg.norm(tip - root)
        assert np.linalg.norm(tip - root) == pytest.approx(arm.link_length[link])
        assert along[0] * (there - root)[1] - along[1] * (there - root)[0] == pytest.approx(bends[link])


def test_an_encoder_reads_the_slope_of_the_root_from_the_tip_before_it() -> None:
    angles = np.array([0.3, 0.5])
    links, tip_angle = draw(ARM, angles, np.array([0.02, 0.01]), points=2001)
    first, last = (np.diff(line, axis=1) for line in (links[:, :2], links[:, -2:]))
    slopes, tips = (np.arctan2(part[:, 0, 1], part[:, 0, 0]) for part in (first, last))
    assert slopes[0] == pytest.approx(angles[0], abs=1e-4)
    assert slopes[1] - tips[0] == pytest.approx(angles[1], abs=1e-4)
    assert tip_angle == pytest.approx(tips[1], abs=1e-4)


def test_chord_angles_are_absolute() -> None:
    arm = replace(ARM, angle_convention='chord')
    links, _ = draw(arm, np.array([0.3, 0.5]), np.array([0.02, 0.01]))
    chords = links[:, -1] - links[:, 0]
    np.testing.assert_allclose(np.arctan2(chords[:, 1], chords[:, 0]), [0.3, 0.5])


def test_the_links_are_drawn_from_the_signals_by_name_and_the_object_at_its_centre_of_mass() -> None:
    config = IdentifierParameters(base_frame='world')
    found = by_name(ArmMarkers(config).message(RECORD, HELD))
    links, tip_angle = draw(config.arm, np.array([0.3, 0.5]), np.array([0.02, 0.01]))
    for link in range(2):
        points = np.array([(point.x, point.y) for point in found[f'link{link}'].points])
        np.testing.assert_array_equal(points, links[link])
    ball = found['object0']
    tip, angle = links[1, -1], tip_angle
    assert (ball.pose.position.x, ball.pose.position.y) == pytest.approx(
        (tip[0] + 0.1 * math.cos(angle), tip[1] + 0.1 * math.sin(angle)))
    assert 1000.0 * math.pi / 6.0 * ball.scale.x ** 3 == pytest.approx(20.0)  # as heavy as water
    assert found['payload0'].text == '20.00 kg (95 %: 19.80 to 20.20)'
    for item in found.values():
        assert item.header.frame_id == 'world'
        assert conversions.stamp_ns(item.header.stamp) == RECORD.stamp_ns


def test_no_text_is_shown_before_the_first_estimate() -> None:
    """RViz never draws a text that began empty."""
    for payload, action in ((None, Marker.DELETE), (HELD, Marker.ADD), (None, Marker.DELETE)):
        text = by_name(ArmMarkers(IdentifierParameters()).message(RECORD, payload))['payload0']
        assert text.action == action
        assert text.scale.x > 0.0  # else its spaces are those of letters of 1 m


def test_a_payload_that_is_not_known_is_no_ball_and_no_number() -> None:
    unknown = Payload(0.0, math.inf, 0.0, math.inf, 1.0, Status.INCONSISTENT)
    found = by_name(ArmMarkers(IdentifierParameters()).message(RECORD, unknown))
    assert found['object0'].action == Marker.DELETE
    assert found['payload0'].text.startswith('payload not known: ')
    assert words(unknown._replace(status=Status.WARMING_UP)).endswith('take some tenths of a second')  # it runs
    assert words(HELD._replace(status=Status.INCONSISTENT)).startswith('not reliable: 20.00 kg')
    assert words(None) == ''


def test_a_record_without_an_angle_or_with_nan_is_not_drawn_and_one_without_bends_is_straight() -> None:
    markers = ArmMarkers(IdentifierParameters())
    assert markers.message(RECORD._replace(names=('a', 'b', 'c', 'd')), None) is None
    assert markers.message(RECORD._replace(position=np.array([0.01, math.nan, 0.3, 0.02])), None) is None
    first = by_name(markers.message(RECORD._replace(names=('x', 'joint2', 'joint1', 'y')), None))['link0'].points
    assert math.atan2(first[5].y, first[5].x) == pytest.approx(0.3)


@pytest.mark.parametrize('changes', [{'angles': ()}, {'outputs': ('joint1/effort',), 'order': 2}])
def test_another_machine_is_not_drawn(changes: dict[str, Any]) -> None:
    assert not ArmMarkers(configure(IdentifierParameters, changes)).drawn


def test_the_identifier_shows_the_latest_sample_and_what_it_holds_when_somebody_listens(ros: Ros) -> None:
    heard = ros.listen(MarkerArray, '/rpbsid_identifier/arm', 10)
    live = Live(ros)
    ros.wait(lambda: live.node.arm.get_subscription_count() == 1)
    live.events.publish(conversions.to_message(CAPTURE))
    samples = recording(700)
    live.send(*samples)
    ros.wait(lambda: heard and conversions.stamp_ns(heard[-1].markers[0].header.stamp) == samples[-1].stamp_ns,
             what='the arm at the last sample')
    assert ' kg' in heard[-1].markers[-1].text
    assert len(heard) < 100  # 25 a second, not one a sample


def test_nothing_is_drawn_for_nobody(ros: Ros, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[JointRecord] = []
    monkeypatch.setattr(ArmMarkers, 'message', lambda self, record, payload: drawn.append(record))
    live = Live(ros)
    live.send(*recording(100))
    ros.wait(lambda: live.node._latest is None, what='the timer')
    assert drawn == []


def topics(value: Any) -> set[str]:
    """Return the topics that a layout names."""
    if isinstance(value, dict):
        return {name for part in [*value, *value.values()] for name in topics(part)}
    if isinstance(value, list):
        return {name for part in value for name in topics(part)}
    found = re.match(r'/[\w/]+', value) if isinstance(value, str) else None
    return {found[0]} if found else set()


def test_the_layouts_show_topics_that_there_are() -> None:
    known = {f'/rpbsid_identifier/{name}' for name in (*TOPICS, 'arm')} | {
        '/joint_states', '/diagnostics', '/robot_description'}
    layout = json.loads((LAYOUTS / 'foxglove.json').read_text(encoding='utf-8'))
    for shown in (topics(layout), topics(yaml.safe_load((LAYOUTS / 'arm.rviz').read_text(encoding='utf-8')))):
        assert '/rpbsid_identifier/arm' in shown
        assert shown <= known
    panels = set(re.findall(r'"(?:first|second)": "([^"]+)"', json.dumps(layout['layout'])))
    assert panels == set(layout['configById'])
