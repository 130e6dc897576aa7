"""Drivers over devices that a kernel of scripts/umlkernel.py simulates."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
SCRIPTS = ROOT / "scripts"


def kernel():
    """Return the path of the kernel; empty: it was not built."""
    command = [sys.executable, SCRIPTS / "umlkernel.py", "--where"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return "" if done.returncode else done.stdout.strip()


pytestmark = [
    pytest.mark.uml_own_kernel,
    pytest.mark.slow,
    pytest.mark.skipif(
        not kernel(), reason="the kernel is not built (python scripts/umlkernel.py)"
    ),
]


@pytest.fixture(scope="module")
def results():
    """Return what simulated_chips.py prints; one guest for all tests."""
    file = ROOT / "tests" / "support" / "uml" / "simulated_chips.py"
    run = [sys.executable, SCRIPTS / "umlrun.py", "--kernel", kernel(), file]
    done = subprocess.run(run, capture_output=True, text=True, check=False, cwd=ROOT)
    assert not done.returncode, done.stderr
    return json.loads(done.stdout)


def of(results, name):
    found = results[name]
    assert "failed" not in found, found["failed"]
    return found


def test_lines_begin_with_their_safe_values_and_have_them_again(results):
    gpio = of(results, "gpio")
    assert gpio["begin"] == [1, 0, 0], "line 1 is active when it is low"
    assert gpio["written"] == [[0, 1, 1], [0, 0, 1]]
    assert gpio["safe"] == [1, 0, 0]
    assert gpio["ports"] == 8
    assert gpio["closed"] == [0, 0, 0], "this chip's lines go back to their pull"
    assert gpio["kept"] == [1], "without safe values a line keeps its value"


def test_lines_are_read_and_pulled(results):
    gpio = of(results, "gpio")
    assert (gpio["read"], gpio["read again"]) == ([0, 1], [1, 1])
    assert gpio["biased"] == [1]


def test_lines_that_are_taken_or_not_there_are_named(results):
    gpio = of(results, "gpio")
    assert "the lines cannot be had" in gpio["taken"]
    assert "Device or resource busy" in gpio["taken"]
    assert "No such file or directory" in gpio["missing"]
    assert "no such ports" in gpio["beyond"]


def test_edges_have_the_kernels_stamps_and_those_that_were_dropped_are_counted(results):
    gpio = of(results, "edges")
    assert gpio["edges"] == [[0, True], [1, True], [0, False]]
    assert gpio["in order"], "by the clock on the wall"
    assert gpio["held"] == 16, "as the setting says"
    assert gpio["dropped"] > 0
    assert gpio["falling"] == [0, False]


def test_a_chip_that_is_removed_is_lost(results):
    values, again = of(results, "gpio")["lost"]
    assert "the device is gone (got No such device)" in values
    assert "the device is not open" in again
    assert "the device is gone" in of(results, "edges")["lost"]


def test_a_joystick_has_its_state_and_ranges_and_moves(results):
    stick = of(results, "joystick")
    assert stick["begin"] == [128, 0, 0, 1]
    assert stick["ranges"] == [[0, 255], [-100, 100], [0, 1], [0, 1]]
    assert stick["moved"] == [128, -100, 1, 0]
    assert "no such axis" in stick["no axis"]


def test_a_joystick_whose_events_were_lost_is_asked_and_one_that_is_pulled_is_lost(
    results,
):
    stick = of(results, "joystick")
    assert stick["flooded"] == [17, -100, 1, 0]
    assert "the device is gone (got No such device)" in stick["lost"][0]
    assert "the device is not open" in stick["lost"][1]
    assert "there is no joystick" in stick["missing"]


def test_converters_in_both_directions(results):
    iio = of(results, "iio")
    assert iio["dac"] == 1234
    assert iio["dac safe"] == 5
    assert iio["adc"] == [[73, 34], [13, 16]]
    assert iio["channels"] == 4


def test_samples_of_a_trigger_come_in_order_with_stamps(results):
    iio = of(results, "iio")
    assert iio["samples"] == [[344, 7, -33, -2]] * 2
    assert iio["bits"] == [16, 13, 12, 11]
    assert iio["in order"]
    assert iio["one channel"] == [7]
    assert "a port of the device is taken" in iio["running"]
    assert "the converter's buffer cannot be started" in iio["no trigger"]


def test_a_converter_that_is_removed_while_its_buffer_runs_is_lost(results):
    assert "the device is gone" in of(results, "iio")["lost"]


def test_a_bus_of_spi_answers_what_it_is_sent(results):
    spi = of(results, "spi")
    assert (spi["answer"], spi["most"]) == (True, True)
    assert (spi["read"], spi["write"]) == ([0, 0, 0], 3)
    assert "the SPI bus cannot be opened" in spi["refused"]
    assert "No such file or directory" in spi["missing"]
    assert "the device is gone" in spi["lost"][0]
    assert "the device is not open" in spi["lost"][1]
