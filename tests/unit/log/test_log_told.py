"""What a task was told of itself, and what it began from that is nowhere recorded."""

from __future__ import annotations

import pytest
from adding_module import ADDS
from log_of_python_tasks import RMOD, Shop, drive

from pbonet.testing import rerun, verify

ASKS = ADDS.replace(
    "+ self.task.now * 1e-12",
    "+ self.task.crit / 7 + self.task.sigmask / 3",
)
WARNS = ASKS.replace(
    "        self.age += dt", '        self.task.warn("again")\n        self.age += dt'
)
ON = ADDS.replace(
    "    def on(",
    "    def on(self) -> None:\n        self.y[0] = self.task.crit\n\n    def on_(",
)
TWO = ADDS.replace(
    '"none", "sum")]\n',
    '"none", "sum")]\n    w: A[float, OutVar("W", "1", "none", "what it was")]\n',
).replace("    def cycle(", "        self.began = self.y[0]\n\n    def cycle(")
TWO = TWO.replace(
    "        self.age += dt", "        self.w = self.began\n        self.age += dt"
)
TEXT = RMOD.replace("OUTVAR Y\n", "OUTVAR Y W\n").replace(
    "SVARALIAS Y={y}\n", "SVARALIAS Y={y}\nSVARALIAS W={y}W\n"
)


@pytest.fixture
def shop(tmp_path):
    """Return what makes a shop, which is closed at the end."""
    shops = []

    def make(code, text=RMOD):
        shops.append(Shop(tmp_path, code, text))
        return shops[-1]

    yield make
    for one in shops:
        one.close()


def test_criticality_and_mask_are_told_again_as_they_changed(shop) -> None:
    made = shop(ASKS)
    for crit, mask in ((5, 0), (7, 0), (7, 4), (0, 6), (5, 0)):
        made.a.source.true, made.a.context.true = crit, mask
        made.cycles(3)
    drive(made)
    path = made.log()
    a, b = verify(path)
    assert (a.cycles, b.cycles) == (35, 36)
    assert a.good, str(a)
    assert b.good, str(b)
    assert rerun(path).good
    made.code.write_text(ASKS.replace("sigmask / 3", "sigmask / 5"))
    (a,) = verify(path, ["a"])
    assert a.cycles == 6, "the mask was 0 until then"
    assert a.divergence is not None


def test_a_warning_asks_nothing_of_the_record(shop) -> None:
    made = shop(WARNS)
    for crit, mask in ((5, 0), (7, 0), (7, 4), (0, 6)):
        made.a.source.true, made.a.context.true = crit, mask
        made.cycles(3)
    assert all(one.good for one in verify(made.log()))


def test_methods_are_told_again_too(shop) -> None:
    made = shop(ON)
    made.cycles(2)
    made.a.signal("off")
    made.a.source.true = 9
    made.a.signal("on")
    made.cycles(2)
    assert all(one.good for one in verify(made.log()))


def test_an_output_that_on_began_from_and_that_is_not_recorded(shop) -> None:
    """Y0 is hidden and Y0W follows from it: that it differs proves nothing."""
    made = shop(TWO, TEXT)
    drive(made)
    assert all(one.good for one in verify(made.log()))
    (made.folder / "run.mcap").unlink()
    path = made.log(hidden=["Y0"])
    (a,) = verify(path, ["a"])
    assert a.divergence is None, str(a)
    assert a.cycles == 15, "until it was turned on again"
    assert a.gaps == [
        "cycle 16: Y0W differs, but Y0, which `on` copies in, is not recorded"
    ]
    assert rerun(path).good, "it is made anew"


def test_what_does_not_follow_from_it_is_verified_to_the_end(shop) -> None:
    made = shop(TWO.replace("self.w = self.began", "self.w = self.age"), TEXT)
    drive(made)
    (a,) = verify(made.log(hidden=["Y0"]), ["a"])
    assert a.good, str(a)
