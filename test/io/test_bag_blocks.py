"""Messages of a recording decoded many at once are the messages that were recorded, and give the same estimates."""

from __future__ import annotations

import tracemalloc
from contextlib import suppress
from functools import cache

import numpy as np
import pytest
from recordings import START, good_part, joint_state_record, record
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from flexmanip_ros import pipeline
from flexmanip_ros.errors import BagError
from flexmanip_ros.io import bag
from flexmanip_ros.io.bag_writer import BagWriter
from flexmanip_ros.parameters import ExcitationParameters, IdentifierParameters, PlantParameters
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.studies.scenario import Faults
from flexmanip_ros.studies.trial import inject
from flexmanip_ros.types import CaptureEvent, Estimate, EventKind, JointBlock, JointRecord

Item = JointRecord | CaptureEvent
COUNT = 1400
CAPTURE = CaptureEvent(START + 1_000_000_000, EventKind.CAPTURE)


@cache
def clean() -> tuple[Item, ...]:
    made = simulator.simulate(
        PlantParameters(), excitation.sequence(ExcitationParameters(), COUNT), (CAPTURE,), START)
    return tuple(simulator.records(made, (CAPTURE,)))


def with_faults(**chances: float | tuple[float, float]) -> list[Item]:
    return inject(clean(), Faults(**chances), np.random.default_rng(1))


def joint_states(items: list[Item]) -> list[JointRecord]:
    return [item for item in items if isinstance(item, JointRecord)]


def gripper(record: JointRecord) -> JointRecord:
    return JointRecord(record.stamp_ns, ('finger',), record.position[:1], np.empty(0), np.empty(0))


def other_order(record: JointRecord) -> JointRecord:
    return JointRecord(record.stamp_ns, record.names[::-1], record.position[::-1], record.velocity[::-1],
                       record.effort[::-1])


def of_several_publishers(items: list[Item]) -> list[Item]:
    """Every third message is of another robot, and from the middle on the joints come in another order."""
    out: list[Item] = []
    for k, item in enumerate(items):
        if isinstance(item, JointRecord):
            out.append(item if k < COUNT // 2 else other_order(item))
            if k % 3 == 0:
                out.append(gripper(item))
        else:
            out.append(item)
    return out


RECORDINGS = {
    'clean': lambda: list(clean()),
    'gap': lambda: with_faults(gap=(0.5, 0.6), drop=0.002),
    'NaN': lambda: with_faults(nan=0.01),
    'reordered and repeated stamps': lambda: with_faults(swap=0.01, duplicate=0.01),
    'late event': lambda: with_faults(event_delay=0.3),
    'several publishers': lambda: of_several_publishers(list(clean())),
    'stamps that begin again': lambda: [*clean(), *clean()],
    'fields that are empty at times': lambda: [
        item._replace(velocity=np.empty(0)) if isinstance(item, JointRecord) and k % 500 == 0 else item
        for k, item in enumerate(clean())],
}


def bits(items: list[Item]) -> list[tuple[object, ...]]:
    return [(item.stamp_ns, item.names, item.position.tobytes(), item.velocity.tobytes(), item.effort.tobytes())
            if isinstance(item, JointRecord) else item for item in items]


def bits_of(estimate: Estimate | None) -> tuple[object, ...]:
    if estimate is None:
        return ()
    model = () if estimate.model is None else tuple(
        getattr(estimate.model, name).tobytes() for name in ('A', 'B', 'C', 'D', 'K'))
    return (model, repr(estimate._replace(model=None, singular_values=None)),
            None if estimate.singular_values is None else estimate.singular_values.tobytes())


@pytest.mark.parametrize('storage', list(StoragePlugin))
@pytest.mark.parametrize('name', RECORDINGS)
def test_a_recording_in_blocks_holds_the_messages_in_their_order(name, storage, tmp_path):
    items = RECORDINGS[name]()
    assert bits(list(bag.read(record(tmp_path / 'bag', items, storage)))) == bits(items)


@pytest.mark.parametrize('name', RECORDINGS)
def test_a_recording_in_blocks_gives_the_estimates_of_its_single_messages_bit_for_bit(name, tmp_path):
    items = RECORDINGS[name]()
    config = IdentifierParameters()
    single = list(pipeline.replay(config, items))
    blocks = list(pipeline.replay(config, bag.read_blocks(record(tmp_path / 'bag', items))))
    assert [bits_of(estimate) for _, estimate in blocks] == [bits_of(estimate) for _, estimate in single]
    assert blocks[-1][0].counters == single[-1][0].counters
    assert bits_of(pipeline.current(blocks[-1][0])) == bits_of(pipeline.current(single[-1][0]))


def test_messages_of_one_publisher_come_a_thousand_and_more_at_once(tmp_path):
    found = list(bag.read_blocks(record(tmp_path / 'bag', [item for item in clean() if item is not CAPTURE])))
    sizes = [len(item.stamp_ns) for item in found if isinstance(item, JointBlock)]
    assert sum(sizes) == COUNT
    assert len(sizes) <= COUNT / 1000


def test_an_event_stands_between_the_messages_it_was_recorded_between(tmp_path):
    found = list(bag.read_blocks(record(tmp_path / 'bag', list(clean()))))
    kinds = [type(item) for item in found]
    at = kinds.index(CaptureEvent)
    before = sum(len(item.stamp_ns) for item in found[:at] if isinstance(item, JointBlock))
    assert before == [type(item) for item in clean()].index(CaptureEvent)


def test_padding_may_hold_anything(tmp_path):
    store = get_typestore(Stores.ROS2_JAZZY)
    raws = []
    names = ('a', 'bc', 'd', 'e')
    source = record(tmp_path / 'source', [joint_state_record(k)._replace(names=names) for k in range(40)])
    with Reader(source) as reader:
        for k, (_, _, raw) in enumerate(reader.messages()):
            noisy = bytearray(raw)
            noisy[2:4] = bytes((k, k))  # options of the encapsulation
            raws.append(bytes(noisy))
    with Writer(tmp_path / 'noisy', version=9, storage_plugin=StoragePlugin.MCAP) as made:
        topic = made.add_connection('/joint_states', 'sensor_msgs/msg/JointState', typestore=store)
        for k, raw in enumerate(raws):
            made.write(topic, START + k, raw)
    found = list(bag.read_blocks(tmp_path / 'noisy'))
    assert [len(item.stamp_ns) for item in found] == [40]


def test_a_garbled_message_among_thousands_is_named_and_costs_no_other(tmp_path):
    store = get_typestore(Stores.ROS2_JAZZY)
    source = record(tmp_path / 'source', joint_states(list(clean())))
    with Reader(source) as reader:
        raws = [raw for _, _, raw in reader.messages()]
    raws[1234] = raws[1234][:20] + b'\xff' * 8 + raws[1234][28:]
    with Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topic = writer.add_connection('/joint_states', 'sensor_msgs/msg/JointState', typestore=store)
        for k, raw in enumerate(raws):
            writer.write(topic, START + k, raw)
    items, line = good_part(tmp_path / 'bag')
    assert len(items) == COUNT - 1
    assert 'message 1235 ' in line
    assert 'garbled' in line


@pytest.mark.parametrize('is_garbled', [False, True])
def test_the_memory_of_reading_does_not_grow_with_the_recording(tmp_path, is_garbled):
    raw = joint_state_record(0)
    peaks = []
    for count in (10_000, 30_000):
        path = tmp_path / str(count)
        with BagWriter(path, flush_period=None) as writer:
            for k in range(count):
                if is_garbled:
                    writer.write_raw('/joint_states', START + k, bytes(200), 'sensor_msgs/msg/JointState')
                else:
                    writer.write('/joint_states', START + k, raw)
        tracemalloc.start()
        found = 0
        with suppress(BagError):
            for item in bag.read_blocks(path):
                found += len(item.stamp_ns)
        assert found == count * (not is_garbled)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0]
