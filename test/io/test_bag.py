"""Recordings in, recordings out, and every way a recording can be broken."""

from __future__ import annotations

import os
import shutil
import sqlite3
import threading
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from flexmanip_ros.errors import BagError
from flexmanip_ros.io import bag
from flexmanip_ros.io.bag_writer import BagWriter
from flexmanip_ros.messages import (
    Diagnostics,
    DiagnosticStatus,
    Inertia,
    model_matrix,
)
from flexmanip_ros.types import CaptureEvent, EventKind, JointRecord, StateSpace

DATA = Path(os.environ.get('FLEXMANIP_DATA', Path(__file__).parents[3] / 'shared' / 'data'))
START = 1_700_000_000_000_000_000
NAMES = ('joint1', 'joint2', 'link1_bend', 'link2_bend')
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason='measured recordings are not in ../shared/data')


def _record(k: int, *, velocity: bool = True) -> JointRecord:
    rng = np.random.default_rng(k)
    return JointRecord(START + k * 1_000_000, NAMES, rng.normal(size=4),
                       rng.normal(size=4) if velocity else np.empty(0), rng.normal(size=4))


def _write(path: Path, count: int = 50, storage: StoragePlugin = StoragePlugin.MCAP,
           topic: str = '/joint_states', event_at: int | None = 20, velocity: bool = True) -> Path:
    with BagWriter(path, storage=storage) as writer:
        for k in range(count):
            record = _record(k, velocity=velocity)
            if k == event_at:
                event = CaptureEvent(record.stamp_ns, EventKind.CAPTURE)
                writer.write('/capture_event', record.stamp_ns, event)
            writer.write(topic, record.stamp_ns, record)
    return path


def _file(path: Path) -> Path:
    return next(file for file in path.iterdir() if file.suffix in ('.mcap', '.db3'))


def _good_part(path: Path) -> tuple[list[bag.Item], str]:
    """Read until the error; return what came before and its line."""
    items: list[bag.Item] = []
    with pytest.raises(BagError) as caught:
        items.extend(bag.read(path))  # keeps what came before the error
    assert '\n' not in str(caught.value)
    return items, str(caught.value)


@pytest.mark.parametrize('storage', list(StoragePlugin))
@pytest.mark.parametrize('velocity', [True, False])
@pytest.mark.parametrize('bare_file', [True, False])
def test_what_is_written_is_read_bit_for_bit_in_recorded_order(tmp_path, storage, velocity, bare_file):
    path = _write(tmp_path / 'bag', storage=storage, velocity=velocity)
    items = list(bag.read(_file(path) if bare_file else path))
    assert isinstance(items[20], CaptureEvent)
    records = [item for item in items if isinstance(item, JointRecord)]
    assert len(records) == 50
    for k, record in enumerate(records):
        expected = _record(k, velocity=velocity)
        assert (record.stamp_ns, record.names) == (expected.stamp_ns, NAMES)
        for field in ('position', 'velocity', 'effort'):
            np.testing.assert_array_equal(getattr(record, field), getattr(expected, field))


@settings(max_examples=40, deadline=None)
@given(st.lists(st.text(max_size=9).filter(lambda s: '\0' not in s), max_size=5), st.text(max_size=5),
       st.integers(0, 2), st.integers(0, 2**31 - 1), st.integers(0, 999_999_999))
def test_the_fast_decoder_agrees_with_the_library(names, frame, missing, sec, nanosec):
    from flexmanip_ros.io import cdr

    frame = frame.replace('\0', '')
    store = get_typestore(Stores.ROS2_JAZZY)
    kinds = store.types
    arrays = [np.arange(len(names), dtype=np.float64) + k for k in range(3)]
    arrays[missing] = np.empty(0)
    header = kinds['std_msgs/msg/Header'](kinds['builtin_interfaces/msg/Time'](sec, nanosec), frame)
    raw = bytes(store.serialize_cdr(kinds['sensor_msgs/msg/JointState'](header, names, *arrays),
                                    'sensor_msgs/msg/JointState'))
    first, layout = cdr.joint_record(raw, None)
    again, _ = cdr.joint_record(raw, layout)
    for record in (first, again):
        assert (record.names, record.stamp_ns) == (tuple(names), sec * 10**9 + nanosec)
        for field, expected in zip(('position', 'velocity', 'effort'), arrays, strict=True):
            np.testing.assert_array_equal(getattr(record, field), expected)


def test_names_that_change_in_mid_recording_are_followed():
    from flexmanip_ros.io import cdr

    store = get_typestore(Stores.ROS2_JAZZY)
    kinds = store.types
    layout = None
    for names in (['a1', 'b1'], ['b1', 'a1'], ['longer', 'x'], []):
        header = kinds['std_msgs/msg/Header'](kinds['builtin_interfaces/msg/Time'](1, 2), '')
        values = np.zeros(len(names))
        message = kinds['sensor_msgs/msg/JointState'](header, names, values, values, values)
        record, layout = cdr.joint_record(
            bytes(store.serialize_cdr(message, 'sensor_msgs/msg/JointState')), layout)
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
    _write(tmp_path / 'bag')
    with pytest.raises(BagError, match='exists already; remove it'):
        BagWriter(tmp_path / 'bag')


def test_a_place_that_cannot_be_written_is_said(tmp_path):
    (tmp_path / 'file').write_text('')
    with pytest.raises(BagError, match='cannot be written'):
        BagWriter(tmp_path / 'file' / 'bag')


def test_an_exception_while_recording_leaves_a_whole_bag(tmp_path):
    with pytest.raises(TypeError), BagWriter(tmp_path / 'bag') as writer:
        writer.write('/joint_states', START, _record(0)) or writer.write('/x', START, 'a text')
    assert len(list(bag.read(tmp_path / 'bag'))) == 1


def test_a_killed_recorder_loses_only_what_was_not_flushed(tmp_path):
    writer = BagWriter(tmp_path / 'bag')
    for k in range(30):
        writer.write('/joint_states', START + k, _record(k))
    writer.flush()
    writer.write('/joint_states', START + 30, _record(30))
    copy = tmp_path / 'copy'
    shutil.copytree(tmp_path / 'bag', copy)  # what a kill would leave
    writer.close()
    items, line = _good_part(copy)
    assert len(items) == 30
    assert '30 messages' in line


def test_several_threads_may_write(tmp_path):
    with BagWriter(tmp_path / 'bag') as writer:
        def fill(topic: str) -> None:
            for k in range(100):
                writer.write(topic, START + k, _record(k))
        threads = [threading.Thread(target=fill, args=(f'/t{i}',)) for i in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    with Reader(tmp_path / 'bag') as reader:
        assert sum(1 for _ in reader.messages()) == 400


def test_a_namespace_is_found_and_two_are_asked_about(tmp_path):
    path = _write(tmp_path / 'one', topic='/arm/joint_states')
    assert len(list(bag.read(path))) == 51
    with BagWriter(tmp_path / 'two') as writer:
        writer.write('/left/joint_states', START, _record(0))
        writer.write('/right/joint_states', START, _record(0))
        writer.write('/right/capture_event', START, CaptureEvent(START, EventKind.CAPTURE))
    assert 'several topics' in _good_part(tmp_path / 'two')[1]
    assert len(list(bag.read(tmp_path / 'two', bag.Topics('/left/joint_states')))) == 1
    assert len(list(bag.read(tmp_path / 'two', bag.Topics('/right/joint_states')))) == 2


def test_missing_things_are_named(tmp_path):
    assert 'does not exist' in _good_part(tmp_path / 'nothing')[1]
    (tmp_path / 'folder').mkdir()
    assert 'metadata.yaml' in _good_part(tmp_path / 'folder')[1]
    (tmp_path / 'notes.txt').write_text('words')
    assert 'is not a bag' in _good_part(tmp_path / 'notes.txt')[1]
    (tmp_path / 'old.bag').write_text('#ROSBAG V2.0')
    assert 'ROS 1' in _good_part(tmp_path / 'old.bag')[1]
    for name in ('a.mcap', 'a.db3'):
        (tmp_path / name).write_bytes(b'')
        assert 'is empty' in _good_part(tmp_path / name)[1]
        (tmp_path / name).write_bytes(b'something else entirely' * 100)
        assert 'cannot be read' in _good_part(tmp_path / name)[1]


def test_a_missing_topic_is_answered_with_those_that_are_there(tmp_path):
    path = _write(tmp_path / 'bag', topic='/other')
    line = _good_part(path)[1]
    assert '/other (sensor_msgs/msg/JointState)' in line
    assert '/capture_event (std_msgs/msg/Header)' in line


@pytest.mark.parametrize('topic', ['/joint_states', '/capture_event'])
def test_a_topic_of_the_wrong_type_is_said(tmp_path, topic):
    with BagWriter(tmp_path / 'bag') as writer:
        writer.write('/joint_states' if topic != '/joint_states' else '/x', START, _record(0))
        writer.write(topic, START, 1.0)
    assert f"topic '{topic}'" in _good_part(tmp_path / 'bag')[1]
    assert 'Float64' in _good_part(tmp_path / 'bag')[1]


def test_a_recording_without_joint_states_is_said(tmp_path):
    store = get_typestore(Stores.ROS2_JAZZY)
    with Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        writer.add_connection('/joint_states', 'sensor_msgs/msg/JointState', typestore=store)
    assert 'no message' in _good_part(tmp_path / 'bag')[1]


def test_a_garbled_message_and_an_unknown_event_are_reported_after_the_rest(tmp_path):
    store = get_typestore(Stores.ROS2_JAZZY)
    path = tmp_path / 'bag'
    good = bytes(store.serialize_cdr(store.types['std_msgs/msg/Float64'](1.0), 'std_msgs/msg/Float64'))
    whole = _write(tmp_path / 'whole', 3, event_at=None)
    with Reader(whole) as reader:
        raws = [raw for _, _, raw in reader.messages()]
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        joints = writer.add_connection('/joint_states', 'sensor_msgs/msg/JointState', typestore=store)
        for k, raw in enumerate((raws[0], good, raws[1][:-3], raws[2])):
            writer.write(joints, START + k, raw)
    items, line = _good_part(path)
    assert len(items) == 2
    assert 'garbled' in line
    assert '1 more' in line


@pytest.mark.parametrize('storage', list(StoragePlugin))
def test_the_good_part_of_a_truncated_recording_is_read_and_the_rest_is_reported(tmp_path, storage):
    path = _write(tmp_path / 'bag', 2000, storage=storage)
    file = _file(path)
    content = file.read_bytes()
    file.write_bytes(content[:len(content) * 6 // 10])
    for place in (path, file):
        items, line = _good_part(place)
        records = [item for item in items if isinstance(item, JointRecord)]
        assert len(records) > 800
        assert [record.stamp_ns for record in records] == [START + k * 1_000_000 for k in range(len(records))]
        assert 'damaged' in line


def test_a_recording_without_metadata_is_read_and_reported(tmp_path):
    path = _write(tmp_path / 'bag')
    (path / 'metadata.yaml').unlink()
    items, line = _good_part(path)
    assert len(items) == 51
    assert 'metadata' in line


@pytest.mark.parametrize('text', ['', 'words', 'rosbag2_bagfile_information: {version: 5}', ': : :', '\x00'])
def test_broken_metadata_is_reported_in_one_line(tmp_path, text):
    path = _write(tmp_path / 'bag')
    (path / 'metadata.yaml').write_text(text)
    assert len(_good_part(path)[0]) == 51


def test_compressed_recordings_are_read_and_salvaged(tmp_path):
    from rosbags.rosbag2 import CompressionFormat, CompressionMode

    source = _write(tmp_path / 'plain', 3000)
    store = get_typestore(Stores.ROS2_JAZZY)
    writer = Writer(tmp_path / 'packed', version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with Reader(source) as reader, writer:
        joints = writer.add_connection('/joint_states', 'sensor_msgs/msg/JointState', typestore=store)
        for connection, stamp, raw in reader.messages():
            if connection.topic == '/joint_states':
                writer.write(joints, stamp, raw)
    file = _file(tmp_path / 'packed')
    assert len(list(bag.read(file))) == 3000
    content = file.read_bytes()
    file.write_bytes(content[:len(content) // 2])
    assert len(_good_part(file)[0]) > 1000


def test_progress_is_told_from_the_metadata(tmp_path):
    seen: list[tuple[int, int | None]] = []
    list(bag.read(_write(tmp_path / 'bag', 600), progress=lambda done, total: seen.append((done, total))))
    assert seen == [(256, 601), (512, 601), (601, 601)]


@pytest.fixture(scope='module')
def small(tmp_path_factory):
    folder = tmp_path_factory.mktemp('fuzz')
    return {storage: _file(_write(folder / storage.name, 30, storage=storage)) for storage in StoragePlugin}


@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), storage=st.sampled_from(list(StoragePlugin)))
def test_whatever_the_bytes_only_our_error_comes_out(small, tmp_path, data, storage):
    source = small[storage]
    content = bytearray(source.read_bytes())
    for _ in range(data.draw(st.integers(0, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    del content[data.draw(st.integers(0, len(content))):]
    target = tmp_path / source.name
    target.write_bytes(bytes(content))
    with suppress(BagError):
        for item in bag.read(target):
            assert isinstance(item, (JointRecord, CaptureEvent))


def test_a_foreign_database_is_refused(tmp_path):
    with sqlite3.connect(tmp_path / 'other.db3') as database:
        database.execute('CREATE TABLE cats (name TEXT)')
    database.close()
    assert 'cannot be read' in _good_part(tmp_path / 'other.db3')[1]


@needs_data
@pytest.mark.parametrize(('name', 'count', 'events'), [
    ('physics_20kg_60_45', 6000, 1), ('physics_100kg_0_0', 6000, 1),
    ('quanser_2dsfl_first_half', 5000, 0), ('daisy_robot_arm', 1024, 0)])
def test_recordings_of_others_are_read(name, count, events):
    items = list(bag.read(DATA / name))
    assert sum(isinstance(item, JointRecord) for item in items) == count
    assert sum(isinstance(item, CaptureEvent) for item in items) == events
