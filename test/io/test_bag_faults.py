"""Every way a recording can be broken: one clear line, and what was good is read."""

from __future__ import annotations

import shutil
import signal
import sqlite3
import time
from contextlib import closing, suppress

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from recordings import NAMES, START, good_part, joint_state_record, record, storage_file, write
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from flexmanip_ros.cli import console
from flexmanip_ros.errors import BagError
from flexmanip_ros.io import bag
from flexmanip_ros.io.bag import zstd
from flexmanip_ros.io.bag_writer import BagWriter
from flexmanip_ros.types import CaptureEvent, JointRecord


def test_missing_things_are_named(tmp_path):
    assert 'does not exist' in good_part(tmp_path / 'nothing')[1]
    (tmp_path / 'folder').mkdir()
    assert 'metadata.yaml' in good_part(tmp_path / 'folder')[1]
    (tmp_path / 'notes.txt').write_text('words')
    assert 'is not a bag' in good_part(tmp_path / 'notes.txt')[1]
    (tmp_path / 'old.bag').write_text('#ROSBAG V2.0')
    assert 'ROS 1' in good_part(tmp_path / 'old.bag')[1]
    for name in ('a.mcap', 'a.db3'):
        (tmp_path / name).write_bytes(b'')
        assert 'is empty' in good_part(tmp_path / name)[1]
        (tmp_path / name).write_bytes(b'something else entirely' * 100)
        assert 'cannot be read' in good_part(tmp_path / name)[1]


@pytest.mark.parametrize('moment', ['open', 'add_connection', 'write', 'close'])
def test_an_interrupt_while_a_recording_is_written_leaves_a_whole_one(moment, tmp_path, monkeypatch):
    before = getattr(Writer, moment)

    def interrupted(writer, *given, **named):
        monkeypatch.setattr(Writer, moment, before)  # one signal
        signal.raise_signal(signal.SIGINT)
        return before(writer, *given, **named)

    def body():
        with BagWriter(tmp_path / 'bag') as writer:
            for k in range(100):
                writer.write('/joint_states', START + k, joint_state_record(k))
        limit = time.monotonic() + 10.0
        while time.monotonic() < limit:
            time.sleep(0.01)

    monkeypatch.setattr(Writer, moment, interrupted)
    assert console.run('program', body) == console.INTERRUPTED
    assert len(list(bag.read(tmp_path / 'bag'))) == 100


def test_a_missing_topic_is_answered_with_those_that_are_there(tmp_path):
    path = write(tmp_path / 'bag', topic='/other')
    line = good_part(path)[1]
    assert '/other (sensor_msgs/msg/JointState)' in line
    assert '/capture_event (std_msgs/msg/Header)' in line


@pytest.mark.parametrize('topic', ['/joint_states', '/capture_event'])
def test_a_topic_of_the_wrong_type_is_said(tmp_path, topic):
    with BagWriter(tmp_path / 'bag') as writer:
        writer.write('/joint_states' if topic != '/joint_states' else '/x', START, joint_state_record(0))
        writer.write(topic, START, 1.0)
    assert f"topic '{topic}'" in good_part(tmp_path / 'bag')[1]
    assert 'Float64' in good_part(tmp_path / 'bag')[1]


def test_a_recording_without_joint_states_is_said(tmp_path):
    store = get_typestore(Stores.ROS2_JAZZY)
    with Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        writer.add_connection('/joint_states', 'sensor_msgs/msg/JointState', typestore=store)
    assert 'no message' in good_part(tmp_path / 'bag')[1]


def test_a_garbled_message_and_an_unknown_event_are_reported_after_the_rest(tmp_path):
    store = get_typestore(Stores.ROS2_JAZZY)
    path = tmp_path / 'bag'
    good = bytes(store.serialize_cdr(store.types['std_msgs/msg/Float64'](1.0), 'std_msgs/msg/Float64'))
    whole = write(tmp_path / 'whole', 3, event_at=None)
    with Reader(whole) as reader:
        raws = [raw for _, _, raw in reader.messages()]
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        joints = writer.add_connection('/joint_states', 'sensor_msgs/msg/JointState', typestore=store)
        for k, raw in enumerate((raws[0], good, raws[1][:-3], raws[2])):
            writer.write(joints, START + k, raw)
    items, line = good_part(path)
    assert len(items) == 2
    assert 'garbled' in line
    assert '1 more' in line


@pytest.mark.parametrize('storage', list(StoragePlugin))
def test_the_good_part_of_a_truncated_recording_is_read_and_the_rest_is_reported(tmp_path, storage):
    path = write(tmp_path / 'bag', 2000, storage=storage)
    file = storage_file(path)
    content = file.read_bytes()
    file.write_bytes(content[:len(content) * 6 // 10])
    for place in (path, file):
        items, line = good_part(place)
        records = [item for item in items if isinstance(item, JointRecord)]
        assert len(records) > 800
        assert [record.stamp_ns for record in records] == [START + k * 1_000_000 for k in range(len(records))]
        assert 'damaged' in line


def test_a_recording_without_metadata_is_read_and_reported(tmp_path):
    path = write(tmp_path / 'bag')
    (path / 'metadata.yaml').unlink()
    items, line = good_part(path)
    assert len(items) == 51
    assert 'metadata.yaml is missing; its data are whole' in line
    assert 'ros2 bag reindex' in line
    assert 'damaged' not in line


def test_a_split_recording_without_metadata_names_the_file_that_is_missing(tmp_path):
    path = write(tmp_path / 'bag')
    (path / 'metadata.yaml').unlink()
    file = storage_file(path)
    second, third, fourth = (file.with_name(f'bag_{k}{file.suffix}') for k in (8, 9, 10))
    for part in (second, third, fourth):
        part.write_bytes(file.read_bytes())
    file.unlink()
    assert 'its data are whole' in good_part(path)[1]
    third.unlink()
    items, line = good_part(path)
    assert len(items) == 2 * 51
    assert f"file '{third.name}' of the recording is missing" in line
    assert 'whole' not in line


@pytest.mark.parametrize('text', ['', 'words', 'rosbag2_bagfile_information: {version: 5}', ': : :', '\x00'])
def test_broken_metadata_is_reported_in_plain_words(tmp_path, text):
    path = write(tmp_path / 'bag')
    (path / 'metadata.yaml').write_text(text)
    items, line = good_part(path)
    assert len(items) == 51
    assert 'metadata.yaml is not what ros2 bag record writes; its data are whole' in line
    assert 'Error' not in line
    assert 'NoneType' not in line


def test_a_recording_without_metadata_and_without_the_topic_names_the_topics_that_are_there(tmp_path):
    path = write(tmp_path / 'bag', topic='/other')
    (path / 'metadata.yaml').unlink()
    line = good_part(path)[1]
    assert "has no topic 'joint_states'; name one with --joint-states NAME" in line
    assert '/other (sensor_msgs/msg/JointState)' in line


@pytest.mark.parametrize('is_cut', [False, True])
@pytest.mark.parametrize('other', ['/right/joint_states', '/joint_states'])
def test_without_metadata_a_topic_is_chosen_as_in_a_whole_recording(tmp_path, other, is_cut):
    path = tmp_path / 'bag'
    with BagWriter(path, flush_period=None) as writer:
        for k in range(1500):
            for topic, joint in (('/left/joint_states', 'left'), (other, 'other')):
                found = joint_state_record(k)
                writer.write(topic, found.stamp_ns, found._replace(names=(joint, *NAMES[1:])))
    (path / 'metadata.yaml').unlink()
    if is_cut:
        file = storage_file(path)
        file.write_bytes(file.read_bytes()[:file.stat().st_size // 2])
    items, line = good_part(path)
    if other == '/joint_states':
        assert {item.names[0] for item in items} == {'other'}
    else:
        assert items == []
        assert 'has several topics' in line


@pytest.mark.parametrize('is_cut', [False, True])
def test_an_event_topic_asked_for_is_missed_in_a_recording_that_the_library_cannot_read(tmp_path, is_cut):
    path = write(tmp_path / 'bag', 2000)
    file = storage_file(path)
    (path / 'metadata.yaml').unlink()
    if is_cut:
        file.write_bytes(file.read_bytes()[:file.stat().st_size // 2])
    with pytest.raises(BagError, match=r"and none on '/capture_evnt' \(the event topics there are: /capture_event\)"):
        list(bag.read(path, bag.Topics(events=('/capture_evnt',), events_required=True)))


def test_an_unknown_event_is_answered_with_the_two_texts_and_other_ways_to_tell_the_capture(tmp_path):
    store = get_typestore(Stores.ROS2_JAZZY)
    kinds = store.types
    header = kinds['std_msgs/msg/Header'](kinds['builtin_interfaces/msg/Time'](1, 0), 'grasp')
    with BagWriter(tmp_path / 'bag') as writer:
        writer.write('/joint_states', START, joint_state_record(0))
        writer.write_raw('/capture_event', START, bytes(store.serialize_cdr(header, 'std_msgs/msg/Header')),
                         'std_msgs/msg/Header')
    items, line = good_part(tmp_path / 'bag')
    assert len(items) == 1
    assert "its frame_id is 'grasp', not 'capture' or 'release'" in line
    assert '--capture-time' in line
    assert '--detect' in line


def _compressed(path, storage, mode=CompressionMode.FILE):
    """Write a recording as ``ros2 bag record --compression-mode file`` (or ``message``) does."""
    store = get_typestore(Stores.ROS2_JAZZY)
    writer = Writer(path, version=9, storage_plugin=storage)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with Reader(write(path.with_name('plain'))) as reader, writer:
        made = {item.topic: writer.add_connection(item.topic, item.msgtype, typestore=store)
                for item in reader.connections}
        for connection, stamp, raw in reader.messages():
            writer.write(made[connection.topic], stamp, raw)
    return path


@pytest.mark.parametrize('storage', list(StoragePlugin))
def test_a_recording_whose_files_are_compressed_is_read(tmp_path, storage):
    path = _compressed(tmp_path / 'packed', storage)
    assert [file.suffix for file in path.glob('packed*')] == ['.zstd']
    assert list(map(str, bag.read(path))) == list(map(str, bag.read(tmp_path / 'plain')))


@pytest.mark.parametrize('storage', list(StoragePlugin))
def test_a_compressed_file_without_its_metadata_is_answered_with_the_command_that_makes_it_readable(tmp_path, storage):
    path = _compressed(tmp_path / 'packed', storage)
    file = next(path.glob('*.zstd'))
    (path / 'metadata.yaml').unlink()
    command = f'zstd -dc {file.name} > {file.stem}'
    for place in (file, path):
        items, line = good_part(place)
        assert items == []
        assert command in line
    file.with_suffix('').write_bytes(zstd.decompress(file.read_bytes()))
    assert len(list(bag.read(file.with_suffix('')))) == 51
    items, line = good_part(path)
    assert len(items) == 51
    assert 'metadata.yaml is missing' in line


@pytest.mark.parametrize('storage', list(StoragePlugin))
def test_messages_that_are_compressed_one_by_one_are_read_without_the_metadata_too(tmp_path, storage):
    path = _compressed(tmp_path / 'packed', storage, CompressionMode.MESSAGE)
    plain = list(map(str, bag.read(tmp_path / 'plain')))
    assert list(map(str, bag.read(path))) == plain
    assert list(map(str, bag.read(storage_file(path)))) == plain
    (path / 'metadata.yaml').unlink()
    items, line = good_part(path)
    assert list(map(str, items)) == plain
    assert 'its data are whole' in line


def test_compressed_recordings_are_read_and_salvaged(tmp_path):
    source = write(tmp_path / 'plain', 3000)
    store = get_typestore(Stores.ROS2_JAZZY)
    writer = Writer(tmp_path / 'packed', version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with Reader(source) as reader, writer:
        joints = writer.add_connection('/joint_states', 'sensor_msgs/msg/JointState', typestore=store)
        for connection, stamp, raw in reader.messages():
            if connection.topic == '/joint_states':
                writer.write(joints, stamp, raw)
    file = storage_file(tmp_path / 'packed')
    assert len(list(bag.read(file))) == 3000
    content = file.read_bytes()
    file.write_bytes(content[:len(content) // 2])
    assert len(good_part(file)[0]) > 1000


@pytest.fixture(scope='module')
def small(tmp_path_factory):
    folder = tmp_path_factory.mktemp('fuzz')
    return {storage: storage_file(write(folder / storage.name, 30, storage=storage))
            for storage in StoragePlugin}


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


def test_a_foreign_database_is_rejected(tmp_path):
    with sqlite3.connect(tmp_path / 'other.db3') as database:
        database.execute('CREATE TABLE cats (name TEXT)')
    database.close()
    assert 'cannot be read' in good_part(tmp_path / 'other.db3')[1]


@pytest.mark.parametrize('has_metadata', [False, True])
def test_messages_in_the_write_ahead_log_of_a_killed_recorder_are_read(tmp_path, has_metadata):
    path = write(tmp_path / 'bag', 1000, storage=StoragePlugin.SQLITE3, event_at=None)
    file = storage_file(path)
    with closing(sqlite3.connect(file)) as database:
        database.execute('PRAGMA journal_mode=WAL')
        kept = database.execute('SELECT topic_id, timestamp, data FROM messages WHERE id > 600').fetchall()
        database.execute('DELETE FROM messages WHERE id > 600')
        database.commit()
        database.execute('PRAGMA wal_checkpoint(TRUNCATE)')
        database.executemany('INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)', kept)
        database.commit()
        shutil.copytree(path, tmp_path / 'killed')
    killed = tmp_path / 'killed'
    if not has_metadata:
        (killed / 'metadata.yaml').unlink()
    for place in (killed, killed / file.name):
        items, line = good_part(place)
        assert len(items) == 1000
        assert '1000 messages' in line


def test_a_recording_that_was_split_and_not_finished_is_read_in_the_order_of_its_numbers(tmp_path):
    split = tmp_path / 'split'
    split.mkdir()
    for part in range(12):
        made = record(tmp_path / f'part{part}', map(joint_state_record, range(100 * part, 100 * part + 100)))
        storage_file(made).rename(split / f'split_{part}.mcap')
    (split / 'split_12.mcap').write_bytes(b'')
    messages, line = good_part(split)
    stamps = [item.stamp_ns for item in messages if isinstance(item, JointRecord)]
    assert len(stamps) == 1200
    assert stamps == sorted(stamps)
    assert '1200 messages' in line
