"""What somebody sees who starts the nodes for the first time: log lines, names, parameter files, losses."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from identifier_harness import CAPTURE, Live, recording
from joint_states import joint_state
from numba import njit
from ros_harness import Ros, overrides
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from flexmanip_ros import messages
from flexmanip_ros.cli import console
from flexmanip_ros.cli.suggest import file_text
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.parameters.document import yaml_text
from flexmanip_ros.payload.structured_model import unobservable
from flexmanip_ros.ros import conversions, diagnostics, qos
from flexmanip_ros.ros.diagnostics import WARN, LossCounter, Report
from flexmanip_ros.ros.nodes.capture_trigger import CaptureTrigger
from flexmanip_ros.ros.nodes.excitation import Excitation
from flexmanip_ros.ros.nodes.live_view import LiveView
from flexmanip_ros.ros.nodes.payload_adapter import PayloadAdapter
from flexmanip_ros.ros.nodes.payload_controller import PayloadController
from flexmanip_ros.ros.nodes.plant_simulator import PlantSimulator
from flexmanip_ros.ros.nodes.rpbsid_identifier import RpbsidIdentifier

NODES = (PlantSimulator, Excitation, CaptureTrigger, PayloadController, PayloadAdapter, RpbsidIdentifier, LiveView)
ROOT = Path(__file__).resolve().parents[2]
CONFIG = [path for path in sorted((ROOT / 'config').rglob('*.yaml'))
          if 'ros__parameters' in path.read_text(encoding='utf-8') and path.stem != 'ros2_control']  # other nodes' too


@pytest.mark.parametrize('cls', NODES)
def test_a_node_that_waits_to_be_configured_reports_that_it_is_not_active(ros: Ros, cls: Any) -> None:
    heard = ros.listen(DiagnosticArray, '/diagnostics', 10)
    node = ros.add(cls(context=ros.context, overrides=overrides(autostart=False)))
    assert node.autostart()
    ros.wait(lambda: heard)
    assert heard[0].status[0].message.startswith('not active')


def documented() -> list[str]:
    """Return what follows `ros2 run flexmanip_ros` in the commands of the documentation that start a node."""
    pages = [ROOT / 'README.md', *sorted((ROOT / 'docs').glob('*.md'))]
    text = '\n'.join(page.read_text(encoding='utf-8') for page in pages).replace('\\\n', ' ')
    commands = re.findall(r"^ros2 run (?:--prefix '[^']*' )?flexmanip_ros (.*)$", text, re.MULTILINE)
    names = [cls.__module__.rpartition('.')[2] for cls in NODES]
    words = [(command, shlex.split(command, comments=True)) for command in commands]
    return [command for command, (name, *rest) in words if name in names and rest[:1] in ([], ['--ros-args'])]


def test_the_documentation_starts_nodes() -> None:
    assert 'rpbsid_identifier --ros-args -p autostart:=false' in documented()
    assert len(documented()) > 5


@pytest.mark.parametrize('command', documented())
def test_a_documented_command_starts_a_node_that_reports(ros: Ros, command: str) -> None:
    share = command.replace('$(ros2 pkg prefix --share flexmanip_ros)', str(ROOT))
    name, *arguments = shlex.split(share, comments=True)
    port = ['-p', 'port:=0'] if name == 'live_view' else []  # any that is free
    (cls,) = [cls for cls in NODES if cls.__module__.endswith(f'.{name}')]
    heard = ros.listen(DiagnosticArray, '/diagnostics', 10)
    node = ros.add(cls(context=ros.context, cli_args=['--ros-args', *arguments[1:], *port]))
    if not node.autostart():
        assert 'config/drivers/' in command
        pytest.skip("the driver's messages are not installed here")
    ros.wait(lambda: any(message.status[0].name == f'/{name}: status' for message in heard))
    assert node.active is ('autostart:=false' not in command)


@pytest.mark.parametrize('remapping', [['-r', '__ns:=/left'], ['-r', '__node:=arm'], []])
def test_a_written_parameter_file_holds_in_any_namespace_and_under_any_name(
        ros: Ros, tmp_path: Path, remapping: list[str]) -> None:
    file = tmp_path / 'plant.yaml'
    file.write_text(yaml_text('plant_simulator', {'rate': 250.0, 'arm.tip_mass': 3.0}), encoding='utf-8')
    node = ros.add(PlantSimulator(
        context=ros.context, cli_args=['--ros-args', '--params-file', str(file), *remapping]))
    assert (node.config.rate, node.config.arm.tip_mass) == (250.0, 3.0)


def test_the_identifier_takes_a_suggested_file(ros: Ros, tmp_path: Path) -> None:
    values = {'inputs': ('hub/effort',), 'outputs': ('hub/position',), 'angles': (), 'payload_method': 'none',
              'decimation': 5, 'order': 6, 'past_window': 40, 'future_window': 20, 'direct_feedthrough': True,
              'forgetting': 'constant', 'forgetting_factor': (0.999,) * 3, 'regularization': (1e-5,) * 3,
              'refinement': 'none'}
    file = tmp_path / 'suggested.yaml'
    file.write_text(file_text('Suggested.', ['order: 6: smallest within 3 % of the best'], values), encoding='utf-8')
    node = ros.managed(RpbsidIdentifier(
        context=ros.context, cli_args=['--ros-args', '--params-file', str(file)]))
    assert {name: getattr(node.config, name) for name in values} == values


@pytest.mark.parametrize(('cls', 'values', 'name'), [
    (PayloadAdapter, {'target_node': 'bad name'}, 'bad name/set_parameters'),
    (LiveView, {'port': 0, 'identifier': 'a//b'}, '/a//b/status')])
def test_a_parameter_that_makes_no_name_of_a_topic_or_service_is_one_line_and_no_traceback(
        ros: Ros, log: Callable[[str], str], cls: Any, values: dict[str, Any], name: str) -> None:
    log('')
    node = ros.managed(cls(context=ros.context, overrides=overrides(**values)))
    said = log(f"'{name}'; correct the parameter that has this name")
    assert 'Traceback' not in said
    assert not node.active


@pytest.mark.parametrize('path', CONFIG, ids=lambda path: path.stem)
def test_the_files_in_config_are_for_every_name(path: Path) -> None:
    assert re.findall(r'^(\S+):\n  ros__parameters:', path.read_text(encoding='utf-8'), re.MULTILINE) == ['/**']


def test_a_node_logs_its_arm_and_where_it_comes_from(
        ros: Ros, log: Callable[[str], str], monkeypatch: pytest.MonkeyPatch) -> None:
    ros.managed(CaptureTrigger(context=ros.context, namespace='one'))
    log('arm: links of 3 and 3 m, 5 and 5 kg/m, 5000 and 5000 N m^2, masses 10 kg at joint 2 and 10 kg at the tip; '
        'all defaults')
    ros.managed(CaptureTrigger(context=ros.context, namespace='two', overrides=overrides(arm__tip_mass=4.0)))
    log('4 kg at the tip; set at start: arm.tip_mass')
    ros.managed(CaptureTrigger(context=ros.context, namespace='one_link', overrides=overrides(arm__link_length=[1.0])))
    log('arm: link of 1 m, 5 kg/m, 5000 N m^2, mass 10 kg at the tip; set at start: arm.link_length\n')
    monkeypatch.setattr(sys, 'argv', ['capture_trigger', '--ros-args', '--params-file', 'other.yaml'])
    ros.managed(CaptureTrigger(context=ros.context, namespace='three'))
    said = log('all defaults: other.yaml sets no parameter arm.* of /three/capture_trigger')
    assert next(line for line in said.splitlines() if 'other.yaml' in line).startswith('[WARN]')


@pytest.mark.parametrize(('values', 'is_warned'), [
    ({'payload_method': 'none', 'angles': ()}, False), ({'payload_method': 'none'}, False), ({'order': 4}, True)])
def test_a_suggested_file_without_an_arm_is_warned_of_only_where_the_arm_plays_a_part(
        ros: Ros, log: Callable[[str], str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, values: dict[str, Any],
        is_warned: bool) -> None:
    file = tmp_path / 'suggested.yaml'
    file.write_text(file_text('Suggested.', [], values), encoding='utf-8')
    arguments = ['--ros-args', '--params-file', str(file)]
    monkeypatch.setattr(sys, 'argv', ['rpbsid_identifier', *arguments])
    log('')
    ros.managed(RpbsidIdentifier(context=ros.context, cli_args=arguments))
    assert ('sets no parameter arm.*' in log('ready')) == is_warned


def test_what_an_arm_of_one_link_leaves_out_of_given_lists_is_logged(ros: Ros, log: Callable[[str], str]) -> None:
    log('')
    ros.managed(CaptureTrigger(context=ros.context, overrides=overrides(
        arm__link_length=[1.0], arm__hub_inertia=[0.0, 0.0], inputs=['joint1/effort', 'joint2/effort'])))
    said = log('one link: of each list the values of a second one are left out: inputs [joint1/effort], '
               'arm.hub_inertia [0.0]\n')
    assert said.count('left out') == 1


@pytest.mark.parametrize('section', ['/**', '/*/trigger', '/left/*', '/**/trigger', 'left/trigger', 'capture_trigger'])
def test_a_node_warns_of_a_parameter_file_exactly_where_ros_gives_it_nothing_of_the_file(
        ros: Ros, log: Callable[[str], str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, section: str) -> None:
    """The node is /left/trigger: its own name was remapped, so that a section capture_trigger is not for it."""
    file = tmp_path / 'trigger.yaml'
    file.write_text(f"'{section}': {{ros__parameters: {{lead_time: 0.3}}}}", encoding='utf-8')
    arguments = ['--ros-args', '--params-file', str(file), '-r', '__ns:=/left', '-r', '__node:=trigger']
    monkeypatch.setattr(sys, 'argv', ['capture_trigger', *arguments])
    log('')
    node = ros.managed(CaptureTrigger(context=ros.context, cli_args=arguments))
    warning = (f"[left.trigger]: parameter file '{file}' is for {section}, not for /left/trigger "
               f"('{section}' is close); add a section '/left/trigger' or '/**'")
    is_read = node.config.lead_time == 0.3
    assert is_read is (section != 'capture_trigger')
    assert (warning in log('ready')) is not is_read


def test_a_node_that_compiles_kernels_says_so_while_it_does(
        ros: Ros, log: Callable[[str], str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(console, 'PATIENCE', 1e-4)
    monkeypatch.setattr(CaptureTrigger, 'start', lambda node: njit(lambda x: x + 1.0)(1.0))
    ros.managed(CaptureTrigger(context=ros.context))
    assert log(console.COMPILING).index(console.COMPILING) < log('ready: ').index('ready: ')


def test_nodes_of_two_arms_have_diagnostics_of_their_own(ros: Ros) -> None:
    heard = ros.listen(DiagnosticArray, '/diagnostics', 10)
    for arm in ('left', 'right'):
        ros.managed(CaptureTrigger(context=ros.context, namespace=arm))
    ros.wait(lambda: len({message.status[0].name for message in heard}) == 2)
    assert {(message.status[0].name, message.status[0].hardware_id) for message in heard} == {
        ('/left/capture_trigger: status', 'flexmanip_ros /left'),
        ('/right/capture_trigger: status', 'flexmanip_ros /right')}


def test_the_identifier_logs_what_it_does_waits_for_and_finds(ros: Ros, log: Callable[[str], str]) -> None:
    live = Live(ros)
    log('ready: inputs joint1/effort, joint2/effort; outputs link1_bend/position, link2_bend/position, '
        'link1_bend/velocity, link2_bend/velocity; order 4; payload_method structured; 50 estimates a second')
    log('waiting for /joint_states')
    samples = recording(1500)
    live.send(*samples[:300])
    log('messages arrive: ')
    live.events.publish(conversions.to_message(CAPTURE))
    log('capture_event: capture at ')
    live.send(*samples[300:])
    log('status TRACKING: tracking; the estimates can be used')
    said = log(' kg, 95 % interval ')
    mass = float(said.rpartition(' kg, 95 % interval ')[0].rpartition('payload ')[2])
    assert abs(mass - 20.0) < 2.0 or mass == 0.0
    assert ros.call(Trigger, 'rpbsid_identifier/reset').success
    log('reset: everything identified so far is forgotten')


def test_an_event_with_a_stamp_of_another_clock_is_warned_of(ros: Ros, log: Callable[[str], str]) -> None:
    live = Live(ros)
    live.send(*recording(300))
    log('status TRACKING')
    live.events.publish(conversions.to_message(CAPTURE._replace(stamp_ns=0)))
    log('capture_event: capture at 0.000000, ')
    log(' s before the last sample: stamp an event with the time of its samples')


def test_an_unannounced_capture_is_hinted_at_once(ros: Ros, log: Callable[[str], str]) -> None:
    live = Live(ros)
    live.send(*recording(560))  # it catches its object after 0.4 s
    said = log('trigger_mode:=auto)')
    assert 'no capture was announced' in said
    assert 'status INCONSISTENT: ' in said


@pytest.mark.parametrize(('changes', 'words'), [
    ({'outputs': ('joint1/effort', 'link1_bend/position')}, 'not those of a two-link arm'),
    ({'angles': ()}, 'angles does not name'),
    ({'inputs': ('joint1/effort',)}, 'effort of both joints'),
])
def test_signals_that_give_no_payload_are_explained(changes: dict[str, Any], words: str) -> None:
    assert words in unobservable(IdentifierParameters(**changes))[0]


def test_a_second_capture_without_a_release_is_said_to_add_an_object(ros: Ros) -> None:
    node = ros.managed(CaptureTrigger(context=ros.context))
    ros.publisher(JointState, 'joint_states', qos.sensor_output()).publish(joint_state(5))
    ros.wait(lambda: node._last_ns is not None)
    answers = [ros.call(Trigger, f'capture_trigger/{kind}') for kind in ('capture', 'capture', 'release', 'capture')]
    assert [answer.success for answer in answers] == [True] * 4
    assert ['a second one is added' in answer.message for answer in answers] == [False, True, False, False]


def test_the_status_message_alone_says_whether_payload_and_model_are_to_be_trusted(ros: Ros) -> None:
    live = Live(ros)
    samples = recording(1500)
    live.send(*samples[:200])
    live.events.publish(conversions.to_message(CAPTURE))
    ros.wait(lambda: live.node.state.payload.pending)
    live.send(*samples[200:])
    live.finish()
    ros.wait(lambda: len(live.said[messages.STATUS]) >= len(live.said[messages.MODEL])
             + len(live.said[messages.PAYLOAD_ESTIMATE]))
    statuses = [conversions.diagnostics(message) for message in live.said[messages.STATUS]]
    for name, topic in (('payload', messages.PAYLOAD_ESTIMATE), ('model', messages.MODEL)):
        entries = [item for item in statuses if item.statuses[0].name == name]
        assert len(entries) == len(live.said[topic])
        (last,) = entries[-1].statuses
        status = dict(last.values)['status']
        assert status == 'TRACKING' if name == 'payload' else status in ('TRACKING', 'WARMING_UP')
        assert last.level == (0 if status == 'TRACKING' else 1)
    payloads = {item.stamp_ns: dict(item.statuses[0].values) for item in statuses
                if item.statuses[0].name == 'payload'}
    for body in live.said[messages.PAYLOAD]:
        assert float(payloads[conversions.stamp_ns(body.header.stamp)]['mass_kg']) == body.inertia.m
    unknown = [values for values in payloads.values() if values['mass_kg'] == 'nan']
    assert unknown
    assert len(live.said[messages.PAYLOAD_MASS]) == len(payloads) - len(unknown)


def event(count: int, change: int) -> SimpleNamespace:
    return SimpleNamespace(current_count=count, current_count_change=change)


def test_publishers_that_come_and_go_are_no_loss_and_each_keeps_its_own_count() -> None:
    losses = LossCounter()
    losses.matched(event(1, 1))
    for number in (1_500_000, 1_500_001):
        losses.note(number)
    losses.matched(event(2, 1))
    for number in (1, 1_500_002, 2, 1_500_003, 3):
        losses.note(number)
    assert losses.lost == 0
    for number in (1_500_006, 5):  # two of the one are missing, one of the other
        losses.note(number)
    assert losses.lost == 3
    losses.matched(event(1, -1))
    for number in (6, 7):
        losses.note(number)
    assert losses.lost == 3


def test_a_loss_is_a_warning_for_a_minute_and_stays_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(diagnostics.time, 'monotonic', lambda: now[0])
    losses = LossCounter()
    for number in (1, 5):
        losses.note(number)
    levels = []
    for seconds in (0.0, 59.0, 61.0):
        now[0] = 100.0 + seconds
        report = Report()
        losses.report(report, 'lost', 'messages')
        assert report.values == {'lost': 3}
        levels.append(report.level)
    assert levels == [WARN, WARN, diagnostics.OK]
