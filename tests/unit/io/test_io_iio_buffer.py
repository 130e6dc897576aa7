"""Buffers of converters: a folder of plain files and a pipe stand for the kernel."""

from __future__ import annotations

import errno
import os
import struct
import threading
from pathlib import Path

import pytest
from device_rigs import IioBuffer

from pbonet.errors import DeviceError
from pbonet.io.drivers import Mode, Wait, database, open_device
from pbonet.io.drivers.iio_buffer_driver import Sample


@pytest.fixture
def rig(monkeypatch, tmp_path):
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))
    one = IioBuffer(monkeypatch, tmp_path)
    yield one
    one.close()


def opened(rig, *ports, wait=Wait.NONE, settings=None, **how):
    with database.using({"x": rig.entry(**(settings or {}))}):
        return open_device("x", *ports, mode=Mode.READ, wait=wait, **how)


def kept(rig, name):
    return (rig.path / name).read_text().split("\n")[0]


def one_sample(rig, low, high, byte, stamp):
    """Send a sample of all channels: 12 bits above 4, a byte, 24 bits above 8."""
    big = (high << 8).to_bytes(4, "big")
    os.write(rig.fd, struct.pack("<HBx4sq", low << 4, byte, big, stamp))


def test_a_sample_has_all_channels_in_the_order_of_their_ports(rig):
    with opened(rig, 0, 2, signed=True) as adc:
        names = ("voltage0", "voltage2", "voltage10", "timestamp")
        assert [kept(rig, f"scan_elements/in_{one}_en") for one in names] == ["1"] * 4
        assert kept(rig, "current_timestamp_clock") == "realtime"
        assert (kept(rig, "buffer/length"), kept(rig, "buffer/enable")) == ("128", "1")
        one_sample(rig, 0x7FF, 0x123456, 0xFF, 42)
        one_sample(rig, 0x800, 0x923456, 0x01, 43)
        assert adc.read(9) == [
            Sample([0x7FF, 0x123456, -1], 42),
            Sample([-0x800, 0x923456 - (1 << 24), 1], 43),
        ]
        assert [adc.status("PORTSIZE", k) for k in range(3)] == [12, 24, 8]
    assert kept(rig, "buffer/enable") == "0"


def test_some_channels_have_a_layout_of_their_own(rig):
    rig.set("scan_elements/in_voltage10_en", "1\n")  # of an earlier user
    settings = {"channels": ["voltage2", "voltage0"], "trigger": "t1", "length": 8}
    with opened(rig, 0, settings=settings) as adc:
        assert kept(rig, "scan_elements/in_voltage10_en") == "0"
        assert kept(rig, "trigger/current_trigger") == "t1"
        assert kept(rig, "buffer/length") == "8"
        os.write(rig.fd, struct.pack(">I4x", 0x12345600) + struct.pack("<q", 7))
        assert adc.read(1) == [Sample([0x123456], 7)]


def test_a_device_without_stamps_has_none(rig):
    for part in ("type", "index", "en"):
        (rig.path / f"scan_elements/in_timestamp_{part}").unlink()
    (rig.path / "current_timestamp_clock").unlink()
    with opened(rig, 0, 2, size=8, trunc_lsb=True) as adc:
        os.write(rig.fd, struct.pack("<HBx4s", 0xABC0, 5, b"\x12\x34\x56\0"))
        assert adc.read(1) == [Sample([0xAB, 0x12, 5], 0)]


@pytest.mark.parametrize(
    ("wait", "there", "asked", "got"),
    [
        (Wait.NONE, 0, 2, 0),
        (Wait.NONE, 3, 2, 2),
        (Wait.NOALL, 1, 2, 0),
        (Wait.NOALL, 2, 2, 2),
        (Wait.ONE, 1, 2, 1),
        (Wait.ALL, 3, 2, 2),
    ],
)
def test_samples_are_awaited_as_the_device_was_opened(rig, wait, there, asked, got):
    with opened(rig, 0, 2, wait=wait) as adc:
        for k in range(there):
            one_sample(rig, 0, 0, 0, k)
        assert [one.stamp_ns for one in adc.read(asked)] == list(range(got))
        for k in range(there, 4):
            one_sample(rig, 0, 0, 0, k)
        assert [one.stamp_ns for one in adc.read(4 - got)] == list(range(got, 4))


def test_a_reader_waits_for_samples(rig):
    found = []
    with opened(rig, 0, 2, wait=Wait.ALL) as adc:
        reads = threading.Thread(target=lambda: found.extend(adc.read(2)))
        reads.start()
        for k in (1, 2):
            one_sample(rig, 0, 0, 0, k)
        reads.join()
    assert [one.stamp_ns for one in found] == [1, 2]


@pytest.mark.parametrize(
    ("name", "text", "settings", "told"),
    [
        ("scan_elements/in_voltage0_type", "le:s12/16X2>>4", {}, "such as le:s12/16"),
        ("scan_elements/in_voltage0_type", "", {}, "such as le:s12/16>>4"),
        ("scan_elements/in_voltage0_index", "x", {}, "cannot be started"),
        ("buffer/length", "0", {"channels": ["voltage1"]}, "got voltage1"),
        ("buffer/length", "0", {"length": 1}, "a setting of the device is wrong"),
    ],
)
def test_what_cannot_be_is_refused_at_open(rig, name, text, settings, told):
    rig.set(name, text)
    with pytest.raises(DeviceError, match=told):
        opened(rig, settings=settings)
    assert kept(rig, "buffer/enable") == "0"


def test_what_the_kernel_refuses_is_named(rig, monkeypatch):
    """A plain file cannot answer so; the kernel does, of a device without a trigger."""
    write = os.write

    def refuses(fd, data):
        name = Path(f"/proc/self/fd/{fd}").readlink().name
        if (name, data) == ("enable", b"1\n"):
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        return write(fd, data)

    monkeypatch.setattr(os, "write", refuses)
    told = r"got buffer/enable: Invalid argument.*set trigger in agent.toml"
    with pytest.raises(DeviceError, match=told):
        opened(rig)
    monkeypatch.undo()


def test_a_device_without_a_buffer_is_refused(rig):
    (rig.path / "scan_elements").rename(rig.path / "other")
    with pytest.raises(DeviceError, match=r"No such file.*trigger"):
        opened(rig)
