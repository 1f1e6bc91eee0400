"""Recordings in, recordings out."""

from __future__ import annotations

import resource
import shutil
from contextlib import contextmanager

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import DATA, NAMES, START, good_part, joint_state_record, needs_data, storage_file, write
from rosbags.rosbag2 import Reader, StoragePlugin
from rosbags.typesys import Stores, get_typestore

from flexmanip_ros.errors import BagError
from flexmanip_ros.io import bag, cdr
from flexmanip_ros.io.bag_writer import BagWriter
from flexmanip_ros.messages import Diagnostics, DiagnosticStatus, Inertia, model_matrix
from flexmanip_ros.types import DATING_STD_S, CaptureEvent, EventKind, JointRecord, StateSpace


@pytest.mark.parametrize('storage', list(StoragePlugin))
@pytest.mark.parametrize('velocity', [True, False])
@pytest.mark.parametrize('bare_file', [True, False])
def test_what_is_written_is_read_bit_for_bit_in_recorded_order(tmp_path, storage, velocity, bare_file):
    path = write(tmp_path / 'bag', storage=storage, velocity=velocity)
    items = list(bag.read(storage_file(path) if bare_file else path))
    assert isinstance(items[20], CaptureEvent)
    records = [item for item in items if isinstance(item, JointRecord)]
    assert len(records) == 50
    for k, record in enumerate(records):
        expected = joint_state_record(k, velocity=velocity)
        assert (record.stamp_ns, record.names) == (expected.stamp_ns, NAMES)
        for field in ('position', 'velocity', 'effort'):
            np.testing.assert_array_equal(getattr(record, field), getattr(expected, field))


@settings(max_examples=40, deadline=None)
@given(st.lists(st.text(max_size=9).filter(lambda s: '\0' not in s), max_size=5), st.text(max_size=5),
       st.integers(0, 2), st.integers(0, 2**31 - 1), st.integers(0, 999_999_999))
def test_the_fast_decoder_agrees_with_the_library(names, frame, missing, sec, nanosec):
    frame = frame.replace('\0', '')
    store = get_typestore(Stores.ROS2_JAZZY)
    kinds = store.types
    arrays = [np.arange(len(names), dtype=np.float64) + k for k in range(3)]
    arrays[missing] = np.empty(0)
    header = kinds['std_msgs/msg/Header'](kinds['builtin_interfaces/msg/Time'](sec, nanosec), frame)
    raw = bytes(store.serialize_cdr(kinds['sensor_msgs/msg/JointState'](header, names, *arrays),
                                    'sensor_msgs/msg/JointState'))
    decoder = cdr.Decoder()
    for record in (decoder.record(raw), decoder.record(raw)):
        assert (record.names, record.stamp_ns) == (tuple(names), sec * 10**9 + nanosec)
        for field, expected in zip(('position', 'velocity', 'effort'), arrays, strict=True):
            np.testing.assert_array_equal(getattr(record, field), expected)


def test_names_that_change_in_mid_recording_are_followed():
    store = get_typestore(Stores.ROS2_JAZZY)
    kinds = store.types
    decoder = cdr.Decoder()
    for names in (['a1', 'b1'], ['b1', 'a1'], ['longer', 'x'], []):
        header = kinds['std_msgs/msg/Header'](kinds['builtin_interfaces/msg/Time'](1, 2), '')
        values = np.zeros(len(names))
        message = kinds['sensor_msgs/msg/JointState'](header, names, values, values, values)
        record = decoder.record(bytes(store.serialize_cdr(message, 'sensor_msgs/msg/JointState')))
        assert record.names == tuple(names)


def test_every_kind_of_message_is_written_as_its_ros_type(tmp_path):
    model = StateSpace(np.eye(2), np.ones((2, 1)), np.ones((1, 2)), np.zeros((1, 1)), np.ones((2, 1)), 0.001)
    status = DiagnosticStatus(1, 'identifier', 'warming up', '', (('rate', '1000'),))
    with BagWriter(tmp_path / 'bag') as writer:
        writer.write('/n/payload_mass', START, 20.5)
        writer.write('/n/model', START, model_matrix(model), latched=True)
        held = Inertia(START, 'tip', 20.5, (0.0, 1.0, 2.0), (1.0, 0, 0, 2.0, 0, 3.0))
        writer.write('/n/payload', START, held)
        writer.write('/diagnostics', START, Diagnostics(START, (status,)))
    store = get_typestore(Stores.ROS2_JAZZY)
    with Reader(tmp_path / 'bag') as reader:
        seen = {c.topic: store.deserialize_cdr(raw, c.msgtype) for c, _, raw in reader.messages()}
    assert seen['/n/payload_mass'].data == 20.5
    assert seen['/n/model'].layout.dim[0].label == 'rows: state=2 output=1 dt=0.001'
    assert seen['/n/payload'].inertia.com.z == 2.0
    assert seen['/n/payload'].header.frame_id == 'tip'
    assert seen['/diagnostics'].status[0].values[0].key == 'rate'


def test_an_existing_recording_is_not_overwritten(tmp_path):
    write(tmp_path / 'bag')
    with pytest.raises(BagError, match='exists already; remove it'):
        BagWriter(tmp_path / 'bag')


def test_a_place_that_cannot_be_written_is_said(tmp_path):
    (tmp_path / 'file').write_text('')
    with pytest.raises(BagError, match='cannot be written'):
        BagWriter(tmp_path / 'file' / 'bag')


def test_an_exception_while_recording_leaves_a_whole_bag(tmp_path):
    with pytest.raises(ZeroDivisionError), BagWriter(tmp_path / 'bag') as writer:
        writer.write('/joint_states', START, joint_state_record(0)) or 1 / 0
    assert len(list(bag.read(tmp_path / 'bag'))) == 1


@contextmanager
def _file_size(limit):
    """Limit the size of a file [bytes], as a full disk does."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize(('limit', 'words', 'least'), [
    (100_000, "earlier messages are on the disk; free some space, then run 'ros2 bag reindex'", 100),
    (100, 'no message is on the disk; free some space, remove it, run again', 0),
])
def test_a_recording_that_cannot_be_finished_says_whether_messages_are_kept(tmp_path, limit, words, least):
    with pytest.raises(BagError, match=words), _file_size(limit):
        write(tmp_path / 'bag', 2000)
    kept = good_part(storage_file(tmp_path / 'bag'))[0]
    assert len(kept) >= least
    assert bool(kept) == bool(least)


def test_a_killed_recorder_loses_only_what_was_not_flushed(tmp_path):
    writer = BagWriter(tmp_path / 'bag')
    for k in range(30):
        writer.write('/joint_states', START + k, joint_state_record(k))
    writer.flush()
    writer.write('/joint_states', START + 30, joint_state_record(30))
    copy = tmp_path / 'copy'
    shutil.copytree(tmp_path / 'bag', copy)  # what a kill would leave
    writer.close()
    items, line = good_part(copy)
    assert len(items) == 30
    assert '30 messages' in line


def test_a_namespace_is_found_and_two_are_asked_about(tmp_path):
    path = write(tmp_path / 'one', topic='/arm/joint_states')
    assert len(list(bag.read(path))) == 51
    with BagWriter(tmp_path / 'two') as writer:
        writer.write('/left/joint_states', START, joint_state_record(0))
        writer.write('/right/joint_states', START, joint_state_record(0))
        writer.write('/right/capture_event', START, CaptureEvent(START, EventKind.CAPTURE))
    said = good_part(tmp_path / 'two')[1]
    assert 'several topics' in said
    assert '--joint-states /left/joint_states' in said
    assert len(list(bag.read(tmp_path / 'two', bag.Topics('/left/joint_states')))) == 1
    assert len(list(bag.read(tmp_path / 'two', bag.Topics('/right/joint_states')))) == 2


@pytest.mark.parametrize(('topic', 'std_s'), [('/arm/capture_event', 0.0), ('/arm/capture_detected', DATING_STD_S)])
def test_the_instant_of_an_event_is_known_where_it_was_announced_and_not_where_it_was_detected(tmp_path, topic, std_s):
    event = CaptureEvent(START, EventKind.CAPTURE)
    with BagWriter(tmp_path / 'bag') as writer:
        writer.write('/arm/joint_states', START, joint_state_record(0))
        writer.write(topic, START, event)
    assert list(bag.read(tmp_path / 'bag'))[-1] == event._replace(std_s=std_s)


def test_progress_is_told_from_the_metadata(tmp_path):
    seen: list[tuple[int, int | None]] = []
    list(bag.read(write(tmp_path / 'bag', 5000), progress=lambda done, total: seen.append((done, total))))
    assert [total for _, total in seen] == [5001] * len(seen)
    done = [done for done, _ in seen]
    assert done == sorted(done)
    assert len(done) >= 3
    assert done[-1] == 5001


@needs_data
@pytest.mark.parametrize(('name', 'count', 'events'), [
    ('physics_20kg_60_45', 6000, 1), ('physics_100kg_0_0', 6000, 1),
    ('quanser_2dsfl_first_half', 5000, 0), ('daisy_robot_arm', 1024, 0)])
def test_recordings_of_others_are_read(name, count, events):
    items = list(bag.read(DATA / name))
    assert sum(isinstance(item, JointRecord) for item in items) == count
    assert sum(isinstance(item, CaptureEvent) for item in items) == events
