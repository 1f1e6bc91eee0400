from __future__ import annotations

import numpy as np
import pytest
from geometry_msgs.msg import InertiaStamped
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

from flexmanip_ros.errors import SignalError
from flexmanip_ros.messages import Inertia, LabelledArray
from flexmanip_ros.ros import conversions
from flexmanip_ros.types import CaptureEvent, EventKind, JointRecord

STAMPS = st.integers(0, 2**31 * 10**9 - 1)
VALUES = arrays(np.float64, st.integers(0, 6), elements=st.floats(width=64))
NAMES = st.lists(st.text(st.characters(blacklist_characters='\0', blacklist_categories=('Cs',)), max_size=9),
                 max_size=6)


@st.composite
def records(draw: st.DrawFn) -> JointRecord:
    return JointRecord(draw(STAMPS), tuple(draw(NAMES)), draw(VALUES), draw(VALUES), draw(VALUES))


def same(a: JointRecord, b: JointRecord) -> bool:
    fields = ('position', 'velocity', 'effort')
    return (a.stamp_ns, a.names) == (b.stamp_ns, b.names) and all(
        getattr(a, field).tobytes() == getattr(b, field).tobytes() for field in fields)


@given(records())
def test_a_record_survives_the_message_and_the_wire_bit_for_bit(record: JointRecord) -> None:
    message = conversions.to_message(record)
    assert same(conversions.joint_record(message), record)
    assert same(conversions.JointStateReader()(serialize_message(message)), record)


@given(st.lists(records(), min_size=2, max_size=5))
def test_a_reader_follows_messages_whose_layout_changes(several: list[JointRecord]) -> None:
    read = conversions.JointStateReader()
    for record in (*several, *several):
        assert same(read(serialize_message(conversions.to_message(record))), record)


def test_a_record_keeps_its_own_arrays_when_the_message_is_used_again() -> None:
    message = JointState(name=['a'], position=[1.0])
    record = conversions.joint_record(message)
    message.position[0] = 2.0
    assert record.position[0] == 1.0


@given(STAMPS, st.sampled_from(EventKind))
def test_an_event_survives_its_header(stamp: int, kind: EventKind) -> None:
    event = CaptureEvent(stamp, kind)
    assert conversions.capture_event(conversions.to_message(event)) == event


def test_a_header_that_is_no_event_is_refused_by_name() -> None:
    with pytest.raises(SignalError, match="frame_id 'world'; write one of capture, release"):
        conversions.capture_event(Header(frame_id='world'))


@given(arrays(np.float64, (2, 3), elements=st.floats(width=64)))
def test_a_labelled_array_survives_its_message(data: np.ndarray) -> None:
    got = conversions.to_message(LabelledArray(('rows', 'columns'), data))
    assert [(item.label, item.size, item.stride) for item in got.layout.dim] == [('rows', 2, 6), ('columns', 3, 3)]
    assert got.data.tobytes() == data.tobytes()


def test_an_inertia_survives_its_message() -> None:
    sent = Inertia(1_500_000_001, 'link2_tip', 20.5, (0.1, 0.2, 0.3), (1.0, 2.0, 3.0, 4.0, 5.0, 6.0))
    got = deserialize_message(serialize_message(conversions.to_message(sent)), InertiaStamped)
    body, com = got.inertia, got.inertia.com
    assert Inertia(conversions.stamp_ns(got.header.stamp), got.header.frame_id, body.m, (com.x, com.y, com.z),
                   (body.ixx, body.ixy, body.ixz, body.iyy, body.iyz, body.izz)) == sent
