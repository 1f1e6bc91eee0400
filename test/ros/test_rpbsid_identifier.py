from __future__ import annotations

import numpy as np
import pytest
from geometry_msgs.msg import InertiaStamped
from identifier_harness import CAPTURE, Live, recording, replayed
from lifecycle_msgs.srv import GetState
from rclpy.parameter import Parameter
from ros_harness import Ros
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, Header
from std_srvs.srv import Trigger

from flexmanip_ros import messages, pipeline
from flexmanip_ros.ros import conversions, qos
from flexmanip_ros.ros.demo import compare
from flexmanip_ros.types import JointRecord


def shuffled(record: JointRecord) -> JointRecord:
    """Return the same joints in another order, among others that nobody asked for."""
    names = ('gripper', 'link2_bend', 'joint2', 'wrist', 'link1_bend', 'joint1')
    column = [record.names.index(name) if name in record.names else -1 for name in names]

    def pick(values: np.ndarray) -> np.ndarray:
        return np.array([values[k] if k >= 0 else np.nan for k in column])

    return JointRecord(record.stamp_ns, names, pick(record.position), pick(record.velocity),
                       pick(record.effort))


def test_live_and_replay_give_the_same_bits(ros: Ros) -> None:
    live = Live(ros)
    samples = recording()
    live.send(*samples[:300])
    live.events.publish(conversions.to_message(CAPTURE))
    ros.wait(lambda: live.node.state.payload.pending, what='the event')
    live.send(*samples[300:])
    live.finish()
    expected = replayed(live, [*samples[:300], CAPTURE, *samples[300:]])
    assert len(expected[messages.PAYLOAD_MASS]) > 15
    ros.wait(lambda: all(len(live.said[name]) >= len(values) for name, values in expected.items()))
    assert compare({name: values for name, values in live.said.items() if values}, expected) == ''


def test_an_event_that_comes_late_is_applied_at_its_own_stamp(ros: Ros) -> None:
    live = Live(ros)
    samples = recording()
    live.send(*samples[:500])
    live.events.publish(conversions.to_message(CAPTURE))
    ros.wait(lambda: live.node.state.payload.rewinds == 1)
    live.send(*samples[500:])
    in_time = list(pipeline.run(live.node.config, [CAPTURE, *samples]))[-1].payload
    late = live.node.estimate.payload
    assert (late.mass, late.std) == (in_time.mass, in_time.std)


def test_names_match_in_any_order_with_other_joints_between(ros: Ros) -> None:
    live = Live(ros, payload_method='none')
    live.send(*(shuffled(record) for record in recording(300)))
    live.finish()
    plain = replayed(live, list(recording(300)))
    ros.wait(lambda: len(live.said[messages.MODEL]) >= len(plain[messages.MODEL]))
    assert compare({name: values for name, values in live.said.items() if values}, plain) == ''


def with_value(record: JointRecord, field: str, index: int, value: float) -> JointRecord:
    arrays = {name: getattr(record, name).copy() for name in ('position', 'velocity', 'effort')}
    arrays[field][index] = value
    return JointRecord(record.stamp_ns, record.names, **arrays)


def test_nan_in_a_configured_field_is_dropped_and_counted_and_elsewhere_it_does_not_matter(ros: Ros) -> None:
    live = Live(ros, payload_method='none')
    samples = list(recording(300))
    samples[100] = with_value(samples[100], 'position', 2, np.nan)
    samples[150] = with_value(samples[150], 'effort', 3, np.nan)
    live.send(*samples)
    assert live.node.state.counters.not_finite == 1
    assert live.node.state.counters.accepted == 299
    ros.wait(lambda: live.values().get('not_finite') == '1', what='the count in the diagnostics')
    assert all(np.isfinite(model.data).all() for model in live.said[messages.MODEL])


def test_the_diagnostics_suggest_an_order_beside_the_one_in_use(ros: Ros) -> None:
    live = Live(ros, payload_method='none', order=4)
    live.send(*recording(300))
    values = ros.wait(lambda: 'suggested_order' in live.values() and live.values(), what='the suggestion')
    assert values['order'] == '4'
    assert 1 <= int(values['suggested_order']) <= 10
    assert len(values['singular_values'].split()) >= int(values['suggested_order'])


def test_a_message_of_unequal_sizes_is_dropped_and_counted(ros: Ros) -> None:
    live = Live(ros, payload_method='none')
    samples = list(recording(60))
    bad = samples[30]
    samples[30] = JointRecord(bad.stamp_ns, bad.names, bad.position[:3], bad.velocity, bad.effort)
    live.send(*samples)
    assert live.node.state.counters.unequal_sizes == 1
    ros.wait(lambda: live.values().get('unequal_sizes') == '1')


def test_a_joint_that_is_not_there_is_named(ros: Ros) -> None:
    live = Live(ros, outputs=['elbow_bend/position', 'link1_bend/position'], payload_method='none', order=2)
    live.send(*recording(20))
    assert live.node.state.counters.missing_signal == 20
    assert 'elbow_bend/position' in live.node.state.clock.rejection.problem


def test_a_late_joiner_gets_the_last_model_and_payload(ros: Ros) -> None:
    live = Live(ros)
    live.send(*recording(300))
    ros.wait(lambda: live.said[messages.PAYLOAD])
    for name, kind in ((messages.MODEL, Float64MultiArray), (messages.PAYLOAD_ESTIMATE, Float64MultiArray),
                       (messages.PAYLOAD, InertiaStamped)):
        late = ros.listen(kind, f'/rpbsid_identifier/{name}', qos.latched())
        ros.wait(lambda late=late: late, what=f'the latched {name}')
        assert late[0].layout == live.said[name][-1].layout \
            if kind is Float64MultiArray else late[0].header.frame_id == 'link2_tip'


def test_reset_forgets_everything(ros: Ros) -> None:
    live = Live(ros, payload_method='none')
    live.send(*recording(200))
    assert live.node.estimate is not None
    assert ros.call(Trigger, 'rpbsid_identifier/reset').success
    assert live.node.estimate is None
    assert live.node.state.counters.received == 0


def test_lost_messages_are_counted_from_the_publishers_numbers(ros: Ros) -> None:
    live = Live(ros, payload_method='none')
    live.send(*recording(50))
    live.node.trigger_deactivate()
    late = live.node.losses
    for number in (60, 61, 65):
        late.note(number)
    assert late.lost == (60 - 50 - 1) + 3
    late.note(1)
    assert late.lost == 12


def test_an_event_of_another_kind_is_refused_and_the_node_goes_on(ros: Ros) -> None:
    live = Live(ros, payload_method='none')
    live.events.publish(Header(frame_id='world'))
    ros.wait(lambda: live.node.rejected == 1)
    live.send(*recording(50))
    assert live.node.state.counters.accepted == 50


@pytest.mark.parametrize('jump_s', [2, 3600])
def test_a_clock_that_goes_back_resets_instead_of_mixing_two_times(ros: Ros, jump_s: int) -> None:
    live = Live(ros, payload_method='none')
    samples = recording(200)
    live.send(*samples)
    again = tuple(JointRecord(r.stamp_ns - jump_s * 10**9, r.names, r.position, r.velocity, r.effort)
                  for r in samples)
    live.send(*again)
    assert live.node.state.counters.resets == 1
    live.finish()
    both = replayed(live, [*samples, *again])
    fresh = replayed(live, list(again))
    ros.wait(lambda: len(live.said[messages.MODEL]) >= len(both[messages.MODEL]))
    assert live.said[messages.MODEL][-1].data.tobytes() == fresh[messages.MODEL][-1].data.tobytes()


def test_the_publishing_rate_changes_while_it_runs(ros: Ros) -> None:
    live = Live(ros, payload_method='none', model_rate=250.0)
    samples = recording(700)
    live.send(*samples[:350])
    ros.wait(lambda: live.said[messages.MODEL])
    ros.call(GetState, 'rpbsid_identifier/get_state')  # the callback has published what was due
    (result,) = live.node.set_parameters([Parameter('publish_rate', value=250.0)])
    assert result.successful
    before = live.node.published
    live.send(*samples[350:])
    live.finish()
    instants = {k // 4 for k in range(352, 700)}
    assert live.node.published - before == 4 * len(instants)  # model, modes, intervals, status
    (result,) = live.node.set_parameters([Parameter('publish_rate', value=-1.0)])
    assert not result.successful
    (result,) = live.node.set_parameters([Parameter('order', value=6)])
    assert not result.successful
    assert live.node.config.publish_rate == 250.0


def test_what_comes_while_the_node_is_not_active_is_no_loss(ros: Ros) -> None:
    live = Live(ros, payload_method='none')
    heard = ros.listen(JointState, 'joint_states', qos.sensor_output())
    ros.wait(lambda: live.joint_states.get_subscription_count() == 2)
    samples = recording(300)
    live.send(*samples[:100])
    live.finish()
    for record in samples[100:200]:
        live.joint_states.publish(conversions.to_message(record))
    ros.wait(lambda: len(heard) == 200)
    live.node.trigger_activate()
    live.send(*samples[200:])
    assert live.node.losses.lost == 0


@pytest.mark.parametrize('changed', [300, 310], ids=['at a model', 'between two'])
def test_a_slower_rate_of_models_begins_at_once(ros: Ros, changed: int) -> None:
    live = Live(ros, payload_method='none', model_rate=50.0)
    samples = recording(700)
    live.send(*samples[:changed])
    live.node.set_parameters([Parameter('model_rate', value=1.0)])
    before = len(live.said[messages.MODEL])
    live.send(*samples[changed:])
    live.finish()
    ros.wait(lambda: len(live.said[messages.MODEL]) > before)
    assert live.node.state.model is not None
    assert live.node.state.model.instant <= 1
