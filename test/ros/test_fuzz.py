"""Whatever comes over the wire, the real nodes live, say no NaN, and remember little.

Few examples here; ``benchmarks/ros_fuzz.py`` runs thousands.
"""

from __future__ import annotations

import math

import pytest
from fuzz_nodes import LATER_NS, SUBJECTS, Bench, fuzz, good, numbers, poison
from identifier_harness import CAPTURE, recording
from joint_states import joint_state
from ros_harness import Ros
from std_msgs.msg import Float64MultiArray, Header
from std_srvs.srv import Trigger

from flexmanip_ros import event_replay
from flexmanip_ros.ros.conversions import time_message, to_message
from flexmanip_ros.types import Status

pytestmark = pytest.mark.filterwarnings('ignore::RuntimeWarning')  # numbers out of range have a status


@pytest.mark.parametrize('name', SUBJECTS)
def test_no_message_ends_a_node_or_makes_it_say_nan(ros: Ros, name: str) -> None:
    bench = Bench(ros, name)
    fuzz(bench, examples=30)
    bench.alive()


@pytest.mark.parametrize('name', SUBJECTS)
def test_one_number_that_is_out_of_range_in_a_good_message_makes_no_node_say_nan(ros: Ros, name: str) -> None:
    bench, k = Bench(ros, name), 0
    lengths = {'effort_controller/commands': 2, 'payload_controller/added_efforts': 2}
    for topic, kind in bench.subject.hears.items():
        if kind is Header:  # it holds no such number
            continue
        for value in (math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324):
            for place in range(lengths.get(topic, len(list(numbers(good(kind, 0)))))):
                message = good(kind, k)
                if topic in lengths:
                    message.data = message.data[:lengths[topic]]
                poison(message, place, value)
                around = [('joint_states', joint_state(k + 1 + i, start_ns=LATER_NS)) for i in range(2)]
                bench.send([(topic, message), *(around if 'joint_states' in bench.subject.hears else [])])
                bench.check()
                k += 3
    bench.alive()


def test_after_all_of_it_the_identifier_claims_nothing_wrong_and_after_a_reset_the_truth(ros: Ros) -> None:
    bench = Bench(ros, 'rpbsid_identifier')
    fuzz(bench, examples=60)
    for reset in (False, True):  # what was believed for a motion of the arm may stay in its memory without
        if reset:
            assert ros.call(Trigger, 'rpbsid_identifier/reset').success
        before = bench.node.state.counters.received
        for k, sample in enumerate(recording(1100)):
            if k == 300:
                bench.send([('capture_event', to_message(CAPTURE))])
            bench.send([('joint_states', to_message(sample))], wait=False)
            if k % 100 == 99:  # it takes them at 50 Hz, before them what is left of the made-up ones
                ros.wait(lambda due=before + k + 1: bench.node.state.counters.received >= due,
                         what='the identifier to take the samples')
        estimate = bench.node.estimate
        assert estimate is not None
        right = abs(estimate.payload.mass - 20.0) < 4.0 * estimate.payload.std + 0.05
        assert right or estimate.status is not Status.TRACKING
        bench.check()
    assert right
    assert estimate.status is Status.TRACKING


def test_after_all_of_it_the_controller_gives_a_torque_for_each_good_sample(ros: Ros) -> None:
    bench = Bench(ros, 'payload_controller')
    fuzz(bench, examples=60)
    dropped, sent = bench.node.dropped, bench.node.sent
    bench.send([('joint_states', joint_state(k, start_ns=1_800_000_000_000_000_000)) for k in range(50)])
    assert (bench.node.dropped, bench.node.sent) == (dropped, sent + 50)


@pytest.mark.parametrize(('name', 'counter'), [
    ('rpbsid_identifier', 'rejected'), ('plant_simulator', 'rejected_events')])
def test_events_without_end_do_not_fill_the_memory_and_those_left_out_are_counted(
        ros: Ros, name: str, counter: str) -> None:
    bench = Bench(ros, name)
    far = 2_000_000_000 * 10**9
    for first in range(0, 300, 10):  # the subscription keeps 10: more at a time may be lost before the node sees them
        bench.send([('capture_event', Header(stamp=time_message(far + k * 10**9), frame_id='capture'))
                    for k in range(first, first + 10)])
    assert bench.remembered() <= 200
    assert getattr(bench.node, counter) == 200  # of 300: 100 wait for their stamps


@pytest.mark.parametrize(('step_ns', 'least', 'most'), [(50_000, 250, 600), (1, 0, 0)],
                         ids=['as fast as is taken', 'in another unit: all refused'])
def test_samples_whose_stamps_hardly_advance_do_not_fill_the_memory(
        ros: Ros, monkeypatch: pytest.MonkeyPatch, step_ns: int, least: int, most: int) -> None:
    monkeypatch.setattr(event_replay, 'MOST_ROWS', 500)
    bench = Bench(ros, 'rpbsid_identifier')
    for first in range(0, 2000, 100):
        message = [joint_state(k) for k in range(first, first + 100)]
        for k, item in enumerate(message):
            item.header.stamp = time_message(10**18 + (first + k) * step_ns)
        bench.send([('joint_states', item) for item in message])
        ros.wait(lambda until=first + 100: bench.node.state.counters.received >= until, what='samples to be taken')
    assert least <= bench.remembered() <= most


def test_an_estimate_of_the_wrong_size_changes_nothing(ros: Ros) -> None:
    bench = Bench(ros, 'payload_controller')
    bench.send([('rpbsid_identifier/payload_estimate', Float64MultiArray(data=[20.0] * size))
                for size in (0, 4, 6)])
    assert (bench.node.state.trusted[0], bench.node.dropped) == (0.0, 3)
