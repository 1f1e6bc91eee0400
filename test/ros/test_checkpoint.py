from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from identifier_harness import CAPTURE, Live, recording, replayed
from ros_harness import Ros, overrides

from flexmanip_ros import messages
from flexmanip_ros.io.checkpoint import CheckpointWriter
from flexmanip_ros.ros import conversions
from flexmanip_ros.ros.demo import compare
from flexmanip_ros.ros.nodes.rpbsid_identifier import RpbsidIdentifier
from flexmanip_ros.types import CaptureEvent, EventKind


def test_an_identifier_that_is_restarted_goes_on_as_if_it_had_only_missed_samples(
        ros: Ros, tmp_path: Path) -> None:
    file = str(tmp_path / 'state')
    samples = recording(900)
    first = Live(ros, checkpoint_file=file)
    first.send(*samples[:300])
    first.events.publish(conversions.to_message(CAPTURE))
    ros.wait(lambda: first.node.state.payload.pending)
    first.send(*samples[300:500])
    ros.remove(first.node)
    second = Live(ros, checkpoint_file=file)
    assert second.node.estimate is not None  # the last one, of before
    assert second.node.estimate.model is not None
    second.send(*samples[550:])
    second.finish()
    straight = replayed(second, [*samples[:300], CAPTURE, *samples[300:500], *samples[550:]])
    count = {name: len(values) for name, values in second.said.items()}
    ros.wait(lambda: len(second.said[messages.PAYLOAD_MASS]) >= 17)
    assert count[messages.PAYLOAD_MASS] >= 17
    after = {name: values[1:] if name in (messages.MODEL, messages.PAYLOAD, messages.PAYLOAD_ESTIMATE)
             and len(values) > len(second.said[messages.MODES]) else values
             for name, values in second.said.items()}
    tail = {name: straight.get(name, [])[-len(values):] if values else [] for name, values in after.items()}
    assert compare(after, tail) == ''


def test_states_are_saved_while_it_runs(ros: Ros, tmp_path: Path) -> None:
    live = Live(ros, checkpoint_file=str(tmp_path / 'state'), checkpoint_period=0.1, payload_method='none')
    live.send(*recording(200))
    time.sleep(0.15)  # the period of saving
    live.send(*recording(400)[200:])
    ros.wait(lambda: live.node._checkpoints.saves >= 1, what='a saved state')
    assert (tmp_path / 'state').stat().st_size > 1000
    live.node._checkpoints.join()


def test_a_state_that_cannot_be_saved_is_logged_once_while_it_runs_and_at_the_end(
        ros: Ros, tmp_path: Path, log: Callable[[str], str]) -> None:
    folder = tmp_path / 'folder'
    folder.mkdir()
    live = Live(ros, checkpoint_file=str(folder / 'state'), checkpoint_period=0.1, payload_method='none')
    shutil.rmtree(folder)
    samples = iter(recording())
    ros.wait(lambda: live.send(next(samples)) or live.node._checkpoints.problem, what='a save that fails')
    problem = f"checkpoint '{folder / 'state'}' cannot be written: No such file or directory"
    log(problem)
    reports = len(live.diagnostics)
    ros.wait(lambda: len(live.diagnostics) >= reports + 2, what='two more reports')
    assert log(problem).count(problem) == 1
    live.finish()
    log(f'the last state was not saved: {problem}')


@pytest.mark.parametrize(('file', 'wrong'), [('none/state', "none' is no folder"), ('', "' is a folder")])
def test_a_checkpoint_file_that_is_a_folder_or_in_none_is_refused_when_the_node_is_configured(
        ros: Ros, tmp_path: Path, log: Callable[[str], str], file: str, wrong: str) -> None:
    node = ros.add(RpbsidIdentifier(context=ros.context, overrides=overrides(checkpoint_file=str(tmp_path / file))))
    log('')
    ros.run(node, lambda: node.autostart() and ros.helper.get_logger().error('it started'))
    assert 'it started' not in log(f'{wrong}; give a file in a folder that exists')


def test_a_state_of_other_parameters_or_damaged_or_old_is_not_used_and_the_node_starts_anew(
        ros: Ros, tmp_path: Path) -> None:
    file = tmp_path / 'state'
    live = Live(ros, checkpoint_file=str(file), payload_method='none')
    live.send(*recording(100))
    ros.remove(live.node)
    other = Live(ros, checkpoint_file=str(file), payload_method='none', order=6)
    assert other.node.state.counters.received == 0
    ros.remove(other.node)
    first = Live(ros, checkpoint_file=str(file), payload_method='none')
    assert first.node.state.counters.received == 100  # a start that heard nothing leaves the file
    ros.remove(first.node)
    same = Live(ros, checkpoint_file=str(file), payload_method='none', order=6, publish_rate=10.0)
    same.send(*recording(60))
    ros.remove(same.node)
    assert CheckpointWriter(replace(live.node.config, checkpoint_file=f'{file}.refused')).load(
        live.node.config).counters.received == 100
    old = Live(ros, checkpoint_file=str(file), payload_method='none', order=6)
    assert old.node.state.counters.received == 60
    late = recording(1)[0]._replace(stamp_ns=recording(1)[0].stamp_ns + 3600 * 10**9)
    caught = CaptureEvent(late.stamp_ns - 10**9, EventKind.CAPTURE)  # it is latched, so it comes first
    old.events.publish(conversions.to_message(caught))
    ros.wait(lambda: old.node.state.stamp_of(EventKind.CAPTURE) is not None)
    old.joint_states.publish(conversions.to_message(late))
    ros.wait(lambda: old.node.state.counters.received == 1, what='a fresh start')
    assert old.node.state.stamp_of(EventKind.CAPTURE) == caught.stamp_ns
    ros.remove(old.node)
    file.write_bytes(file.read_bytes()[:-7])
    damaged = Live(ros, checkpoint_file=str(file), payload_method='none', order=6)
    assert damaged.node.state.counters.received == 0
