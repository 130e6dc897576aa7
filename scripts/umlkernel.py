"""Build a kernel for User-Mode Linux with simulated devices that Debian's one lacks.

    apt-get install linux-source flex bison bc
    python scripts/umlkernel.py [--jobs 2]

It has lines of a chip (gpio-sim), joysticks (uinput), converters with a buffer and a
trigger (iio_dummy), and a bus of SPI with spidev; it has no modules. It is built once
from Debian's source, by the options of umlkernel.config, and kept in
``$XDG_CACHE_HOME/pbonet``. `--where` prints its path; the exit status is 1 where it has
not been built. `umlrun.py --kernel FILE` runs a program on it, `pytest -m
uml_own_kernel` the tests that need it.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Final

HERE: Final = Path(__file__).resolve().parent
CONFIG: Final = HERE / "umlkernel.config"
SPI_BUS: Final = HERE / "spi_loopback.c"
SOURCES: Final = Path("/usr/src")
PATTERN: Final = "linux-source-*.tar.xz"
NEEDED: Final = ("make", "gcc", "flex", "bison", "bc", "tar", "xz")


def kernel() -> Path:
    """Return where the kernel of this configuration is kept, built or not."""
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    made_of = hashlib.sha256(CONFIG.read_bytes() + SPI_BUS.read_bytes())
    return Path(cache) / "pbonet" / f"linux-uml-{made_of.hexdigest()[:12]}"


def source() -> Path:
    """Return the newest source of a kernel that is installed.

    Raises:
        LookupError: There is none.
    """
    found = sorted(SOURCES.glob(PATTERN), key=version)
    if not found:
        raise LookupError(
            f"no {PATTERN} in {SOURCES}; Debian's package is linux-source"
        )
    return found[-1]


def version(archive: Path) -> list[int]:
    """Return the version in an archive's name: 6.12 is newer than 6.9."""
    return [int(number) for number in re.findall(r"\d+", archive.name)]


def build(jobs: int) -> Path:
    """Build the kernel; return where it is.

    Raises:
        LookupError: The source or a program is missing.
        CalledProcessError: A step failed.
    """
    if missing := [one for one in NEEDED if shutil.which(one) is None]:
        raise LookupError(f"these programs are missing: {' '.join(missing)}")
    archive, target = source(), kernel()
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="linux-", dir=target.parent) as folder:
        tree = Path(folder)
        run("tar", "-xf", str(archive), "-C", folder, "--strip-components=1")
        shutil.copy(SPI_BUS, tree / "drivers" / "spi")
        with (tree / "drivers" / "spi" / "Makefile").open("a") as file:
            file.write(f"obj-y += {SPI_BUS.stem}.o\n")
        make = ("make", "-s", "-C", folder, "ARCH=um")
        run(*make, "allnoconfig", f"KCONFIG_ALLCONFIG={CONFIG}")
        if refused := lacking(tree / ".config"):
            raise LookupError(f"the kernel cannot have {' '.join(refused)}")
        run(*make, f"-j{jobs}", "linux")
        run("strip", str(tree / "linux"))
        made = tree / "linux"
        made.replace(target)
    return target


def lacking(made: Path) -> list[str]:
    """Return the lines of the configuration that a kernel's own one does not have."""
    has = set(made.read_text().splitlines())
    wanted = CONFIG.read_text().splitlines()
    return [one for one in wanted if one.startswith("CONFIG_") and one not in has]


def run(*command: str) -> None:
    """Run a step, which must succeed."""
    subprocess.run(command, check=True, stdin=subprocess.DEVNULL)


def main() -> int:
    """Build the kernel, or say where it is."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--where", action="store_true", help="print its path only")
    told = parser.parse_args()
    if told.where:
        print(kernel())
        return 0 if kernel().exists() else 1
    begin = time.monotonic()
    try:
        made = build(told.jobs)
    except (LookupError, subprocess.CalledProcessError) as error:
        print(f"umlkernel: {error}", file=sys.stderr)
        return 1
    print(f"{made}, built in {time.monotonic() - begin:.0f} s")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
