"""Join connectors between real tasks, put in by alias (Stewart 1994, Figure 3.6).

    a --X1--\
             join --X--> (read by whoever wants)
    b --X2--/
"""

from __future__ import annotations

import pytest
from watching import wait_for

from pbonet.errors import ParameterError, VerificationError
from pbonet.master.subsystem.subsystem import Subsystem

VARIABLE = "NAME {}\nTYPE double\nDESC a value\nUNITS rad\nNELEM 2\n{}\n"
NDOF = "NAME NDOF\nTYPE int\nDESC size\nUNITS none\nNELEM 1\nINIT 2\n\n"
RMOD = (
    "MODULE {}\nDESC a test\n{}INCONST NDOF\nOUTCONST none\nINVAR {}\nOUTVAR {}\n"
    "TASKTYPE periodic\nFREQ 100\n{}EOF\n"
)


def constant(folder, name, variable, value):
    text = RMOD.format(
        "constant",
        f"SVARALIAS Y={variable}\n",
        "none",
        "Y",
        f"LOCAL\nVALUE {value}\n",
    )
    (folder / f"{name}.rmod").write_text(text)


def join(folder, module, local=""):
    aliases = "".join(f"SVARALIAS Z{n}=X{n}\n" for n in ("1", "2", ""))
    text = RMOD.format(module, aliases, "Z1 Z2", "Z", local and f"LOCAL\n{local}\n")
    (folder / "join.rmod").write_text(text)


@pytest.fixture
def files(tmp_path):
    folder = tmp_path / "two"
    folder.mkdir()
    variables = [("X", ""), ("X1", "MAXAGE 0.2"), ("X2", "")]
    text = NDOF + "\n".join(VARIABLE.format(*one) for one in variables)
    (folder / "two.svar").write_text(text + "\nEOF\n")
    (folder / "two.sbs").write_text(
        "SUBSYSTEM two\nSVARFILE two.svar\nRTPU arm0\nEOF\n"
    )
    (folder / "two.job").write_text(
        "JOB two\nDESC two writers\nSBS two.sbs\nTASK join\nTASK a\nTASK b\nEOF\n"
    )
    constant(folder, "a", "X1", "1 -2")
    constant(folder, "b", "X2", "5 -6")
    return folder


@pytest.fixture
def arm(nodes, files):
    nodes.agent_process("arm0")
    with Subsystem(files / "two.sbs", domain=nodes.domain) as subsystem:
        subsystem.warned = lambda _text: None
        yield subsystem


def wait_value(arm, *wanted):
    def there():
        shown = arm.display(["X"])[0]
        return shown.writer == "join" and shown.values == pytest.approx(wanted)

    wait_for(there, f"X = {wanted}")


@pytest.mark.parametrize(
    ("module", "local", "wanted"),
    [
        ("join_average", "WEIGHTS 0.75 0.25", (2.0, -3.0)),
        ("join_min", "", (1.0, -6.0)),
        ("join_max", "", (5.0, -2.0)),
        ("join_first", "", (1.0, -2.0)),
    ],
)
def test_two_writers_become_one(arm, files, module, local, wanted):
    join(files, module, local)
    arm.start("two")
    wait_value(arm, *wanted)
    assert {status.state for status in arm.status_all()} == {"ON"}


def test_what_the_refusal_of_two_writers_says_is_legal_and_runs(arm, files):
    constant(files, "a", "X", "1 -2")
    constant(files, "b", "X", "5 -6")
    job = files / "two.job"
    job.write_text(job.read_text().replace("TASK join\n", ""))
    with pytest.raises(VerificationError) as caught:
        arm.start("two")
    text = str(caught.value)
    assert "SVARALIAS Y=X' in a.rmod, SVARALIAS Y=X'' in b.rmod" in text
    assert (
        "a join connector (join_average or join_first or join_max or join_min)" in text
    )
    assert "SVARALIAS Z1=X', SVARALIAS Z2=X'', SVARALIAS Z=X" in text
    assert arm.model.names == []


def test_weights_that_do_not_sum_to_one_start_nothing(arm, files):
    join(files, "join_average", "WEIGHTS 0.75 0.2")
    with pytest.raises(ParameterError) as caught:
        arm.start("two")
    assert "join.rmod:13:1: the values of parameter weights do not sum to 1" in str(
        caught.value
    )
    assert arm.status_all() == []


def test_first_valid_falls_back_by_age_and_comes_back(arm, files):
    """The better writer is turned off; its value stands, and grows old."""
    join(files, "join_first")
    arm.start("two")
    wait_value(arm, 1.0, -2.0)
    arm.control("a", "off")
    wait_value(arm, 5.0, -6.0)
    assert arm.display(["X1"])[0].values == [1.0, -2.0]

    def told():
        texts = [event.text for event in arm.events() if event.task == "join"]
        return any("Z2 is taken, not Z1" in text for text in texts)

    wait_for(told, "a word about it")
    arm.control("a", "on")
    wait_value(arm, 1.0, -2.0)
    assert arm.status("join").state == "ON"


def test_first_valid_fails_when_both_are_old(arm, files):
    text = (files / "two.svar").read_text()
    # So long that a machine which stalls for seconds does not make both old before.
    head, _, _ = text.replace("MAXAGE 0.2", "MAXAGE 4").rpartition("EOF")
    (files / "two.svar").write_text(f"{head}MAXAGE 4\nEOF\n")
    arm.finish()
    with Subsystem(files / "two.sbs", domain=arm.domain) as anew:
        anew.warned = lambda _text: None
        join(files, "join_first")
        anew.start("two")
        wait_value(anew, 1.0, -2.0)
        anew.reconfig([("a", "off"), ("b", "off")])
        wait_for(lambda: anew.status("join").state == "ERROR", "the join to fail")

        def told():
            texts = [event.text for event in anew.events() if event.task == "join"]
            return any("neither Z1 nor Z2 is finite" in text for text in texts)

        wait_for(told, "a word about it")
    arm.open()
