"""Writes the frame of a new module in C: its source and the Makefile of its folder."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.config import element_type
from pbonet.errors import ConfigError
from pbonet.ports import Kind, parse_shape

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .scaffold_port import NewPort

MAKEFILE = """\
# Builds each module in C of this folder: NAME.c becomes NAME.so.
CC ?= cc
CFLAGS ?= -O2 -g -Wall -Wextra
PYTHON ?= python3
PBONET := $(shell $(PYTHON) -c "import pbonet; print(pbonet.get_include())")
MODULES := $(patsubst %.c,%.so,$(wildcard *.c))

all: $(MODULES)

# The file is moved into place: a task that runs keeps the one that it has loaded.
# Results do not depend on the machine: nothing is computed by fused multiply-add.
OPTIONS := -std=gnu11 -ffp-contract=off -fPIC -shared -Wl,-z,defs
%.so: %.c
	$(CC) $(OPTIONS) $(CFLAGS) -I$(PBONET) -o $@.new $< $(LDLIBS) -lm
	mv $@.new $@

clean:
	rm -f $(MODULES)

.PHONY: all clean
"""
_KEYWORDS = frozenset({
    *("auto", "case", "char", "const", "default", "do", "double", "enum", "extern"),
    *("float", "goto", "inline", "int", "long", "register", "restrict", "short"),
    *("signed", "sizeof", "static", "struct", "switch", "typedef", "union"),
    *("unsigned", "void", "volatile"),
})
"""Keywords of C that Python does not have."""
_MACROS = {
    Kind.INCONST: "PBO_IN_CONST",
    Kind.OUTCONST: "PBO_OUT_CONST",
    Kind.INVAR: "PBO_IN_VAR",
    Kind.OUTVAR: "PBO_OUT_VAR",
}
_TYPES = {"f8": "double", "f4": "float", "b1": "bool"}
_EMPTY = """
static int {name}(void *state, pbo_task *task)
{{
    struct {module} *self = state;
{lines}
    (void)self;
    (void)task;
    return PBO_OK;
}}
"""
_HANDLER = """
/* Called when `cycle` has returned, or in place of one that cannot finish: the outputs
 * of a cycle that misses its deadline are discarded, and `on` then starts again. A long
 * cycle looks at task->must_end, and returns. */
static int timing_failure(void *state, pbo_task *task, int kind)
{
    (void)state;
    (void)task;
    return kind == PBO_DEADLINE ? PBO_ERROR : PBO_OK;
}
"""


def c_text(name: str, ports: Sequence[NewPort], desc: str, *, handler: bool) -> str:
    """Return the source of a new module.

    Raises:
        ConfigError: A port cannot be one of a module in C.
    """
    _check(ports)
    rows = [row for kind in Kind for row in _rows(name, ports, kind)]
    methods = [
        *(["init"] if _named(ports, Kind.OUTCONST) else []),
        *("on", "cycle"),
        *(["timing_failure"] if handler else []),
    ]
    parts = [
        f"/* {desc.replace('*/', '* /')}. */\n#include <pbonet.h>\n",
        f"\nstruct {name} {{\n",
        *(f"    {_type(port)}*{port.attr};\n" for port in ports),
        "    int64_t own;     /* parameters and further data follow here */\n};\n",
        *(["\nstatic const pbo_port ports[] = {\n", *rows, "};\n"] if ports else []),
        _init(name, ports) if "init" in methods else "",
        _EMPTY.format(
            name="on",
            module=name,
            lines="    /* Start from what the last writer left in the ports. */",
        ),
        _EMPTY.format(name="cycle", module=name, lines=_law_help(ports)),
        _HANDLER if handler else "",
        f'\nPBO_MODULE(struct {name}, "{_escaped(desc)}.",\n           ',
        "PBO_PORTS(ports), " if ports else "",
        ", ".join(f".{method} = {method}" for method in methods),
        ");\n",
    ]
    return "".join(parts)


def _check(ports: Sequence[NewPort]) -> None:
    sizes = {
        port.attr
        for port in ports
        if port.kind.is_const and not parse_shape(port.shape) and "f" not in _kind(port)
    }
    for port in ports:
        if port.attr in _KEYWORDS:
            raise ConfigError(
                f"the field of port {port.name} would be a keyword of C",
                where=port.name,
                got=port.attr,
                remedy="write the module with another port, and rename it there",
            )
        if port.type.startswith("struct"):
            raise ConfigError(
                f"port {port.name} is a structure",
                where=port.name,
                expected="numbers: a module in C has no ports of other types",
                got=port.type,
                remedy="write the module in Python",
            )
        for dim in parse_shape(port.shape):
            if isinstance(dim, str) and dim not in sizes:
                raise ConfigError(
                    f"the size {dim} of port {port.name} is no constant",
                    where=port.name,
                    expected="a number, or an integer constant of the same module",
                    got=port.shape,
                    remedy=f"add --inconst {dim.upper()}:1:none:int, from which the "
                    "module learns it",
                )


def _kind(port: NewPort) -> str:
    """Return the numpy type of a port's elements, without its byte order."""
    element = element_type(port.type)
    return element.dtype.lstrip("<") if element else "f8"


def _type(port: NewPort) -> str:
    kind = _kind(port)
    whole = "int" if kind[0] == "i" else "uint"
    name = _TYPES.get(kind) or f"{whole}{8 * int(kind[1:])}_t"
    return f"const {name} " if port.kind.is_input else f"{name} "


def _named(ports: Sequence[NewPort], kind: Kind) -> list[NewPort]:
    return [port for port in ports if port.kind is kind]


def _rows(name: str, ports: Sequence[NewPort], kind: Kind) -> list[str]:
    """Return the rows of the port table for ports of one kind."""
    found: list[str] = []
    for port in _named(ports, kind):
        doc = port.doc or f"{port.kind} {port.name}"
        words = ", ".join(
            f'"{_escaped(word)}"' for word in (port.name, port.shape, port.unit, doc)
        )
        found.append(f"    {_MACROS[kind]}(struct {name}, {port.attr}, {words}),\n")
    return found


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"')


def _init(name: str, ports: Sequence[NewPort]) -> str:
    """Return `init`, which sets the constants that the module produces."""
    sizes = {dim for port in ports for dim in parse_shape(port.shape)}
    lines = [
        f"    *self->{port.attr} = {6 if port.attr in sizes else 0};"
        for port in _named(ports, Kind.OUTCONST)
        if not parse_shape(port.shape)
    ]
    return _EMPTY.format(name="init", module=name, lines="\n".join(lines))


def _law_help(ports: Sequence[NewPort]) -> str:
    """Return the comment of a `cycle` without a control law."""
    outputs = _named(ports, Kind.OUTVAR)
    if not outputs:
        return "    /* Every input is a new value here. */"
    return (
        f"    /* Write self->{outputs[0].attr}[0] and so on; an output keeps its value "
        "until\n     * then. task->dt is the time since the last cycle, in seconds. */"
    )
