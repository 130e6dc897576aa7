"""A tool at the end of an arm, and who uses its constants; for tests of constants.

tool --MASS--> weigh --WEIGHT--> hold --F-->
   \\------------LENGTH-----------/
"""

import textwrap

SVAR = """
NAME MASS
TYPE double
DESC mass of the tool
UNITS kg
NELEM 1

NAME LENGTH
TYPE double
DESC length of the tool
UNITS m
NELEM 1

NAME WEIGHT
TYPE double
DESC weight of the tool
UNITS N
NELEM 1

NAME BIAS
TYPE double
DESC set by hand
UNITS N*m
NELEM 1
INIT 0

NAME F
TYPE double
DESC torque that holds the tool
UNITS N*m
NELEM 1

NAME SIZE
TYPE int
DESC elements of P
UNITS none
NELEM 1

NAME P
TYPE double
DESC as many as SIZE
UNITS none
NELEM 2
EOF
"""
SBS = "SUBSYSTEM tools\nSVARFILE tools.svar\nRTPU arm0\nEOF\n"
TOOL = """
    from typing import Annotated as A
    from pbonet import OutConst, Params, PortBasedObject, param

    class Of(Params):
        mass: A[float, param("kg", "mass", ge=0)] = 1.0
        length: A[float, param("m", "length", ge=0)] = 1.0

    class Tool(PortBasedObject[Of]):
        '''What is at the end of the arm.'''

        mass: A[float, OutConst("MASS", "1", "kg", "mass")]
        length: A[float, OutConst("LENGTH", "1", "m", "length")]

        def init(self) -> None:
            self.reinit()

        def reinit(self) -> None:
            self.mass, self.length = self.params.mass, self.params.length

        def cycle(self, dt: float) -> None:
            pass
"""
WEIGH = """
    from typing import Annotated as A
    from pbonet import InConst, OutConst, Params, PortBasedObject, param

    class Scales(Params):
        heaviest: A[float, param("kg", "what is too heavy", ge=0)] = 100.0

    class Weigh(PortBasedObject[Scales]):
        '''Weight of a mass.'''

        mass: A[float, InConst("MASS", "1", "kg", "mass")]
        weight: A[float, OutConst("WEIGHT", "1", "N", "weight")]

        def init(self) -> None:
            self.reinit()

        def reinit(self) -> None:
            if self.mass > self.params.heaviest:
                self.task.fail("too heavy")
            self.weight = 10.0 * self.mass

        def cycle(self, dt: float) -> None:
            pass
"""
HOLD = """
    from typing import Annotated as A
    from pbonet import InConst, OutVar, Params, PortBasedObject

    class Hold(PortBasedObject[Params]):
        '''Torque against the weight.'''

        weight: A[float, InConst("WEIGHT", "1", "N", "weight")]
        length: A[float, InConst("LENGTH", "1", "m", "length")]
        bias: A[float, InConst("BIAS", "1", "N*m", "bias")]
        f: A[float, OutVar("F", "1", "N*m", "torque")]

        def init(self) -> None:
            self.times = 0
            self.reinit()

        def reinit(self) -> None:
            self.torque = self.weight * self.length + self.bias
            if self.task.state == "ON":
                self.times += 1
                self.task.warn(f"reinit {self.times}")

        def cycle(self, dt: float) -> None:
            self.f = self.torque
"""


def rmod(folder, name, module, *, local="", **ports):
    """Write an RMOD; `ports` are its lists."""
    lists = {
        key: ports.get(key, "none")
        for key in ("INCONST", "OUTCONST", "INVAR", "OUTVAR")
    }
    lines = [f"MODULE {module}", "DESC a test", *(f"{k} {v}" for k, v in lists.items())]
    lines += ["TASKTYPE periodic", "FREQ 200"]
    lines += ["LOCAL", local] if local else []
    (folder / f"{name}.rmod").write_text("\n".join([*lines, "EOF", ""]))


MODULES = {"tool": TOOL, "weigh": WEIGH, "hold": HOLD}


def write(folder, library):
    """Write modules, and a subsystem with a job for each tool: grip, drill, anvil.

    Args:
        folder: Of the subsystem; it is made.
        library: Of the modules.
    """
    for name, code in MODULES.items():
        (library / f"{name}.py").write_text(textwrap.dedent(code))
    folder.mkdir()
    (folder / "tools.svar").write_text(SVAR)
    (folder / "tools.sbs").write_text(SBS)
    for name, local in (("grip", "MASS 2\nLENGTH 0.5"), ("drill", "MASS 3\nLENGTH 1")):
        rmod(folder, name, "tool", OUTCONST="MASS LENGTH", local=local)
    rmod(folder, "anvil", "tool", OUTCONST="MASS LENGTH", local="MASS 500")
    rmod(folder, "weigh", "weigh", INCONST="MASS", OUTCONST="WEIGHT")
    rmod(folder, "hold", "hold", INCONST="WEIGHT LENGTH BIAS", OUTVAR="F")
    for name in ("grip", "drill", "anvil"):
        (folder / f"{name}.job").write_text(
            f"JOB {name}\nDESC hold a tool\nSBS tools.sbs\n"
            f"TASK hold\nTASK weigh\nTASK {name}\nEOF\n"
        )
