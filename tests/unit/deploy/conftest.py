"""Wheels that have nothing but their names and lists."""

import zipfile

import pytest


@pytest.fixture
def make_wheel(tmp_path):
    """Make a wheel of pbonet; return its path."""

    def one(version="0.2.0", tag="cp311-cp311-manylinux_2_17_x86_64", record="a"):
        path = tmp_path / f"pbonet-{version}-{tag}.whl"
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr(
                f"pbonet-{version}.dist-info/RECORD", f"{version} {record}"
            )
        return path

    return one
