"""What goes to the page: every sample, NaN and gaps as NaN, times since the first sample, and nothing that piles up."""

from __future__ import annotations

import base64
import json
import math
from typing import Any

import numpy as np
import pytest

from flexmanip_ros import messages
from flexmanip_ros.errors import ParameterError
from flexmanip_ros.parameters import IdentifierParameters, ViewParameters
from flexmanip_ros.types import CaptureEvent, Estimate, EventKind, JointBlock, Mode, Payload, Status
from flexmanip_ros.view.screen import MOST_EVENTS, Screen, Source, encoded, of_identifier, page, thinned

START_NS = 1_700_000_000_000_000_000
STEP_NS = 1_000_000
NAMES = ('other', 'link2_bend', 'joint2', 'joint1', 'link1_bend')
COLUMNS = ('joint1/effort', 'joint2/effort', 'link1_bend/position', 'link2_bend/position', 'joint1/position',
           'joint2/position')


def screen(**values: Any) -> Screen:
    return Screen(Source('Live', '/joint_states', ViewParameters(**values)))


def block(first: int, count: int, start_ns: int = START_NS) -> JointBlock:
    """Return samples that say which joint, field and sample they are, in an order of their own."""
    k = np.arange(first, first + count)
    position = np.column_stack([10.0 * joint + 1e-3 * k for joint in range(len(NAMES))])
    return JointBlock(NAMES, start_ns + STEP_NS * k, position, position + 100.0, position + 200.0)


def rows(frame: dict[str, Any] | None) -> Any:
    """Return the rows of a frame, times from the first sample."""
    assert frame is not None
    json.loads(encoded(frame))  # no NaN outside the rows
    values = np.frombuffer(base64.b64decode(frame['samples']['data']), '<f4').reshape(-1, 1 + len(COLUMNS)).copy()
    values[:, 0] += frame['samples']['start']
    return values


def status(name: str, stamp_ns: int = START_NS, **numbers: str) -> messages.Diagnostics:
    return messages.Diagnostics(stamp_ns, (messages.DiagnosticStatus(0, name, '', '', tuple(numbers.items())),))


def test_signals_are_matched_by_name_torques_come_from_the_effort_of_joint_states() -> None:
    shown = screen()
    shown.joint_states(block(0, 3))
    found = rows(shown.frame())
    assert shown.source.columns == COLUMNS
    assert found[:, 0] == pytest.approx([0.0, 1e-3, 2e-3])
    assert found[1, 1:] == pytest.approx([230.001, 220.001, 40.001, 10.001, 30.001, 20.001])


def test_frames_together_hold_every_sample_once() -> None:
    shown, found = screen(), []
    for first, count in ((0, 1), (1, 33), (34, 500), (534, 2)):
        shown.joint_states(block(first, count))
        found.append(rows(shown.frame()))
    assert shown.frame() == {}
    every = np.concatenate(found)
    assert every[:, 0] == pytest.approx(1e-3 * np.arange(536), abs=1e-6)
    assert shown.samples == 536


@pytest.mark.parametrize('bad', [math.nan, math.inf, -math.inf, 1e300])
def test_a_value_that_is_no_number_is_a_gap_in_its_line_alone(bad: float) -> None:
    shown, sent = screen(), block(0, 3)
    sent.effort[1, NAMES.index('joint1')] = bad
    shown.joint_states(sent)
    assert np.argwhere(np.isnan(rows(shown.frame()))).tolist() == [[1, 1]]


def test_missing_samples_are_a_gap_in_every_line_also_between_two_frames() -> None:
    shown = screen()
    shown.joint_states(block(0, 20))
    assert not np.isnan(rows(shown.frame())).any()
    shown.joint_states(block(120, 20))
    found = rows(shown.frame())
    assert np.isnan(found[0, 1:]).all()
    assert found[0, 0] == pytest.approx(0.0695, abs=1e-6)
    assert not np.isnan(found[1:]).any()


@pytest.mark.parametrize('stamped', [True, False])
def test_joint_states_of_other_joints_draw_no_gap_and_begin_no_run(stamped: bool) -> None:
    shown = screen()
    shown.event(CaptureEvent(START_NS + 3 * STEP_NS, EventKind.CAPTURE))
    shown.joint_states(block(0, 1)._replace(names=('finger', 'b', 'c', 'd', 'e'), stamp_ns=np.array([0])))
    for k in range(20):
        shown.joint_states(block(k, 1))
        at = START_NS + k * STEP_NS + 1000 if stamped else 0
        shown.joint_states(JointBlock(('finger',), np.array([at]), np.ones((1, 1)), np.ones((1, 0)), np.ones((1, 0))))
    frame = shown.frame()
    found = rows(frame)
    assert found[:, 0] == pytest.approx(1e-3 * np.arange(20), abs=1e-6)
    assert not np.isnan(found).any()
    assert frame['events'] == [[0.003, True]]
    assert shown.runs == 2  # that of the joint state that came before the first of the arm


def test_signals_that_are_not_there_are_gaps_and_no_error() -> None:
    shown = screen()
    shown.joint_states(JointBlock(('joint1',), np.array([START_NS]), np.ones((1, 1)), np.ones((1, 0)), np.ones((1, 0))))
    assert np.isnan(rows(shown.frame())[0, 1:]).tolist() == [True, True, True, True, False, True]


def test_late_and_repeated_stamps_draw_no_line_backwards() -> None:
    shown = screen()
    shown.joint_states(block(0, 10))
    shown.joint_states(block(5, 10))
    assert (np.diff(rows(shown.frame())[:, 0]) > 0.0).all()


@pytest.mark.parametrize('start_ns', [START_NS, -5_000_000_000])
@pytest.mark.parametrize('size', [10, 20])
def test_a_jump_back_begins_a_new_run_with_a_time_0_of_its_own(size: int, start_ns: int) -> None:
    shown, whole = screen(), block(0, 20, start_ns)
    stamps = np.where(np.arange(20) < 10, whole.stamp_ns + 10**12, whole.stamp_ns - 10 * STEP_NS)
    for first in range(0, 20, size):
        shown.joint_states(whole._replace(stamp_ns=stamps).part(slice(first, first + size)))
    assert shown.runs == 2
    assert rows(shown.frame())[:, 0] == pytest.approx(1e-3 * np.arange(10), abs=1e-6)


def test_an_event_counts_from_the_first_sample_and_is_shown_once() -> None:
    shown = screen()
    event = CaptureEvent(START_NS + 3_000_000_000, EventKind.CAPTURE)
    shown.event(event)
    assert shown.frame() == {}  # there is no time 0 yet
    shown.joint_states(block(0, 2))
    shown.event(event._replace(stamp_ns=event.stamp_ns + 50_000_000))  # found in the signals too
    shown.event(CaptureEvent(START_NS + 4_000_000_000, EventKind.RELEASE))
    frame = shown.frame()
    assert frame is not None
    assert frame['events'] == [[3.0, True], [4.0, False]]


def test_a_status_gives_payload_and_modes_with_their_intervals() -> None:
    shown = screen()
    shown.joint_states(block(0, 2))
    payload = Payload(20.004, 0.006, 19.991, math.inf, 1.02, Status.INCONSISTENT)
    modes = (Mode(5.6, 0.01, 0.02, 0.1), Mode(6.5, 0.01))
    held = Estimate(START_NS + 2_000_000, Status.INCONSISTENT, None, modes, payload)
    for value in (messages.payload_status(payload, held.stamp_ns, ''), messages.model_status(held)):
        shown.status(value)
    frame = shown.frame()
    assert frame is not None
    ((_, number, *numbers),) = frame['payloads']
    assert numbers == [20.004, 0.006, 19.991, None, 1.02]
    assert shown.source.layout()['statuses'][number][:2] == ['INCONSISTENT', Status.INCONSISTENT.value]
    assert frame['models'] == [[0.002, 1, 5.6, 0.02, 6.5, None]]


@pytest.mark.parametrize('message', [
    status('payload'), status('payload', status='BEST'), status('plan', status='TRACKING'),
    status('payload', status='TRACKING', mass_kg='twenty'), status('model', status='TRACKING', frequency_hz_2='1.0')])
def test_a_status_of_another_kind_is_no_error(message: messages.Diagnostics) -> None:
    shown = screen()
    shown.joint_states(block(0, 1))
    shown.status(message)
    encoded(shown.frame())


def test_nothing_piles_up_while_no_sample_comes() -> None:
    shown = screen()
    for k in range(5000):
        shown.event(CaptureEvent(START_NS + k * 10**9, EventKind.CAPTURE))
        shown.status(status('payload', START_NS + k, status='TRACKING'))
        shown.frame()
    shown.joint_states(block(0, 1))
    frame = shown.frame()
    assert frame is not None
    assert (len(frame['events']), len(frame['payloads'])) == (MOST_EVENTS, 1)


def test_a_long_recording_keeps_its_extremes_and_its_gaps() -> None:
    time = np.arange(100_000) * 1e-3
    values = np.sin(40.0 * time)
    values[70_000], values[50_000:50_400] = 3.0, np.nan
    thin = thinned(np.column_stack([time, values]), 5000)
    assert len(thin) <= 5002
    assert (np.diff(thin[:, 0]) > 0.0).all()
    assert np.nanmax(thin[:, 1]) == 3.0
    assert np.isnan(thin[(thin[:, 0] > 50.05) & (thin[:, 0] < 50.35), 1]).all()
    assert np.isnan(thin[:, 1]).sum() < 24


def test_of_another_machine_there_are_signals_and_no_arm() -> None:
    other = of_identifier(IdentifierParameters(
        inputs=('motor/effort',), outputs=('arm/velocity',), angles=(), payload_method='none'), 'bag')
    layout = other.layout()
    assert layout['arm'] is None
    assert other.columns == ('motor/effort', 'arm/velocity')
    assert (layout['bends']['title'], layout['bends']['unit']) == ('output', '')


def test_an_estimate_of_a_recording_is_shown_as_the_node_would_publish_it() -> None:
    shown = Screen(of_identifier(IdentifierParameters(), 'bag'))
    shown.joint_states(block(0, 2))
    shown.estimate(Estimate(START_NS, Status.TRACKING, None, (), Payload(20.0, 0.1, 19.8, 20.2, 1.0, Status.TRACKING)))
    frame = shown.frame()
    assert frame is not None
    assert frame['payloads'] == [[0.0, 1, 20.0, 0.1, 19.8, 20.2, 1.0]]


def test_a_name_cannot_end_the_script_of_the_page() -> None:
    text = page(Source('Live', '</script><script>alert(1)</script>', ViewParameters()))
    assert 'alert(1)</script>' not in text
    assert text.count('</script>') == 3


@pytest.mark.parametrize(('values', 'words'), [
    ({'window': 7}, 'window'), ({'identifier': ''}, 'identifier'), ({'inputs': ('joint1',)}, 'NAME/FIELD'),
    ({'port': 70_000}, 'port')])
def test_parameters_that_make_no_sense_are_named(values: dict[str, Any], words: str) -> None:
    with pytest.raises(ParameterError, match=words):
        ViewParameters(**values)
