"""While samples come the cores are asked not to sleep deeply; a refusal is told, and changes nothing else."""

import errno
import os
import struct
from pathlib import Path

import pytest
from identifier_harness import Live, recording
from ros_harness import Ros

from flexmanip_ros.ros.wake_latency import DEVICE, UNASKED, WakeLatency


def test_the_request_is_the_number_that_linux_reads_and_holds_while_the_file_is_open(tmp_path: Path) -> None:
    device = tmp_path / 'cpu_dma_latency'
    device.touch()
    wake = WakeLatency(25, str(device))
    assert wake.current == UNASKED
    assert wake.hold() == wake.hold() == ''  # asked twice: made once
    assert struct.unpack('=i', device.read_bytes()) == (25,)
    assert wake.current == 25
    wake.release()
    wake.release()
    assert wake.current == UNASKED


def test_no_request_is_made_where_none_is_wanted(tmp_path: Path) -> None:
    device = tmp_path / 'cpu_dma_latency'
    device.touch()
    assert WakeLatency(UNASKED, str(device)).hold() == ''
    assert device.read_bytes() == b''


def test_a_refusal_is_told_not_raised(tmp_path: Path) -> None:
    wake = WakeLatency(0, str(tmp_path / 'nowhere'))
    assert wake.hold() == os.strerror(errno.ENOENT)
    assert wake.current == UNASKED
    wake.release()


permitted = pytest.mark.skipif(not os.access(DEVICE, os.W_OK),
                               reason='this system permits no request to the power management')


@permitted
def test_linux_takes_the_request() -> None:
    wake = WakeLatency(0)
    assert wake.hold() == ''
    with open(DEVICE, 'rb', buffering=0) as device:
        assert struct.unpack('=i', device.read(4)) == (0,)
    wake.release()


@permitted
def test_the_identifier_makes_it_while_samples_come_and_not_in_silence(ros: Ros) -> None:
    live = Live(ros)
    ros.wait(lambda: live.values().get('wake_latency') == '-1', what='nothing asked for in silence')
    live.send(*recording()[:50])
    ros.wait(lambda: live.values()['wake_latency'] == '0', what='the request')
    ros.wait(lambda: live.values()['wake_latency'] == '-1', what='its end')
