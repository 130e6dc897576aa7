"""What a module's class may look like, and what is known about it."""

import pathlib
from typing import Annotated as A, Generic, TypeVar

import msgspec
import pytest

from pbonet import (
    Answer,
    InConst,
    InVar,
    OutVar,
    Params,
    PortBasedObject,
    TimingFailure,
    Vector,
    param,
)
from pbonet.errors import DeclarationError
from pbonet.pbo import (
    METHODS,
    ModuleInfo,
    TaskContext as Context,
    bind,
    describe,
    interface,
    params_type,
    render,
    source_version,
)
from pbonet.ports import Kind


class Gains(Params):
    kp: A[float, param("N*m/rad", "stiffness", ge=0)]
    limit: A[tuple[float, ...], param("N*m", "largest torque", gt=0)] = (5.0, 2.5)
    quiet: A[bool, param("none", "no warnings")] = False


class Law(PortBasedObject[Gains]):
    """Hold q where it is.

    More about it.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "degrees of freedom")]
    q: A[Vector, InVar("Q_MEZ", "ndof", "rad", "position")]
    tau: A[Vector, OutVar("T_REF", "ndof", "N*m", "torque")]

    def on(self):
        pass

    def cycle(self, dt):
        pass

    def stable(self, dt):
        pass


def test_the_parameters_are_those_in_brackets():
    assert params_type(Law) is Gains

    class Finer(Law):
        pass

    assert params_type(Finer) is Gains


def test_the_parameters_may_come_through_a_generic_base():
    P = TypeVar("P", bound=Params)

    class Half(PortBasedObject[P], Generic[P], abstract=True):
        pass

    class Whole(Half[Gains]):
        def cycle(self, dt):
            pass

    assert params_type(Half) is Params
    assert params_type(Whole) is Gains


def test_methods_that_a_module_writes_are_known():
    assert interface(Law).methods == ("on", "cycle", "stable")
    assert len(METHODS) == 13


def test_default_methods_do_what_their_docstrings_say():
    class Bare(PortBasedObject[Gains]):
        def cycle(self, dt):
            pass

    bare = bind(Bare, Gains(kp=2.0), {}, Context())
    assert bare.on() is None
    assert bare.error(ValueError()) is Answer.ERROR
    assert bare.clear() is Answer.OFF
    assert bare.get("kp") == 2.0
    assert bare.timing_failure(TimingFailure.DEADLINE) is None
    with pytest.raises(NotImplementedError):
        bare.stable(0.1)


def refuse(body, bases=(PortBasedObject,), **settings):
    with pytest.raises(DeclarationError) as caught:
        type("Made", bases, {"__module__": "somewhere", **body}, **settings)
    return str(caught.value)


def cycle(self, dt):
    pass


def alone(self):
    pass


def test_cycle_must_be_there():
    assert refuse({}) == (
        "somewhere.Made (source unknown): the module has no method cycle (expected "
        "def cycle(self, dt: float) -> None); or say `abstract=True` after the base "
        "class"
    )
    assert refuse({"cylce": cycle}).endswith("did you mean cylce?")


def test_methods_must_be_callable_as_the_runtime_calls_them():
    assert refuse({"cycle": alone}) == (
        "somewhere.Made.cycle (source unknown): the runtime cannot call this method "
        "(expected def cycle(self, dt), got def cycle(self))"
    )

    async def waiting(self, dt):
        pass

    assert "got a function that pauses" in refuse({"cycle": waiting})
    assert "got staticmethod" in refuse({"cycle": staticmethod(cycle)})
    assert "expected def error(self, error)" in refuse({"error": alone})


def test_more_arguments_with_defaults_do_no_harm():
    class Fine(PortBasedObject):
        def cycle(self, dt, *, gain=1.0):
            pass

    assert interface(Fine).methods == ("cycle",)


def test_a_constructor_is_refused():
    assert refuse({"cycle": cycle, "__init__": cycle}) == (
        "somewhere.Made.__init__ (source unknown): a module has no __init__: its ports "
        "do not exist yet when it runs; write `def init(self) -> None:` instead"
    )


def test_a_class_is_not_called():
    for make in (Law, PortBasedObject, lambda: Law(3, gains=1)):
        with pytest.raises(DeclarationError, match="is not made by calling its class"):
            make()
    with pytest.raises(DeclarationError) as caught:
        Law()
    assert str(caught.value) == (
        "Law: a module is not made by calling its class; put it on a bench: "
        "`Bench(Law, ...)`, of pbonet.testing"
    )


def test_parameters_stand_in_brackets():
    with pytest.raises(DeclarationError) as caught:

        class Wrong(PortBasedObject):
            params: Gains

            def cycle(self, dt):
                pass

    assert str(caught.value).endswith(
        "the class of the parameters follows the base class in brackets "
        "(expected class Wrong(PortBasedObject[Gains]), got params: Gains)"
    )


def test_parameters_must_be_params():
    with pytest.raises(DeclarationError) as caught:

        class Wrong(PortBasedObject[int]):
            def cycle(self, dt):
                pass

    assert caught.value.what == "a module's parameters are a class derived from Params"
    assert caught.value.got == "PortBasedObject[int]"


def test_a_class_without_a_docstring_has_that_of_the_module_it_derives_from():
    class Bare(PortBasedObject):
        def cycle(self, dt):
            pass

    class Told(Bare):
        """Do it.

        At length.
        """

    class Again(Told):
        pass

    docs = [describe(one).doc for one in (Bare, Told, Again)]
    assert docs == ["", "Do it.", "Do it."]


def test_a_module_is_described_as_data():
    info = describe(Law, version="abc", file="law.py")
    assert info.name == "test_pbo_object"
    assert info.doc == "Hold q where it is."
    assert info.named(Kind.OUTVAR) == ("T_REF",)
    assert info.critical_ok
    assert [(p.name, p.required, p.default) for p in info.params] == [
        ("kp", True, ""),
        ("limit", False, "5.0 2.5"),
        ("quiet", False, "no"),
    ]
    packed = msgspec.msgpack.encode(info)
    assert msgspec.msgpack.decode(packed, type=ModuleInfo) == info


def test_the_version_is_a_hash_of_the_file():
    with pathlib.Path(__file__).open("rb") as file:
        assert describe(Law).version == source_version(file.read())


def test_a_module_made_without_a_file_is_described_all_the_same():
    made = type("Made", (PortBasedObject,), {"cycle": cycle, "__module__": "nowhere"})
    info = describe(made)
    assert (info.file, info.version, info.doc) == ("", "", describe(made).doc)


def test_the_description_as_text():
    assert render(describe(Law, name="law", version="abc", file="law.py")) == (
        """law: Hold q where it is.
class     none

ports
  in-const  NDOF   ndof  int            none  degrees of freedom
  in-var    Q_MEZ  q     float64[ndof]  rad   position
  out-var   T_REF  tau   float64[ndof]  N*m   torque

parameters
  kp     float              N*m/rad  >= 0  required         stiffness
  limit  one or more float  N*m      > 0   default 5.0 2.5  largest torque
  quiet  bool               none           default no       no warnings

methods   on cycle stable
CRITICAL  possible
code      Law in law.py
version   abc
"""
    )


def test_the_description_of_a_module_with_nothing():
    class Bare(PortBasedObject):
        def cycle(self, dt):
            pass

    text = render(describe(Bare, name="bare", version="", file=""))
    assert "ports\n  none\n\nparameters\n  none\n" in text
    assert "CRITICAL  no: has no stable()" in text
