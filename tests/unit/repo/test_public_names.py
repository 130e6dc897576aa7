"""What users import, and what importing it costs."""

import importlib
import subprocess
import sys

import pytest

PUBLIC = [
    "pbonet",
    "pbonet.config",
    "pbonet.master",
    "pbonet.svar",
    "pbonet.testing",
    "pbonet.xm",
]


@pytest.mark.parametrize("name", PUBLIC)
def test_exported_names_exist(name: str) -> None:
    module = importlib.import_module(name)
    assert module.__all__
    for exported in module.__all__:
        assert getattr(module, exported) is not None


@pytest.mark.parametrize(
    "name", ["pbonet", "pbonet.master", "pbonet.analysis.legality", "pbonet.xm"]
)
def test_no_network_is_loaded_before_it_is_asked_for(name: str) -> None:
    code = f"import sys, {name}; sys.exit('zenoh' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_name_that_the_master_does_not_have_is_an_attribute_error() -> None:
    master = importlib.import_module("pbonet.master")
    with pytest.raises(AttributeError, match="no attribute 'Boss'"):
        _ = master.Boss
    assert master.Subsystem.__module__ == "pbonet.master.console.program"
