"""The page on devices: its thermometer and its driver are run as they stand there."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path

import pytest

from pbonet.errors import DeviceError
from pbonet.io.drivers import Entry, Mode, database, open_device
from pbonet.testing import Bench

PAGE = Path(__file__).parents[3] / "docs" / "devices.md"
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)


@pytest.fixture(autouse=True)
def run_dir(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))


@pytest.fixture
def latch(tmp_path, monkeypatch):
    """The page's driver in a package, with a register file of eight bytes."""
    (tmp_path / "latch_driver.py").write_text(BLOCKS[-1])
    monkeypatch.syspath_prepend(str(tmp_path))
    registers = tmp_path / "registers"
    registers.write_bytes(bytes(range(8)))
    entry = Entry(driver="latch_driver:Latch", address=str(registers), first=2, ports=6)
    with database.using({"latch": entry}):
        yield registers
    sys.modules.pop("latch_driver", None)


def test_its_driver_reads_and_writes_ports(latch):
    with open_device("latch", 1, 2, mode=Mode.RW, safe=None, size=8) as ports:
        assert ports.read() == [3, 4]
        ports.write([200, -1])
    assert latch.read_bytes() == bytes((0, 1, 2, 200, 255, 5, 6, 7))
    for wrong in ("latch_driver:Lutch", "latch_driver:os", "no_such:Latch", "latch"):
        with (
            database.using({"x": Entry(driver=wrong, address="")}),
            pytest.raises(DeviceError, match="there is no driver"),
        ):
            open_device("x")


@pytest.mark.usefixtures("latch")
def test_its_thermometer_measures(tmp_path):
    (tmp_path / "thermometer.py").write_text(BLOCKS[0])
    module = _loaded(tmp_path / "thermometer.py").Thermometer
    told = {"device": "latch", "port": 3, "slope": 0.5}
    with Bench(module, params=told) as bench:
        bench.on()
        bench.step()
        assert bench["T_MEZ"] == 2.5


def _loaded(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
