"""Install each extra of pbonet alone into a clean environment, and import its packages.

Where an extra brings pinocchio, the modules of the library that know a robot from its
URDF file run there too, and must give the same with every version of it. The native
parts are those that stand in this checkout (`make native`).

    python scripts/check_extras.py [EXTRA ...]

It downloads some hundred MB, so that no test does it.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
IMPORTED_AS = {
    "pin": "pinocchio",
    "pyserial": "serial",
    "python-can": "can",
    "foxglove-sdk": "foxglove",
    "prometheus-client": "prometheus_client",
    "opentelemetry-sdk": "opentelemetry.sdk",
    "opentelemetry-exporter-otlp-proto-http": "opentelemetry.exporter.otlp.proto.http",
}
"""Names in import statements, where they are not the package's own."""
CLOSE = 1e-9
IMPORT = """
import importlib, sys
for name in sys.argv[1:]:
    importlib.import_module(name)
"""
RUN = """
import json, pathlib
from pbonet.testing import Bench
from pbonet.modules.controllers.computed_torque import ComputedTorque
from pbonet.modules.controllers.gravity import Gravity
from pbonet.modules.kinematics.fk_jac import FkJac
import pinocchio

robot = {"urdf": "panda.urdf"}
q = [0.1, -0.5, 0.2, -2.2, 0.3, 1.8, 0.785]
more = {"library": ["examples/panda"], "ndof": 7, "q": q}
found = {}
for cls, params in (
    (FkJac, {**robot, "frame": "hand"}),
    (Gravity, robot),
    (ComputedTorque, {**robot, "kp": (100.0,), "kd": (20.0,)}),
):
    bench = Bench(cls, params=params, freq=100, **more)
    bench.on()
    bench.step(n=30)
    for port in cls.__interface__.ports:
        if not port.kind.is_input:
            value = getattr(bench.outputs, port.attr)
            found[f"{cls.__name__}.{port.attr}"] = (
                [value] if isinstance(value, float) else value.ravel().tolist()
            )
print(json.dumps([pinocchio.__version__, found]))
"""
Found = dict[str, list[float]]


def name_of(requirement: str) -> str:
    """Return the package that a requirement names."""
    end = next((k for k, c in enumerate(requirement) if c in "<>=!~[; "), None)
    return requirement[:end]


def check(extra: str, wanted: list[str], base: list[str]) -> tuple[str, Found] | None:
    """Return pinocchio's version and what modules give with it, where there is one.

    Raises:
        subprocess.CalledProcessError: It does not install, or not import.
    """
    with tempfile.TemporaryDirectory(prefix="pbonet-") as folder:
        subprocess.run([sys.executable, "-m", "venv", folder], check=True)
        python = Path(folder) / "bin" / "python"
        install = [str(python), "-m", "pip", "install", "--quiet", *base, *wanted]
        subprocess.run(install, check=True)
        names = [IMPORTED_AS.get(one, one) for one in map(name_of, wanted)]
        subprocess.run([python, "-c", IMPORT, *names], check=True)
        print(f"{extra}: {' '.join(names)} imported")
        if not {"pinocchio", "placo"} & set(names):
            return None
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        done = subprocess.run(
            [python, "-W", "ignore", "-c", RUN],
            check=True,
            cwd=ROOT,
            env=environment,
            stdout=subprocess.PIPE,
            text=True,
        )
    version, found = json.loads(done.stdout.splitlines()[-1])
    print(f"{extra}: modules run with pinocchio {version}")
    return version, found


def main() -> int:
    """Check the extras that are named, or all; 1 if two pinocchios disagree."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    extras: dict[str, list[str]] = project["project"]["optional-dependencies"]
    base: list[str] = project["project"]["dependencies"]
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("extras", nargs="*", choices=[[], *extras], metavar="EXTRA")
    names: list[str] = parser.parse_args().extras or list(extras)
    results = [check(name, extras[name], base) for name in names]
    given = [one for one in results if one is not None]
    off = differences(given)
    print("\n".join(off) or agreement(given))
    return 1 if off else 0


def differences(given: list[tuple[str, Found]]) -> list[str]:
    """Return what modules give otherwise with a pinocchio than with the first one.

    Args:
        given: Its version, and what modules give with it.
    """
    return [
        f"{key} differs between pinocchio {given[0][0]} and {version}"
        for version, found in given[1:]
        for key, values in found.items()
        if max(map(distance, values, given[0][1][key])) > CLOSE
    ]


def agreement(given: list[tuple[str, Found]]) -> str:
    """Return what was compared, where nothing differs."""
    versions = [version for version, _ in given]
    if not versions:
        return "nothing was compared: no extra that was installed brings pinocchio"
    if len(versions) == 1:
        return f"nothing was compared: pinocchio {versions[0]} alone was installed"
    outputs = len(given[0][1])
    return (
        f"{outputs} outputs of modules agree with pinocchio {' and '.join(versions)}, "
        f"to {CLOSE:g}"
    )


def distance(a: float, b: float) -> float:
    """Return how far two numbers are from each other, relative to those above 1."""
    return abs(a - b) / max(1.0, abs(b))


if __name__ == "__main__":
    raise SystemExit(main())
