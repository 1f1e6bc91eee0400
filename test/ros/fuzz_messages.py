"""Messages nobody should send: strategies for every type that a node of this package subscribes to."""

from __future__ import annotations

import math
from typing import Any

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import InertiaStamped
from hypothesis import strategies as st
from joint_states import NAMES, START_NS, joint_state
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, Header, MultiArrayDimension

EDGES = (0.0, -0.0, 1e-320, 1.0, -1.0, 1e3, 1e15, 1e150, 1e300, 1.7976931348623157e308, math.nan, math.inf)
floats = st.one_of(
    st.sampled_from(EDGES + tuple(-value for value in EDGES)), st.floats(width=64), st.floats(-10.0, 10.0))
LATER = (START_NS + 10**12) // 10**9
"""The made-up samples come at about this second, far later than a recording: that one is a new clock."""
seconds = st.one_of(
    st.sampled_from((-2**31, -1, 0, 1, LATER, LATER + 1, 2**31 - 1)),
    st.integers(-2**31, 2**31 - 1))
nanoseconds = st.one_of(
    st.sampled_from((0, 1, 999_999_999, 10**9, 2**32 - 1)), st.integers(0, 2**32 - 1))
NEXT = 1_234_567_891
"""Nanoseconds (too many to be any) that ask for the stamp of the next sample."""
stamps = st.one_of(
    st.just(Time(nanosec=NEXT)),
    st.builds(lambda sec, nanosec: Time(sec=sec, nanosec=nanosec), seconds, nanoseconds))
words = st.one_of(
    st.sampled_from(('', 'joint1', 'joint1\n', 'Joint1', 'JOINT1', '{name}', '%s%n', 'ä' * 40, 'x' * 70_000)),
    st.text(st.characters(codec='utf-8', exclude_characters='\0'), max_size=12))
values = st.lists(floats, max_size=6)


@st.composite
def names(draw: st.DrawFn) -> list[str]:
    """Return names: the usual ones (so that values are looked at), others, or very many."""
    kind = draw(st.sampled_from(('usual', 'usual', 'shuffled', 'some', 'any', 'many')))
    if kind == 'usual':
        return list(NAMES)
    if kind == 'shuffled':
        return draw(st.permutations((*NAMES, 'gripper')))
    if kind == 'some':
        return draw(st.lists(st.sampled_from(NAMES), max_size=6))
    if kind == 'any':
        return draw(st.lists(words, max_size=6))
    return [*NAMES, *(f'joint{k}' for k in range(3, draw(st.integers(100, 4000))))]


@st.composite
def joint_states(draw: st.DrawFn) -> JointState:
    """Return a JointState whose arrays fit its names, or not."""
    message = JointState(header=Header(stamp=draw(stamps), frame_id=draw(words)), name=draw(names()))
    count = len(message.name)
    for field in ('position', 'velocity', 'effort'):
        kind = draw(st.sampled_from(('fits', 'fits', 'fits', 'empty', 'any')))
        some = [] if kind == 'empty' else draw(values)
        setattr(message, field, (some * count)[:count] if kind == 'fits' and some else some)
    return message


@st.composite
def events(draw: st.DrawFn) -> Header:
    """Return an event, or what looks like one."""
    kind = draw(st.one_of(st.sampled_from(('capture', 'release', 'Capture', 'capture ')), words))
    return Header(stamp=draw(stamps), frame_id=kind)


@st.composite
def arrays(draw: st.DrawFn) -> Float64MultiArray:
    """Return numbers: two as a command has, five as an estimate has, or any; under any layout."""
    size = draw(st.sampled_from((2, 2, 5, 5, 0, 1, 3, 3000)))
    message = Float64MultiArray(data=(draw(st.lists(floats, min_size=1, max_size=5)) * size)[:size])
    for label in draw(st.lists(words, max_size=3)):
        message.layout.dim.append(MultiArrayDimension(label=label, size=draw(nanoseconds), stride=7))
    return message


scalars = floats.filter(math.isfinite)
"""rclpy's setters take no other; what is not finite comes as bytes."""


@st.composite
def payloads(draw: st.DrawFn) -> InertiaStamped:
    """Return a body that no arm can hold."""
    message = InertiaStamped(header=Header(stamp=draw(stamps), frame_id=draw(words)))
    body = message.inertia
    for name in ('m', 'ixx', 'ixy', 'ixz', 'iyy', 'iyz', 'izz'):
        setattr(body, name, draw(scalars))
    body.com.x, body.com.y, body.com.z = draw(scalars), draw(scalars), draw(scalars)
    return message


@st.composite
def statuses(draw: st.DrawFn) -> DiagnosticArray:
    """Return entries like those of a payload or a model."""
    texts = st.one_of(st.floats().map(repr), words, st.sampled_from(('TRACKING', '1e999', '-inf')))
    keys = st.sampled_from(('status', 'mass_kg', 'std_kg', 'lower95_kg', 'frequency_hz_1', 'frequency_hz_2'))
    pairs = st.lists(st.builds(lambda key, text: KeyValue(key=key, value=text), keys, texts), max_size=6)
    entry = st.builds(lambda name, values: DiagnosticStatus(name=name, values=values),
                      st.sampled_from(('payload', 'model', 'other')), pairs)
    return DiagnosticArray(header=Header(stamp=draw(stamps)), status=draw(st.lists(entry, max_size=3)))


GOOD: dict[type, Any] = {
    JointState: joint_state(3), Header: Header(frame_id='capture'),
    Float64MultiArray: Float64MultiArray(data=[20.0, 0.1, 19.8, 20.2, 1.0]), InertiaStamped: InertiaStamped(),
    DiagnosticArray: DiagnosticArray(status=[DiagnosticStatus(name='payload', values=[
        KeyValue(key='status', value='TRACKING'), KeyValue(key='mass_kg', value='20.0')])]),
}
TYPED = {JointState: joint_states(), Header: events(), Float64MultiArray: arrays(),
         InertiaStamped: payloads(), DiagnosticArray: statuses()}


@st.composite
def garbage(draw: st.DrawFn, kind: type) -> bytes:
    """Return the bytes of a message, cut and changed, or any bytes behind some encoding's first four."""
    if draw(st.booleans()):
        order = draw(st.sampled_from((b'\0\1\0\0', b'\0\0\0\0', b'\0\3\0\0', b'\xff' * 4, b'')))
        return order + draw(st.binary(max_size=80))
    raw = bytearray(serialize_message(GOOD[kind]))
    for _ in range(draw(st.integers(1, 4))):
        raw[draw(st.integers(0, len(raw) - 1))] = draw(st.integers(0, 255))
    return bytes(raw[:draw(st.integers(0, len(raw)))] if draw(st.booleans()) else raw)


def messages(kind: type) -> st.SearchStrategy[Any]:
    """Return messages of a type, as objects or as bytes."""
    return st.one_of(TYPED[kind], TYPED[kind], garbage(kind))
