"""Measured times become lines of an RMOD, and nothing else in the file changes."""

from __future__ import annotations

import codecs
import json
import shutil
from pathlib import Path

import pytest

from pbonet.analysis.schedule.histogram import bin_of
from pbonet.cli import main
from pbonet.config import parse_rmod, read_rmod
from pbonet.config.library import Library
from pbonet.errors import ConfigError, ConfigFileError, UnknownTaskError
from pbonet.master.configuration import adopt_times as adopt, saved_profiles

PUMA = Path(__file__).parents[3] / "examples" / "puma"
TEXT = """# the joint velocities
MODULE    diff   # by a filter
DESC      measured joint velocity
SVARALIAS Z=Q_MEZ
SVARALIAS Z^=Q^_MEZ
INCONST   NDOF
OUTCONST  none
INVAR     Z
OUTVAR    Z^
TASKTYPE  periodic
FREQ      100
{more}
LOCAL
# seconds
{local}EOF
"""


@pytest.fixture
def folder(tmp_path):
    """A folder with the PUMA's table and an RMOD of its own."""
    for name in ("puma.sbs", "puma.svar", "puma.job"):
        shutil.copy(PUMA / name, tmp_path / name)
    write(tmp_path)
    return tmp_path


def write(folder, more="", local="", *, name="vel"):
    path = folder / f"{name}.rmod"
    path.write_bytes(TEXT.format(more=more, local=local).encode())
    return path


def save(folder, name="vel", *, hz=100.0, most=801e-6, host=None, least=51.2e-6):
    """Save a profile: most cycles take 60 us, five of a hundred the longest time."""
    from pbonet.master.configuration.subsystem_files import Files

    files = Files(folder / "puma.sbs", Library())
    rmod = files.rmod(name, hz).record
    host = host or saved_profiles.here()
    saved = saved_profiles.Saved(
        rmod=name,
        module=rmod.module,
        version=files.library.load(rmod.module).info.version,
        setup=saved_profiles.setup_of(rmod, files.table),
        host=host,
        rtpu="arm0",
        when="now",
        hz=hz,
        cycles=200,
        least=least,
        most=most,
        mean=100e-6,
        bins=((bin_of(60_000), 190), (bin_of(round(most * 1e9)), 10)),
    )
    path = folder / "profiles" / host / f"{name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    import msgspec

    path.write_bytes(msgspec.json.encode(saved))
    return saved


def run(folder, *names, **more):
    return adopt.adopt(folder / "puma.sbs", names, **more)


def test_new_lines_stand_below_the_frequency_and_all_else_stays(folder):
    save(folder)
    before = (folder / "vel.rmod").read_text()
    ((one,), warnings) = run(folder)
    after = (folder / "vel.rmod").read_text()
    assert warnings == []
    added = ["MINC      4.26e-05", "MAXC      0.000962"]
    assert [x for x in after.splitlines() if x not in before.splitlines()] == added
    assert [x for x in after.splitlines() if x not in added] == before.splitlines()
    assert after.index("FREQ") < after.index("MINC") < after.index("LOCAL")
    record = read_rmod(folder / "vel.rmod")
    assert (record.minc, record.maxc) == (4.26e-05, 0.000962)
    assert (one.times, one.cycles) == ({"MINC": 4.26e-05, "MAXC": 0.000962}, 200)
    assert "+MAXC      0.000962\n" in one.diff
    again, _ = run(folder)
    assert again[0].diff == ""


def test_lines_that_stand_keep_their_place_and_their_comment(folder):
    more = "MAXC   0.005 # as guessed\r\nCRIT 7\r\nMINC\t1e-5\r\n"
    path = write(folder, more.replace("\r\n", "\n"))
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    path.write_bytes(codecs.BOM_UTF8 + path.read_bytes())
    save(folder)
    before = path.read_bytes()
    run(folder, "vel")
    expected = before.replace(b"0.005 #", b"0.000962 #").replace(b"1e-5", b"4.26e-05")
    assert path.read_bytes() == expected


def test_a_soft_task_gets_its_effective_time_too(folder):
    write(folder, "MAXC 0.0009\nSOFTNESS 0.1")
    saved = save(folder)
    ((one,), _) = run(folder)
    record = read_rmod(folder / "vel.rmod")
    effective = saved.profile.effective_ns(0.1) * 1e-9
    assert record.effc == pytest.approx(effective, rel=0.01)
    assert effective <= record.effc < record.maxc
    assert list(one.times) == ["MINC", "MAXC", "EFFC"]


def test_a_dry_run_writes_nothing(folder):
    save(folder)
    before = (folder / "vel.rmod").read_bytes()
    ((one,), _) = run(folder, dry_run=True)
    assert "+MAXC" in one.diff
    assert (folder / "vel.rmod").read_bytes() == before


def test_an_rmod_of_the_library_is_copied_beside_the_sbs(folder):
    save(folder, "qrdiff")
    library = Path(Library().find_rmod("qrdiff"))
    before = library.read_bytes()
    ((one,), _) = run(folder, "qrdiff")
    assert Path(one.file) == folder / "qrdiff.rmod"
    assert read_rmod(folder / "qrdiff.rmod").maxc == 0.000962
    assert library.read_bytes() == before


def test_the_margin_ends_at_the_period(folder):
    save(folder, most=9e-3)
    run(folder)
    assert read_rmod(folder / "vel.rmod").maxc == 0.01
    save(folder, most=9e-3)
    run(folder, margin=0.0)
    assert read_rmod(folder / "vel.rmod").maxc == 0.009


def test_what_took_longer_than_the_period_is_not_adopted(folder):
    save(folder, most=0.0123)
    found, warnings = run(folder)
    assert found == []
    assert warnings == [
        f"{folder / 'vel.rmod'}: not adopted: a cycle of vel took 0.0123 s, and its "
        "period is 0.01 s; lower its frequency, or declare SOFTNESS (MAXC would be "
        "0.0148)"
    ]


def test_a_changed_rmod_is_told_and_skipped(folder):
    save(folder)
    write(folder, local="filter 3\n")
    found, (warning,) = run(folder)
    assert found == []
    assert "measure again" in warning


def test_what_was_not_measured_is_refused(folder):
    with pytest.raises(UnknownTaskError, match="no profile of any RMOD was saved on"):
        run(folder)
    save(folder, host="robot")
    with pytest.raises(UnknownTaskError) as caught:
        run(folder)
    assert "saved: robot: vel" in str(caught.value)
    assert "--host" in str(caught.value)
    save(folder)
    with pytest.raises(ConfigFileError, match="no RMOD vell"):
        run(folder, "vell")
    with pytest.raises(UnknownTaskError, match="no profile of qrdiff was saved on"):
        run(folder, "qrdiff")
    assert run(folder, host="robot")[0][0].host == "robot"


def test_a_value_that_is_not_on_its_line_is_left_alone():
    text = TEXT.format(more="", local="")
    record = parse_rmod(text, "vel.rmod")
    other = parse_rmod(text.replace("100", "200"), "vel.rmod")
    with pytest.raises(ConfigError, match="cannot be changed"):
        adopt._must_mean(other, adopt.with_lines(text, record, {"MAXC": 1e-3}), {})


def test_the_verb_shows_the_change(folder, capsys):
    save(folder)
    with pytest.raises(SystemExit) as caught:
        main(["adopt", str(folder / "puma.sbs"), "vel", "--dry-run"])
    assert not caught.value.code
    out = capsys.readouterr().out
    assert "+MAXC      0.000962\n" in out
    assert out.splitlines()[-1] == (
        f"{folder / 'vel.rmod'}: MINC 42.6 us, MAXC 962 us from 200 cycles: not written"
    )
    with pytest.raises(SystemExit):
        main(["adopt", str(folder / "puma.sbs"), "--json"])
    data = json.loads(capsys.readouterr().out)
    assert data["adopted"][0]["times"]["MAXC"] == 0.000962
    with pytest.raises(SystemExit):
        main(["adopt", str(folder / "puma.sbs"), "--host", "mars"])
    assert "was saved on mars" in capsys.readouterr().err


def test_what_an_event_takes_is_no_reserve_of_a_server(folder):
    path = write(folder, more="CAPACITY 0.001")
    text = path.read_text().replace("periodic", "sporadic")
    path.write_text(text)
    write(folder, name="other")
    save(folder)
    save(folder, "other")
    found, warnings = adopt.adopt(folder / "puma.sbs")
    assert ([one.rmod for one in found], warnings) == (["other"], [])
    found, warnings = adopt.adopt(folder / "puma.sbs", ["vel"])
    assert found == []
    assert warnings == [
        f"{path}: not adopted: the reserve of the server vel is its CAPACITY, "
        "whatever one event takes"
    ]
    assert path.read_text() == text


# -- and the analysis uses them -------------------------------------------------------


def test_check_says_where_each_time_comes_from(folder, capsys):
    job = folder / "puma.job"
    job.write_text(job.read_text().replace("qrdiff", "qrdiff"))
    save(folder, "qrdiff", hz=100.0)
    with pytest.raises(SystemExit) as caught:
        main(["check", str(job)])
    assert not caught.value.code
    out = capsys.readouterr().out
    assert "(MUF): schedulable if unknown MAXC is 0, utilization at least 8.0%" in out
    assert "  qrdiff     100  0.0512 measured  0.801 measured  -     8.0" in out
    run(folder, "qrdiff")
    with pytest.raises(SystemExit):
        main(["check", str(job), "--json"])
    (data,) = json.loads(capsys.readouterr().out)
    tasks = {task["task"]: task for task in data["rtpus"][1]["tasks"]}
    assert tasks["qrdiff"]["maxc"] == {"seconds": 0.000962, "source": "rmod"}
    assert tasks["grav_comp"]["maxc"] == {"seconds": None, "source": "assumed"}


def test_profiles_of_another_machine_count_when_it_is_named(folder, capsys):
    save(folder, "qrdiff", host="robot")
    with pytest.raises(SystemExit):
        main(["check", str(folder / "puma.job")])
    out = capsys.readouterr().out
    assert "WARNING> qrdiff was measured on robot and not on" in out
    assert "0.801" not in out
    with pytest.raises(SystemExit):
        main(["check", str(folder / "puma.job"), "--host", "robot"])
    assert "0.801 measured" in capsys.readouterr().out


def test_an_overload_that_was_only_measured_is_told_and_not_refused(folder, capsys):
    """With the same words that a start would use; adopted, it is refused."""
    sbs = folder / "puma.sbs"
    text = sbs.read_text().replace("MUF", "EDF")
    sbs.write_text(text.replace("\nRTPU", "\nSTRICT yes\nRTPU", 1))
    for name in ("grav_comp", "qrdiff", "jttrace"):
        save(folder, name, hz=100.0, most=3.9e-3)
    with pytest.raises(SystemExit) as caught:
        main(["check", str(folder / "puma.job")])
    out = capsys.readouterr().out
    words = "on RTPU arm1 any of grav_comp and qrdiff and jttrace may miss deadlines"
    assert f"WARNING> arm1: {words}" in out
    assert "with measured times" in out
    assert not caught.value.code
    adopt.adopt(sbs, ["grav_comp", "qrdiff", "jttrace"], margin=0.0)
    with pytest.raises(SystemExit) as caught:
        main(["check", str(folder / "puma.job")])
    assert caught.value.code == 1
    assert f"ERROR> arm1: {words}" in capsys.readouterr().out


LAG = '''
from typing import Annotated as A
from pbonet import OutVar, PortBasedObject, Vector

class Lag(PortBasedObject):
    """Write zero velocity."""

    v: A[Vector, OutVar("Q^_MEZ", "6", "rad/s", "velocity")]

    def cycle(self, dt):
        self.v[:] = 0.0
'''


def test_a_module_without_a_file_gets_one(folder, call):
    (folder / "lag.py").write_text(LAG)
    save(folder, "lag", hz=40.0)
    status, out, _ = call("adopt", folder / "puma.sbs", "lag")
    assert status == 0
    assert "+OUTVAR    Q^_MEZ" in out
    rmod = read_rmod(folder / "lag.rmod")
    assert (rmod.module, rmod.freq, rmod.outvar) == ("lag", 40.0, ("Q^_MEZ",))
    assert rmod.maxc == pytest.approx(801e-6 * 1.2, rel=0.01)
