"""An SPI bus at the edge of spidev."""

from __future__ import annotations

import pytest
from device_rigs import Spi

from pbonet.errors import DeviceError
from pbonet.io.drivers import Mode, Wait, database, open_device


@pytest.fixture
def bus(monkeypatch, tmp_path):
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))
    return Spi(monkeypatch, tmp_path)


def opened(bus, mode=Mode.RW, settings=None, **how):
    with database.using({"x": bus.entry(**(settings or {}))}):
        if Mode.WRITE in mode:
            how["safe"] = None
        return open_device("x", mode=mode, **how)


def test_a_transfer_writes_and_reads_as_many_bytes(bus):
    with opened(bus) as one:
        assert one.transfer(b"\x01\xfe\x03") == b"\xff\xff\xff"
        assert one.read(4) == b"\x01\xfe\x03\xff"
        assert one.write(b"ab") == 2
        assert one.transfer(bytes(4096))[:2] == b"ab"
    assert bus.log[:3] == ["open", ("mode", 0), ("max_speed_hz", 500_000)]
    assert bus.log[3:6] == [b"\x01\xfe\x03", bytes(4), b"ab"]
    assert bus.log[-1] == "closed"


def test_settings_reach_the_bus(bus):
    settings = {"mode": 3, "speed": 1000, "lsb_first": True, "cs_high": True}
    opened(bus, settings=settings).close()
    assert bus.log[1:5] == [
        ("mode", 3), ("max_speed_hz", 1000), ("lsbfirst", True), ("cshigh", True)
    ]  # fmt: skip


@pytest.mark.parametrize("refused", ["mode", "lsbfirst", "cshigh"])
def test_what_the_bus_refuses_is_told_and_it_is_closed(bus, refused):
    bus.refused = {refused}
    settings = {"lsb_first": True, "cs_high": True}
    with pytest.raises(DeviceError, match=r"got Invalid argument.*lsb_first and cs"):
        opened(bus, settings=settings)
    assert bus.log[-1] == "closed"


@pytest.mark.parametrize(
    ("mode", "call", "told"),
    [
        (Mode.RW, lambda x: x.transfer(bytes(4097)), "got 4097"),
        (Mode.RW, lambda x: x.transfer(b""), "expected 1 to 4096 bytes, got 0"),
        (Mode.RW, lambda x: x.read(0), "got 0"),
        (Mode.READ, lambda x: x.transfer(b"a"), "not open in this direction"),
        (Mode.WRITE, lambda x: x.read(1), "not open in this direction"),
        (Mode.READ, lambda x: x.write(b"a"), "not open in this direction"),
    ],
)
def test_what_cannot_be_transferred_is_refused(bus, mode, call, told):
    with opened(bus, mode) as one:
        with pytest.raises(DeviceError, match=told):
            call(one)
        assert not [x for x in bus.log if isinstance(x, bytes)]


def test_it_has_one_way_to_wait(bus):
    with pytest.raises(DeviceError, match="got wait none"):
        opened(bus, wait=Wait.NONE)
