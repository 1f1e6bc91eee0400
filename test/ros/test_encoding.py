"""Bytes written without a message class are read as the messages that rclpy would have written."""

from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Float64MultiArray, MultiArrayDimension

from flexmanip_ros import messages
from flexmanip_ros.errors import SignalError
from flexmanip_ros.ros.conversions import joint_state, numbers, to_message
from flexmanip_ros.ros.encoding import Encoder, JointStateWriter
from flexmanip_ros.types import JointRecord, Mode, Payload, StateSpace, Status

NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
STAMPS = st.integers(-(1 << 62), 1 << 62)
RECORDS = st.tuples(STAMPS, st.sampled_from([('a', 'b'), ('joint1', 'b'), ()]), st.integers(0, 3))


def same(raw: bytes, message: object) -> bool:
    """Padding between fields is left to chance by the middleware; all else must be equal."""
    return len(raw) == len(serialize_message(message)) and deserialize_message(raw, type(message)) == message


@given(st.lists(st.tuples(STAMPS, st.sampled_from(['tip', 'tool0', '', 'a/b']), *[NUMBERS] * 5), max_size=4))
def test_every_payload_is_encoded_as_rclpy_does(rows: list[tuple]) -> None:
    encoded = Encoder()
    for stamp, frame, *values in rows:
        payload = Payload(*values, Status.TRACKING, (1.0, 2.0, 3.0), (1.0, 2.0, 3.0, 4.0, 5.0, 6.0))
        for _, value in messages.outgoing_payload(payload, stamp, frame):
            assert same(encoded(value), to_message(value))


@pytest.mark.parametrize('order', [1, 2, 6])
def test_models_and_modes_of_any_size_are_encoded_as_rclpy_does(order: int) -> None:
    encoded = Encoder()
    rng = np.random.default_rng(order)
    for count in (0, 1, 3, 0):
        model = StateSpace(
            rng.normal(size=(order, order)), rng.normal(size=(order, 2)), rng.normal(size=(4, order)),
            rng.normal(size=(4, 2)), rng.normal(size=(order, 4)), 0.001 + 1e-9 * count)
        modes = messages.modes_matrix(tuple(Mode(5.0 + k, 0.01, 0.1, 0.001) for k in range(count)))
        for value in (messages.model_matrix(model), modes):
            assert same(encoded(value), to_message(value))


@given(st.lists(RECORDS, max_size=6))
def test_records_are_encoded_as_rclpy_does_when_names_and_sizes_change(rows: list[tuple]) -> None:
    encoded = JointStateWriter()
    for k, (stamp, names, size) in enumerate(rows):
        record = JointRecord(
            stamp, names, np.arange(float(size)) + k, np.arange(2.0) * k, np.full(size, 0.5 * k))
        assert same(encoded(record), joint_state(record))


@given(st.lists(st.floats(), max_size=4), st.booleans())
def test_commands_are_read_from_bytes_whatever_their_layout(values: list[float], labelled: bool) -> None:
    message = Float64MultiArray(data=values)
    if labelled:
        message.layout.dim = [MultiArrayDimension(label='joints', size=len(values), stride=len(values))]
    assert np.array_equal(numbers(serialize_message(message)), np.array(values), equal_nan=True)


@given(st.binary(max_size=60))
def test_bytes_that_are_no_command_are_an_error_of_ours_or_numbers(raw: bytes) -> None:
    with suppress(SignalError):
        assert numbers(raw).dtype == np.float64
