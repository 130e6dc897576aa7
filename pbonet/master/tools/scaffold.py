"""Writes the frame of a new module from a list of ports (Stewart 1994, section 3.7).

Pure: names and ports in, texts out. The command line (``pbonet new module``) does the
reading and writing of files.
"""

from __future__ import annotations

import keyword
import sys
from typing import TYPE_CHECKING

from msgspec import structs

from pbonet.config import Rmod, TaskType, element_type, write_rmod
from pbonet.errors import ConfigError
from pbonet.ports import Kind, parse_shape, shape_text

from .scaffold_c import MAKEFILE, c_text

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from pbonet.config import SvarFile

    from .scaffold_port import NewPort

_CLASSES = {
    Kind.INCONST: "InConst",
    Kind.OUTCONST: "OutConst",
    Kind.INVAR: "InVar",
    Kind.OUTVAR: "OutVar",
}
_IMPORTED = frozenset({"pbonet", "numpy", "pytest"})
_WIDTH = 88


def scaffold(
    name: str,
    ports: Sequence[NewPort],
    *,
    desc: str = "",
    freq: float = 100.0,
    svar: SvarFile | None = None,
    timing_failure: bool = False,
    own_tree: bool = False,
    in_c: bool = False,
) -> dict[str, str]:
    """Return the files of a new module, by their names in the library's folder.

    Args:
        name: The module's name: letters, digits and underscores.
        ports: Its ports.
        desc: What it does, in one line.
        freq: Its default frequency in Hz.
        svar: Where sizes are named by a constant: a number of elements that equals the
            first value of an integer constant port is written as that constant.
        timing_failure: Whether it has a handler of timing failures, to begin with
            one that gives up a cycle which misses its deadline.
        own_tree: Whether the files go into a project that has pbonet's own source,
            where a blank line separates its imports from numpy's; see `in_own_tree`.
        in_c: Whether the module is written in C, with a Makefile.

    Returns:
        The module, its RMOD, and its test.

    Raises:
        ConfigError: The name or the ports cannot be a module's.
    """
    _check_name(name)
    _check_ports(ports)
    ports = _named_sizes(ports, svar)
    desc = desc.strip().rstrip(".") or f"Module {name}"
    if in_c:
        code = {
            f"{name}.c": c_text(name, ports, desc, handler=timing_failure),
            "Makefile": MAKEFILE,
        }
    else:
        text = _module_text(name, ports, desc, handler=timing_failure, apart=own_tree)
        code = {f"{name}.py": text}
    return {
        **code,
        f"{name}.rmod": _rmod_text(name, ports, desc, freq),
        f"tests/test_{name}.py": _test_text(
            ports, handler=timing_failure, apart=own_tree, in_c=in_c
        ),
    }


def in_own_tree(folder: Path) -> bool:
    """Return whether `folder` belongs to a project that has pbonet's source in it."""
    for parent in (folder.absolute(), *folder.absolute().parents):
        if (parent / "pyproject.toml").is_file():
            return (parent / "pbonet").is_dir() or (parent / "src/pbonet").is_dir()
    return False


def class_name(name: str) -> str:
    """Return the class of module `name`: ``joint_pid`` gives ``JointPid``."""
    return "".join(word[:1].upper() + word[1:] for word in name.split("_"))


def _check_name(name: str) -> None:
    plain = name.isidentifier() and name.isascii() and name == name.lower()
    if not plain or name.startswith("_") or keyword.iskeyword(name):
        raise ConfigError(
            "the name cannot be a module's",
            where=name,
            expected="lower-case letters, digits and underscores, a letter first",
            remedy="choose another name",
        )
    if name in sys.stdlib_module_names or name in _IMPORTED:
        raise ConfigError(
            f"a file {name}.py would hide the package of that name from Python",
            where=name,
            remedy="choose another name for the module",
        )


def _check_ports(ports: Sequence[NewPort]) -> None:
    seen: dict[str, str] = {}
    for port in ports:
        other = seen.setdefault(port.attr, port.name)
        if other != port.name or [one.name for one in ports].count(port.name) > 1:
            raise ConfigError(
                f"ports {other} and {port.name} are one attribute, {port.attr}"
                if other != port.name
                else f"port {port.name} is named twice",
                where=port.name,
                remedy="leave one out, and write it by hand under another attribute"
                if other != port.name
                else "leave one out; an output holds what was written last, so it need "
                "not be read as well",
            )


def _named_sizes(ports: Sequence[NewPort], svar: SvarFile | None) -> list[NewPort]:
    """Write sizes as constants: by attribute, and where the first value is the same."""
    first = {
        variable.name: int(variable.init[0])
        for variable in (svar.variables if svar else ())
        if variable.init and variable.nelem == 1
    }
    names: dict[str, str] = {}
    for port in ports:
        if port.kind.is_const and _scalar(port) == "int":
            names[port.name] = port.attr
            if port.name in first:
                names.setdefault(str(first[port.name]), port.attr)
    return [
        structs.replace(port, shape=_named(port, names) or f"{_ALONE}{port.attr}")
        for port in ports
    ]


_ALONE = "n_"
"""Begins the size of a single structure, which is an array of one."""


def _named(port: NewPort, names: Mapping[str, str]) -> str:
    """Return a port's shape with constants by attribute; empty for one structure."""
    dims = parse_shape(port.shape)
    if not dims:
        return "" if port.type.startswith("struct") else "1"
    return shape_text(tuple(names.get(str(dim), dim) for dim in dims))


def _scalar(port: NewPort) -> str:
    """Return ``float``, ``int`` or ``bool`` for a scalar port, else an empty string."""
    element = element_type(port.type)
    if parse_shape(port.shape) or element is None or element.is_struct:
        return ""
    if element.is_bool:
        return "bool"
    return "float" if element.is_float else "int"


def _annotation(port: NewPort) -> str:
    """Return the Python type of a port."""
    import numpy as np

    scalar = _scalar(port)
    if scalar:
        return scalar
    element = element_type(port.type)
    dtype = np.dtype(element.dtype if element else "f8")
    if dtype == np.dtype("f8"):
        return "Matrix" if len(parse_shape(port.shape)) > 1 else "Vector"
    kind = {"V": "void", "b": "bool_"}.get(dtype.kind, dtype.name)
    return f"NDArray[np.{kind}]"


def _declaration(port: NewPort) -> list[str]:
    """Return the lines that declare a port."""
    words = [port.name, port.shape, port.unit, port.doc or _doc(port)]
    quoted = ", ".join(_quoted(word) for word in words)
    line = f"    {port.attr}: A[{_annotation(port)}, {_CLASSES[port.kind]}({quoted})]"
    if len(line) <= _WIDTH:
        return [line]
    middle = f"        {_annotation(port)}, {_CLASSES[port.kind]}({quoted})"
    if len(middle) <= _WIDTH:
        return [f"    {port.attr}: A[", middle, "    ]"]
    inner = f"            {quoted}"
    body = [inner] if len(inner) <= _WIDTH else _one_a_line(words)
    return [
        f"    {port.attr}: A[",
        f"        {_annotation(port)},",
        f"        {_CLASSES[port.kind]}(",
        *body,
        "        ),",
        "    ]",
    ]


def _one_a_line(words: Iterable[str]) -> list[str]:
    return [f"            {_quoted(word[: _WIDTH - 16])}," for word in words]


def _quoted(word: str) -> str:
    text = word.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{text}"'


def _doc(port: NewPort) -> str:
    kind = {"in": "input", "out": "output"}[port.kind.split("-")[0]]
    return f"{'constant ' if port.kind.is_const else ''}{kind} {port.name}"


_HANDLER = '''    def timing_failure(self, kind: TimingFailure) -> Recovery:
        """Abort a cycle that misses its deadline; `on` then starts again."""
        return Recovery.ABORT if kind is TimingFailure.DEADLINE else Recovery.CONTINUE
'''


def _module_text(
    name: str, ports: Sequence[NewPort], desc: str, *, handler: bool, apart: bool
) -> str:
    outvars = [port for port in ports if port.kind is Kind.OUTVAR]
    outconsts = [port for port in ports if port.kind is Kind.OUTCONST]
    lines = [
        f'"""{_sentence(desc, 4)}"""',
        "",
        *_imports(ports, handler=handler, apart=apart),
        "",
        "",
    ]
    lines += [f"class {class_name(name)}(PortBasedObject):"]
    lines += [f'    """{_sentence(desc, 8)}"""', ""]
    for kind in Kind:
        for port in ports:
            if port.kind is kind:
                lines += _declaration(port)
    if ports:
        lines.append("")
    if outconsts:
        lines += [
            "    def init(self) -> None:",
            '        """Set the constants that this module produces."""',
            *(line for port in outconsts for line in _first_value(port, ports)),
            "",
        ]
    lines += [
        "    def on(self) -> None:",
        '        """Start from what the ports hold, as the last writer left it."""',
        "",
        "    def cycle(self, dt: float) -> None:",
        '        """Compute the outputs, dt seconds after the last cycle.',
        "",
        *(f"        {line}" for line in _law_help(outvars)),
        '        """',
        "",
        *(_HANDLER.splitlines() if handler else ()),
    ]
    return "\n".join(lines).rstrip("\n") + "\n"


def _sentence(desc: str, indent: int) -> str:
    """Return `desc` as a docstring's first line, not longer than a line may be."""
    room = _WIDTH - indent - len('""".')
    text = desc.replace("\\", "/").replace('"', "'")
    return (text if len(text) <= room else text[: room - 3].rstrip() + "..") + "."


def _imports(ports: Sequence[NewPort], *, handler: bool, apart: bool) -> list[str]:
    types = {_annotation(port) for port in ports}
    arrays = sorted(kind for kind in types if kind.startswith("NDArray"))
    names = {"PortBasedObject", *(types & {"Vector", "Matrix"})}
    names |= {_CLASSES[port.kind] for port in ports}
    lines = ["from typing import Annotated as A", ""] if ports else []
    if arrays:
        lines += ["import numpy as np", "from numpy.typing import NDArray"]
        lines += [""] if apart else []
    names |= {"Recovery", "TimingFailure"} if handler else set()
    line = f"from pbonet import {', '.join(sorted(names))}"
    if len(line) <= _WIDTH:
        return [*lines, line]
    each = [f"    {name}," for name in sorted(names)]
    return [*lines, "from pbonet import (", *each, ")"]


def _first_value(port: NewPort, ports: Sequence[NewPort]) -> list[str]:
    """Return the line of `init` that sets one constant."""
    sizes = [p for p in ports if port.attr in parse_shape(p.shape)]
    if sizes:
        axis = parse_shape(sizes[0].shape).index(port.attr)
        return [f"        self.{port.attr} = self.{sizes[0].attr}.shape[{axis}]"]
    value = {"float": "0.0", "int": "0", "bool": "False"}.get(_scalar(port))
    if value:
        return [f"        self.{port.attr} = {value}"]
    if port.type.startswith("struct"):
        return [f'        self.{port.attr}[:] = b""']
    return [f"        self.{port.attr}[:] = 0"]


def _law_help(outvars: Sequence[NewPort]) -> list[str]:
    """Return the docstring of a `cycle` without a control law."""
    if not outvars:
        return ["Every input is a new value here; read-only."]
    port = outvars[0]
    write = f"self.{port.attr} = ..." if _scalar(port) else f"self.{port.attr}[:] = ..."
    return [f"Write `{write}`; an output keeps its value until then."]


def _rmod_text(name: str, ports: Sequence[NewPort], desc: str, freq: float) -> str:
    def named(kind: Kind) -> tuple[str, ...]:
        return tuple(port.name for port in ports if port.kind is kind)

    return write_rmod(
        Rmod(
            name=name,
            file=f"{name}.rmod",
            module=name,
            desc=desc,
            inconst=named(Kind.INCONST),
            outconst=named(Kind.OUTCONST),
            invar=named(Kind.INVAR),
            outvar=named(Kind.OUTVAR),
            tasktype=TaskType.PERIODIC,
            freq=freq,
        )
    )


_TEST = '''"""A module on a bench: inputs in, outputs out, in virtual time.

``test_NAME.py`` tests the module of ``NAME.rmod``: rename them together.
"""

{modules}from pathlib import Path

{numpy}from pbonet.config import read_rmod
from pbonet.config.library import Library
from pbonet.pbo import {words}
from pbonet.testing import Bench

FOLDER = Path(__file__).parents[1]
RMOD = FOLDER / Path(__file__).with_suffix(".rmod").name.removeprefix("test_")
MODULE = read_rmod(RMOD).module
{build}PORTS = Library([FOLDER]).load(MODULE).info.ports
{values}

def test_the_rmod_lists_the_ports_of_the_class() -> None:
    rmod = read_rmod(RMOD)
    listed = {{*rmod.inconst, *rmod.outconst, *rmod.invar, *rmod.outvar}}
    assert listed == {{port.name for port in PORTS}}


def test_it_lives_a_whole_life() -> None:
    bench = Bench.of(RMOD{given}, library=[FOLDER])
    assert bench.on() is State.ON
    assert bench.step(n=10) is State.ON
    assert bench.off() is State.OFF
    assert bench.kill() is State.NOT_CREATED
{bumpless}{late}'''

_BUILD = """\
MAKE = ["make", "--silent", "-C", str(FOLDER), f"PYTHON={{sys.executable}}"]
subprocess.run([*MAKE, f"{{MODULE}}.so"], check=True)  # the source as it is now
"""

_BUMPLESS = """

def test_it_starts_where_the_last_writer_stopped() -> None:
    bench = Bench.of(RMOD{given}, library=[FOLDER], {attr}={value})
    bench.on()
    assert {check}
"""


_LATE = """

def test_a_late_cycle_is_given_up() -> None:
    bench = Bench.of(RMOD{given}, library=[FOLDER])
    bench.on()
    assert bench.timing_failure(TimingFailure.DEADLINE) is Recovery.ABORT
    assert bench.timing_failure(TimingFailure.MAXEXEC) is Recovery.CONTINUE
    assert bench.step() is State.ON
"""


def _test_text(
    ports: Sequence[NewPort], *, handler: bool, apart: bool, in_c: bool
) -> str:
    values = _bench_values(ports)
    text = "".join(f"    {_quoted(word)}: {value},\n" for word, value in values.items())
    given = ", VALUES" if values else ""
    first = next((port for port in ports if _can_be_compared(port)), None)
    numpy = "import numpy as np\n" + ("\n" if apart else "")
    return _TEST.format(
        modules="import subprocess\nimport sys\n" if in_c else "",
        build=_BUILD.format() if in_c else "",
        numpy=numpy if "np." in text else "",
        values=f"VALUES = {{\n{text}}}\n" if values else "",
        given=given,
        bumpless=_bumpless(first, given) if first else "",
        words="Recovery, State, TimingFailure" if handler else "State",
        late=_LATE.format(given=given) if handler else "",
    )


def _bumpless(port: NewPort, given: str) -> str:
    value = _one(port)
    output = f"bench.outputs.{port.attr}"
    checks = {"": f"({output} == 1).all()", "bool": f"{output} is True"}
    check = checks.get(_scalar(port), f"{output} == 1")
    return _BUMPLESS.format(given=given, attr=port.attr, value=value, check=check)


def _can_be_compared(port: NewPort) -> bool:
    return port.kind is Kind.OUTVAR and not port.type.startswith("struct")


def _bench_values(ports: Sequence[NewPort]) -> Mapping[str, str]:
    """Return what a bench needs: sizes, in-consts, structures."""
    values: dict[str, str] = {}
    for port in ports:
        dims = parse_shape(port.shape)
        sizes = [_size(dim) for dim in dims]
        values |= {dim: _size(dim) for dim in dims if isinstance(dim, str)}
        element = element_type(port.type)
        if element and element.is_struct:
            values[port.attr] = f'np.zeros(({", ".join(sizes)},), "{element.dtype}")'
    for port in ports:
        if port.kind is Kind.INCONST and port.attr not in values:
            values[port.attr] = _one(port)
    return values


def _one(port: NewPort) -> str:
    return "True" if port.type == "bool" else "1"


def _size(dim: int | str) -> str:
    """Return the size that a bench gives to a dimension."""
    if isinstance(dim, str):
        return "1" if dim.startswith(_ALONE) else "6"
    return str(dim)
