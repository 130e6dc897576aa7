"""Use a table whose file is overwritten, many times, each in a process of its own.

    python overwritten_table.py random|zero WHAT COUNT

Prints how many survived, or ends with 1 and says which did not, or saw a value that
nobody committed.
"""

import os
import struct
import sys
import traceback

import numpy as np

from pbonet.config.model import Variable
from pbonet.errors import PbonetError, SvarError
from pbonet.svar import Flags, Table, now_ns

ME = os.getpid
NAMES = ("V0", "V1", "V2", "V3", "V4")
BAD = Flags.TABLE_OVERWRITTEN | Flags.COPY_LOST


class Victim:
    """A table with two writers, an operator and readers that have read before."""

    def __init__(self, name: str) -> None:
        self.table = Table.create(
            name,
            [
                Variable(
                    name=n, type="double", nelem=5, maxage=60 if n == "V1" else None
                )
                for n in NAMES
            ],
        )
        self.last = dict.fromkeys(NAMES, 0.0)
        self.writers = [
            self.table.local("a", ME(), outvar=["V0", "V1"], outconst=["V3"]),
            self.table.local("b", ME(), outvar=["V2"], invar=["V0"]),
        ]
        self.readers = [
            self.table.local("r", ME(), invar=NAMES),
            self.table.local("k", ME(), invar=NAMES, keep=True),
        ]
        for writer in self.writers:
            self.fill(writer, 1.0)
            assert writer.copy_out_consts() == writer.claim() == 0
        self.last |= {"V0": 1.0, "V1": 1.0, "V2": 1.0, "V3": 1.0}
        self.table.write("V4", [2.0] * 5)
        self.last["V4"] = 2.0
        for reader in self.readers:
            assert reader.copy_in() == 0
            self.check(reader)

    def fill(self, writer, value: float) -> None:
        for name in writer.names():
            writer.array(name)[:] = value

    def check(self, reader) -> None:
        """Raise unless each value is the newest that was committed."""
        for name in NAMES:
            self.must_be(name, reader.array(name))

    def must_be(self, name: str, found) -> None:
        if found.tolist() != [self.last[name]] * 5:
            raise ValueError(f"{name} is {found}, not {self.last[name]}")

    def commit(self, value: float) -> None:
        for writer, names in zip(self.writers, (("V0", "V1"), ("V2",)), strict=True):
            for name in names:
                writer.array(name)[:] = value
            if writer.commit(now_ns(), 1) == 0:
                self.last |= dict.fromkeys(names, value)

    def read(self, *, strict: bool) -> None:
        for reader in self.readers:
            flags = reader.copy_in()
            reader.read("V2")
            if flags == 0 and strict:
                self.check(reader)
        fresh = dict.fromkeys(NAMES)
        for name in fresh:
            try:
                value = self.table.read(name)
            except SvarError:
                continue
            if strict:
                self.must_be(name, value)

    def change(self) -> None:
        """Call everything that changes ownership, the flag or values."""
        table, (a, b) = self.table, self.writers
        for use in (
            table.registers,
            lambda: table.written("V0"),
            lambda: table.info("V4"),
            lambda: table.raise_illegal("cause", "me"),
            lambda: table.illegal,
            lambda: table.clear_illegal("me"),
            lambda: a.write("V0"),
            b.claim,
            a.copy_out_consts,
            lambda: table.write("V4", [3.0] * 5),
            lambda: table.local("new", ME(), invar=NAMES, outvar=["V4"]).claim(),
            b.cede,
            b.have_ended,
            a.release,
            lambda: table.reap("a"),
            table.must_be_whole,
            a.close,
            b.close,
            lambda: Table.attach(table.name),
        ):
            try:
                use()
            except PbonetError:
                continue


def hit(path, what: str, kind: str, rng) -> None:
    """Overwrite a part of the file."""
    raw = path.read_bytes()
    live, regs, directory, _, arena = struct.unpack_from("<5Q", raw, 80)
    first, last = {
        "header": (0, 2949),
        "live": (live, regs),
        "registers": (regs, directory),
        "directory": (directory, arena),
        "prefix": (0, int(rng.integers(live // 64 + 2, len(raw) // 64)) * 64),
        "whole": (0, len(raw)),
        "anywhere": tuple(sorted(rng.integers(0, len(raw) + 1, 2).tolist())),
    }[what]
    with path.open("r+b") as file:
        file.seek(first)
        file.write(rng.bytes(last - first) if kind == "random" else bytes(last - first))


def suffer(seed: int, what: str, kind: str) -> None:
    victim = Victim(f"t{seed}")
    hit(victim.table.path, what, kind, np.random.default_rng(seed))
    for value in (3.0, 4.0):
        victim.commit(value)
        victim.read(strict=what != "anywhere")
    victim.change()
    victim.read(strict=False)
    victim.table.path.unlink(missing_ok=True)


def main() -> int:
    kind, what, count = sys.argv[1], sys.argv[2], int(sys.argv[3])
    for seed in range(count):
        pid = os.fork()
        if not pid:
            code = 1
            try:
                suffer(seed, what, kind)
                code = 0
            except BaseException:  # noqa: BLE001 - the parent must see it as such
                traceback.print_exc()
            os._exit(code)
        status = os.waitpid(pid, 0)[1]
        if status:
            print(f"seed {seed}: wait status {status}", file=sys.stderr)
            return 1
    print(f"{count} survived")
    return 0


if __name__ == "__main__":
    sys.exit(main())
