"""Drivers over CAN, J1939, I2C and converters of a real kernel, in User-Mode Linux."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
CHIPS = "i2c-stub:chip_addr=0x40,0x48,0x54"
MODULES = ("vcan", "can-raw", "can-j1939", "i2c-dev", CHIPS, "tmp006", "ti-adc081c")

pytestmark = [
    pytest.mark.uml,
    pytest.mark.slow,
    pytest.mark.skipif(
        shutil.which("linux.uml") is None,
        reason="linux.uml is not installed (apt-get install user-mode-linux)",
    ),
]


@pytest.fixture(scope="module")
def results():
    """Return what buses_and_converters.py prints; one guest for all tests."""
    options = [one for module in MODULES for one in ("-m", module)]
    file = ROOT / "tests" / "support" / "uml" / "buses_and_converters.py"
    done = subprocess.run(
        [sys.executable, ROOT / "scripts" / "umlrun.py", *options, file],
        capture_output=True,
        text=True,
        check=False,
        cwd=ROOT,
    )
    assert not done.returncode, done.stderr
    return json.loads(done.stdout)


def test_two_openings_of_a_can_bus_talk(results):
    can = results["can"]
    assert can["nothing"] == []
    assert (can["taken"], can["same"], can["stamps"]) == (6, True, True)
    assert can["answer"] == [5]


def test_a_program_that_is_killed_leaves_its_safe_frame_on_the_bus(results):
    assert results["can"]["killed"] == [[0x201, [*b"go"]], [0, [2, 0]]]


def test_drives_of_a_module_that_is_killed_are_stopped_on_the_bus(results):
    left = results["can"]["drives"]
    assert sorted(identity for identity, _ in left) == [0x201, 0x205]
    assert {tuple(data[:2]) for _, data in left} == {(2, 0)}, "quick stop"


def test_filters_of_the_kernel_hold(results):
    assert results["can"]["filtered"] == [0x181, 0x18FF0012, 0x181]


def test_frames_that_are_not_read_do_not_pile_up(results):
    sent, kept = results["can"]["flood"]
    assert sent == 2000
    assert 0 < kept < 2000
    assert results["can"]["unheard"], "an opening that only writes gets none"


def test_a_can_bus_that_goes_down_is_lost_and_opened_again(results):
    can = results["can"]
    assert "can (vcan0): the device is gone (got Network is down)" in can["lost"][0]
    assert "the device is gone (got Network is down)" in can["lost"][1]
    assert "the device is not open" in can["lost"][2]
    assert "the device is gone (got Network is down)" in can["lost"][3]
    assert can["again"] == 1
    assert "the device is gone (got No such device)" in can["deleted"]


def test_a_can_bus_that_is_down_or_missing_is_refused_at_open(results):
    assert "got Network is down" in results["can"]["down"]
    assert "No such device" in results["can"]["missing"]


def test_registers_of_an_i2c_device_are_read_and_written(results):
    i2c = results["i2c"]
    assert i2c["together"], "in one transfer, as the settings say"
    assert i2c["found"] == [0x1234, 0xFFFE, 7]
    assert i2c["signed"] == [-2]
    assert i2c["low"] == 0x12, "the first byte on the bus"
    assert i2c["back"] == 0xAB


def test_a_missing_i2c_device_is_named(results):
    i2c = results["i2c"]
    assert "nochip (/dev/i2c-0:0x50): the device is gone" in i2c["none"]
    assert "the I2C bus cannot be opened" in i2c["nobus"]


def test_converters_of_the_kernel_are_read(results):
    iio = results["iio"]
    assert iio["heats"] == [0x0C80 >> 2, -4660], "the ambient heat, and the voltage"
    assert (iio["values"], iio["bits"]) == ([[0xAB]] * 2, 8)


def test_a_buffer_that_the_kernel_does_not_start_is_named(results):
    """This kernel has converters with a buffer, and no trigger for them."""
    iio = results["iio"]
    assert "got buffer/enable: Invalid argument); set trigger" in iio["no_trigger"]
    assert iio["chosen"] == "1", "channels were chosen before"
    assert iio["known"] == [1, 8]
    assert "got No such file or directory" in iio["none"]


def test_a_converter_that_is_taken_away_is_lost(results):
    assert "the device is gone (got No such device)" in results["iio"]["lost"]


def test_groups_of_j1939_are_carried_by_the_kernel(results):
    j1939 = results["j1939"]
    assert j1939["heard"] == [[0xFEF1, 8, 0x21], [0xFEF2, 100, 0x21]]
    assert j1939["stamps"]
    assert j1939["large"] == [True, 0x20, 0x21], "1750 bytes"
    assert set(j1939["others"]) <= {0xFEF1, 0xFEF2, 0xEF00}
    assert j1939["back"] == ["back", 0x21, 0x20]


def test_a_group_for_a_node_that_is_missing_is_told_and_the_bus_works_on(results):
    j1939 = results["j1939"]
    assert "a group did not reach its destination" in j1939["nobody"]
    assert j1939["again"] == 1


def test_a_program_that_is_killed_leaves_its_safe_group_on_the_bus(results):
    """It has a hundred bytes, which the kernel sends in many frames."""
    killed = results["j1939"]["killed"]
    assert killed == [[0xFEF1, list(b"go")], [0xFEF3, [0] * 100]]


def test_a_bus_of_j1939_that_goes_down_is_lost(results):
    j1939 = results["j1939"]
    assert "the bus of J1939 cannot be opened" in j1939["down"]
    assert all("the device is gone" in one for one in j1939["lost"])
