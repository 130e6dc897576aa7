"""Converters by files of sysfs; here a folder of plain files stands for it."""

from __future__ import annotations

import errno
import gc
import os
import shutil
from pathlib import Path

import pytest

from pbonet.errors import DeviceError
from pbonet.io import no_devices
from pbonet.io.drivers import Entry, Mode, Wait, database, open_device
from pbonet.outside import Player, Tape, using as recording

FILES = {
    "in_voltage10_raw": "7\n",
    "in_voltage2_raw": "-5\n",
    "in_temp_raw": "4660\n",
    "out_voltage0_raw": "0\n",
    "out_voltage1_raw": "0\n",
    "in_voltage2_scale": "0.5\n",
    "scan_elements/in_voltage2_type": "le:s12/16>>4\n",
    "scan_elements/in_voltage10_type": "be:u24/32X2>>8\n",
    "scan_elements/out_voltage1_type": "le:s8/8>>0\n",
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))
    folder = tmp_path / "iio:device0"
    (folder / "scan_elements").mkdir(parents=True)
    for name, text in FILES.items():
        (folder / name).write_text(text)
    return folder


def device(folder, driver="iio_adc", owner="arm0/reads", **settings):
    first = settings.pop("first", 0)
    entry = Entry(driver=driver, address=str(folder), settings=settings, first=first)
    return database.using({"x": entry}, owner)


def written(folder, name):
    return (folder / name).read_text().split()[0]


def test_all_channels_are_read_in_the_order_of_their_numbers(folder):
    with device(folder), open_device("x", 0, 2, mode=Mode.READ, signed=True) as adc:
        assert adc.read() == [4660, -5, 7]
        (folder / "in_temp_raw").write_text("-32768\n")
        assert adc.read() == [-32768, -5, 7]
        assert adc.status("PORTNUM") == 3
        assert [adc.status("PORTSIZE", k) for k in range(3)] == [16, 12, 24]
        with pytest.raises(DeviceError, match="no such ports"):
            adc.status("PORTSIZE", 3)


def test_channels_are_chosen_and_raw_values_have_their_bits(folder):
    chosen = {"channels": ["voltage10", "voltage2", "temp"], "bits": 14, "first": 1}
    with device(folder, **chosen), open_device("x", 0, 1, mode=Mode.READ) as adc:
        assert adc.read() == [0xFFB, 4660]
        assert adc.status("PORTSIZE", 1) == 14


def test_values_are_written_with_the_sign_of_their_channel(folder):
    with (
        device(folder, "iio_dac"),
        open_device("x", 0, 1, mode=Mode.WRITE, safe=None, size=16) as dac,
    ):
        dac.write([65535, 0xFE])
        assert written(folder, "out_voltage0_raw") == "65535"
        assert written(folder, "out_voltage1_raw") == "-2"
        with pytest.raises(DeviceError, match="a value for each opened port"):
            dac.write([1])


@pytest.mark.parametrize(
    ("settings", "how", "told"),
    [
        ({"channels": ["voltage3"]}, {}, "expected temp voltage2 voltage10, got volt"),
        ({"channels": ["voltage1"]}, {"start": 0}, "no such input channel"),
        ({}, {"end": 3}, "the device has no such ports"),
        ({"first": 2}, {"start": 1}, "expected 0 to 0"),
        ({}, {"mode": Mode.WRITE}, "cannot be opened in this direction"),
        ({}, {"wait": Wait.NONE}, "cannot do this"),
        ({"driver": "iio_dac"}, {}, "cannot be opened in this direction"),
        (
            {"driver": "iio_dac"},
            {"mode": Mode.WRITE, "safe": None, "start": 2},
            "no such ports",
        ),
        ({"bits": 0}, {}, "a setting of the device is wrong"),
    ],
)
def test_what_cannot_be_is_refused_at_open(folder, settings, how, told):
    gc.collect()  # what tests before this one left open is not counted
    fds = len(list(Path("/proc/self/fd").iterdir()))
    a_program = device(folder, owner="", **settings)  # a task would wait for the ports
    with a_program, pytest.raises(DeviceError) as caught:
        open_device(**({"name": "x", "mode": Mode.READ} | how))
    assert told in str(caught.value)
    assert len(list(Path("/proc/self/fd").iterdir())) == fds


def test_a_folder_that_is_none_is_named(folder):
    with device(folder / "no"), pytest.raises(DeviceError, match="No such file"):
        open_device("x", mode=Mode.READ)
    (folder / "scan_elements" / "in_temp_type").write_text("float\n")
    with device(folder), pytest.raises(DeviceError, match="such as le:s12/16>>4"):
        open_device("x", mode=Mode.READ)


@pytest.mark.parametrize(
    "text", ["", "4.5\n", "nan\n", "65536\n", "-32769\n", "\0" * 100_000, "9" * 100_000]
)
def test_a_value_that_is_no_number_is_refused_and_the_device_works_on(folder, text):
    with device(folder), open_device("x", mode=Mode.READ) as adc:
        (folder / "in_temp_raw").write_text(text)
        with pytest.raises(DeviceError, match="no number of its size") as caught:
            adc.read()
        assert "channel temp" in str(caught.value)
        (folder / "in_temp_raw").write_text("1\n")
        assert adc.read() == [1]


@pytest.mark.parametrize(
    ("number", "told"),
    [
        (errno.ENODEV, "the device is gone"),
        (errno.EBUSY, "refuses a channel's value"),
    ],
)
@pytest.mark.parametrize("driver", ["iio_adc", "iio_dac"])
def test_what_the_kernel_answers_is_told(folder, monkeypatch, driver, number, told):
    """A plain file cannot answer so; the kernel does, of a device that is unplugged."""

    def refuses(*_):
        raise OSError(number, os.strerror(number))

    def move(one):
        return one.read() if driver == "iio_adc" else one.write([3])

    mode = Mode.READ if driver == "iio_adc" else Mode.WRITE
    with device(folder, driver), open_device("x", mode=mode, safe=None) as one:
        with monkeypatch.context() as patch:
            patch.setattr(os, "pread", refuses)
            patch.setattr(os, "pwrite", refuses)
            with pytest.raises(DeviceError, match=told):
                move(one)
        if number == errno.EBUSY:
            move(one)
        else:
            with pytest.raises(DeviceError, match="the device is not open"):
                move(one)
            open_device("x", mode=mode, safe=None).close()  # its ports are free


def test_what_was_read_replays_without_a_device(folder):
    def run():
        with open_device("x", 0, 2, mode=Mode.READ, signed=True) as adc:
            found = [adc.read(), adc.status("PORTSIZE", 1), adc.status("PORTNUM")]
        with pytest.raises(DeviceError) as caught:
            open_device("x", 4, mode=Mode.READ)
        return [*found, str(caught.value)]

    tape = Tape()
    with device(folder), recording(tape):
        first = run()
    assert first[:3] == [[4660, -5, 7], 12, 3]
    shutil.rmtree(folder)
    player = Player()
    player.feed(tape.take())
    with database.using({}), no_devices("this is a replay"), recording(player):
        assert run() == first
