"""What fits a port, and what is offered where something does not."""

import pytest
from edited_jobs import TASKS, puma

from pbonet.errors import ConfigError, ModuleLoadError, UnknownTaskError
from pbonet.master.editing import JobEditor

__all__ = ["puma"]

CONNECTORS = ["join_average", "join_first", "join_max", "join_min"]


def offers(editor, kind):
    return [offer for offer in editor.offers() if offer.kind == kind]


def fits(editor, task, port):
    """Return by port or variable why it does not fit; empty text: it does."""
    return {
        f"{one.task}.{one.port}" if one.port else one.variable: one.reason
        for one in editor.fitting(task, port)
    }


def test_ports_that_fit_light_up_and_others_say_why_not(puma):
    editor = JobEditor(puma)
    editor.add_variable("HAND", nelem=3, units="rad", desc="three angles")
    editor.add_variable("GRIP", nelem=6, units="rad", desc="six angles")
    editor.add_variable("COUNT", type="int", nelem=6, units="rad", desc="whole")
    found = fits(editor, "grav_comp", "Q_MEZ")
    assert found["puma_pidg.Q_MEZ"] == ""
    assert found["jttrace.Q_REF"] == ""
    assert found["GRIP"] == ""
    assert found["puma_pidg.Q^_MEZ"] == "units differ: rad and rad/s"
    assert found["COUNT"] == "Q_MEZ takes double, COUNT is int"
    assert "sizes differ" in found["HAND"]
    assert "qrdiff.Z" not in found  # an input, too
    assert "grav_comp.T_GRAV" not in found  # its own
    fit = [one.fits for one in editor.fitting("grav_comp", "Q_MEZ")]
    assert fit == sorted(fit, reverse=True)


def test_an_output_is_judged_by_who_would_read_it(puma):
    editor = JobEditor(puma)
    found = fits(editor, "jttrace", "Q_REF")
    assert found["puma_pidg.Q_REF"] == ""
    assert found["grav_comp.Q_MEZ"] == ""
    assert found["puma_pidg.Q^_REF"] == "units differ: rad/s and rad"
    assert found["qrdiff.NDOF"] == "NDOF is a constant, Q_REF changes"


def test_two_inputs_of_a_task_cannot_have_one_variable(puma):
    editor = JobEditor(puma)
    editor.add_task("join_min", aliases={"Z1": "Q_REF", "Z2": "Q_MEZ", "Z": "Q_LOW"})
    assert fits(editor, "join_min", "Z2")["jttrace.Q_REF"] == (
        "Q_REF is at Z1 of the same task"
    )
    with pytest.raises(ConfigError, match="both connected to the variable 'Q_REF'"):
        editor.connect("join_min", "Z2", "Q_REF")


def test_ports_that_are_not_there(puma):
    editor = JobEditor(puma)
    with pytest.raises(
        ConfigError, match=r"has no port Q_MES .*; did you mean Q_MEZ\?"
    ):
        editor.fitting("grav_comp", "Q_MES")
    with pytest.raises(UnknownTaskError):
        editor.fitting("nobody", "Q_MEZ")


def test_every_port_that_fits_can_be_connected(puma):
    editor = JobEditor(puma)
    for one in editor.fitting("grav_comp", "Q_MEZ"):
        try:
            state = editor.connect("grav_comp", "Q_MEZ", one.variable)
        except ConfigError:
            assert not one.fits, one
            continue
        wrong = [f for f in state["graph"]["faults"] if "grav_comp" in f["text"]]
        assert bool(wrong) is not one.fits, one
        if one.variable != "Q_MEZ":
            editor.undo()


def test_a_name_that_no_task_writes_is_offered_a_like_one_by_alias(puma):
    editor = JobEditor(puma)
    state = editor.connect("jttrace", "Q_REF", "Q_GOAL")
    assert not state["legal"]
    (entry,) = offers(editor, "add-variable")
    assert entry.text == "add Q_GOAL (double[6] in rad) to the table"
    state = editor.apply(entry)
    assert not state["legal"]
    offer = next(o for o in offers(editor, "connect") if "Q_GOAL" in o.text)
    assert "Q_REF of puma_pidg and Z of qrdiff to Q_GOAL" in offer.text
    state = editor.apply(offer)
    assert state["legal"], state["errors"]
    aliases = editor.files.draft.texts[puma.with_name("puma_pidg.rmod")]
    assert "SVARALIAS Q_REF=Q_GOAL" in aliases
    assert state["undo"] == offer.text
    assert not editor.undo()["legal"]  # one step back, though it was two changes


def test_missing_tasks_are_offered_from_the_library_until_the_job_is_legal(puma):
    editor = JobEditor(puma.parent / "puma.sbs", name="own")
    editor.add_task("puma_pidg")
    wanted = {name for name, _ in TASKS}
    while not editor.state()["legal"]:
        offer = next(
            offer
            for offer in offers(editor, "add-task")
            if offer.steps[0].args["module"] in wanted
        )
        editor.apply(offer)
    names = {task["name"] for task in editor.state()["graph"]["tasks"]}
    assert names == wanted


def test_a_constant_that_no_task_gives_is_offered_its_producer_or_a_value(puma):
    editor = JobEditor(puma.parent / "puma.sbs", name="own")
    state = editor.add_task("jttrace")
    assert not state["legal"]
    assert any(
        o.steps[0].args["module"] == "puma_pidg" for o in offers(editor, "add-task")
    )
    (value,) = offers(editor, "set-variable")
    assert value.text == "give NDOF the value 6 in the table"
    state = editor.apply(value)
    assert state["legal"], state["errors"]
    assert "+INIT      6" in editor.changes()[0].diff


@pytest.mark.parametrize("connector", CONNECTORS)
def test_two_writers_are_joined_and_the_job_is_legal(puma, connector):
    editor = JobEditor(puma)
    assert not editor.add_task("jttrace")["legal"]
    joins = offers(editor, "join")
    assert [o.steps[-1].args["module"] for o in joins] == CONNECTORS
    state = editor.apply(joins[CONNECTORS.index(connector)])
    assert state["legal"], state["errors"]
    assert not [f for f in state["graph"]["faults"] if f["severity"] == "refuse"]
    made = {w["from"]: w["to"] for w in state["graph"]["wires"] if "'" in w["variable"]}
    assert made == {"jttrace": "join_Q_REF_1", "jttrace_2": "join_Q_REF_1"}
    editor.save()
    assert JobEditor(puma).state()["legal"]


def test_three_writers_get_a_chain(puma):
    editor = JobEditor(puma)
    editor.add_task("jttrace")
    editor.add_task("jttrace")
    state = editor.apply(offers(editor, "join")[0])
    assert state["legal"], state["errors"]
    names = [task["name"] for task in state["graph"]["tasks"]]
    assert names[-2:] == ["join_Q_REF_1", "join_Q_REF_2"]


def test_a_variable_of_another_size_is_joined_with_a_constant_of_its_own(puma):
    editor = JobEditor(puma)
    editor.add_variable("PAIR", nelem=2, units="rad", desc="two angles")
    for number in (1, 2):
        editor.add_task(
            "constant",
            name=f"pair{number}",
            params={"VALUE": "1 2"},
            aliases={"Y": "PAIR"},
        )
    state = editor.state()
    assert [f["text"] for f in state["graph"]["faults"]] != []
    state = editor.apply(offers(editor, "join")[0])
    assert not any("write PAIR" in text for text in state["errors"])
    assert not any("join_PAIR" in text for text in state["errors"]), state["errors"]


def test_a_writer_too_many_can_be_removed(puma):
    editor = JobEditor(puma)
    editor.add_task("jttrace")
    removed = [o.steps[0].args["task"] for o in offers(editor, "remove-task")]
    assert removed == ["jttrace_2", "jttrace"]
    assert editor.apply(offers(editor, "remove-task")[0])["legal"]


def test_an_rtpu_that_is_not_there_is_offered_those_that_are(puma):
    editor = JobEditor(puma)
    editor.set_field("qrdiff", "rtpu", "arm7")
    found = offers(editor, "set-field")
    assert [o.text for o in found] == ["run qrdiff on arm0", "run qrdiff on arm1"]
    assert editor.apply(found[0])["legal"]


def test_offers_name_their_fault(puma):
    editor = JobEditor(puma)
    editor.add_task("jttrace")
    faults = editor.state()["graph"]["faults"]
    for offer in editor.offers():
        (place,) = offer.faults
        assert "both write Q_REF" in faults[place]["text"]


def test_ports_are_disconnected_into_variables_of_their_own(puma):
    editor = JobEditor(puma)
    state = editor.disconnect("grav_comp", "Q_MEZ")
    (fault,) = (f for f in state["graph"]["faults"] if f["severity"] == "refuse")
    assert "no task that is ON writes Q_MEZ'" in fault["text"]
    assert fault["tasks"] == ["grav_comp"]
    state = editor.connect_ports("grav_comp", "Q_MEZ", "puma_pidg", "Q_MEZ")
    assert state["legal"]
    editor.disconnect("jttrace", "Q_REF")
    assert editor.state()["undo"] == "disconnect jttrace: Q_REF"
    state = editor.connect_ports("jttrace", "Q_REF", "qrdiff", "Z")
    assert "Q_REF'" in {w["variable"] for w in state["graph"]["wires"]}
    with pytest.raises(ConfigError, match="are both outputs"):
        editor.connect_ports("jttrace", "Q_REF", "puma_pidg", "Q_MEZ")


def test_another_unit_is_converted_by_a_gain(puma):
    editor = JobEditor(puma)
    editor.set_variable("Q_MEZ", "units", "deg")
    editor.set_variable("Q_REF", "units", "deg")
    while found := offers(editor, "convert"):
        text = found[0].text
        editor.apply(found[0])
    assert "by a gain of 0.0174533" in text
    state = editor.state()
    made = {w["from"]: w["to"] for w in state["graph"]["wires"] if "'" in w["variable"]}
    assert made == {"scale_Q_REF_1": "puma_pidg", "scale_Q_MEZ_1": "grav_comp"}
    # what writes them is wrong still: a gain comes before inputs only
    faults = [fault["ports"] for fault in state["graph"]["faults"]]
    assert faults == [["Q_MEZ"], ["Q_REF"]]
    tasks = [fault["tasks"] for fault in state["graph"]["faults"]]
    assert tasks == [["puma_pidg"], ["jttrace"]]


def test_a_rate_beyond_the_rtpu_is_offered_the_nearest(puma):
    sbs = puma.with_name("puma.sbs")
    sbs.write_text(sbs.read_text().replace("MUF", "RM"))
    editor = JobEditor(puma)
    editor.set_field("qrdiff", "freq", 2000)
    (offer,) = [o for o in editor.offers() if "Hz" in o.text]
    assert offer.text == "run qrdiff at 1000 Hz"
    state = editor.apply(offer)
    assert state["settings"]["qrdiff"]["freq"] == 1000.0
    assert [o for o in editor.offers() if "Hz" in o.text] == []


def test_a_robot_that_is_not_critical_is_offered_to_be(puma):
    editor = JobEditor(puma)
    state = editor.set_field("puma_pidg", "critical", value=False)
    assert any("robot interface" in fault["text"] for fault in state["graph"]["faults"])
    (offer,) = offers(editor, "set-field")
    state = editor.apply(offer)
    assert state["graph"]["faults"] == []
    assert editor.changes() == []


def test_a_module_that_cannot_be_critical(puma):
    editor = JobEditor(puma)
    assert not editor.set_field("qrdiff", "critical", value=True)["legal"]
    (offer,) = offers(editor, "set-field")
    assert offer.text == "qrdiff is not CRITICAL"
    assert editor.apply(offer)["legal"]


@pytest.mark.slow
def test_the_palette_finds_modules_and_rmods_of_the_folder_too(puma):
    editor = JobEditor(puma)
    editor.add_task("jttrace", name="other")
    (jtball,) = editor.palette("jtball")
    assert {"jtball", "jttrace", "other"} <= set(jtball["rmods"])
    found = [one["name"] for one in editor.palette(writes="T_GRAV")]
    assert found[:2] == ["grav_comp", "gravity"]
    with pytest.raises(ModuleLoadError, match="the library has no such module"):
        editor.palette("nothing of that kind")


def test_a_constant_of_the_size_that_is_there_is_taken_for_a_join(puma):
    editor = JobEditor(puma)
    editor.add_variable("PAIR", nelem=2, units="rad", desc="two angles")
    editor.add_variable("TWO", type="int", desc="a size", init=[2])
    for number in (1, 2):
        editor.add_task(
            "constant",
            name=f"pair{number}",
            params={"VALUE": "1 2"},
            aliases={"Y": "PAIR", "NDOF": "TWO"},
        )
    state = editor.apply(offers(editor, "join")[0])
    assert state["legal"], state["errors"]
    (task,) = (t for t in state["graph"]["tasks"] if t["name"].startswith("join"))
    assert {p["port"]: p["variable"] for p in task["ins"]}["NDOF"] == "TWO"


def test_a_port_of_another_size_is_offered_what_fits(puma):
    editor = JobEditor(puma)
    editor.add_variable("HAND", nelem=3, units="rad", desc="three angles")
    state = editor.connect("grav_comp", "Q_MEZ", "HAND")
    (fault,) = (f for f in state["graph"]["faults"] if "disagree" in f["text"])
    assert (fault["tasks"], fault["ports"]) == (["grav_comp"], ["DH", "Q_MEZ"])
    assert fault["variables"] == ["DH", "HAND"]
    found = [o.text for o in offers(editor, "connect")]
    assert "connect Q_MEZ of grav_comp to Q_MEZ (SVARALIAS)" in found
    chosen = found.index("connect Q_MEZ of grav_comp to Q_MEZ (SVARALIAS)")
    assert editor.apply(offers(editor, "connect")[chosen])["legal"]


def test_a_fault_of_a_file_names_the_task(puma):
    editor = JobEditor(puma)
    state = editor.set_parameter("jttrace", "REPEET", "no")
    (fault,) = (f for f in state["graph"]["faults"] if "REPEET" in f["text"])
    assert fault["tasks"] == ["jttrace"]
    editor.undo()
    state = editor.add_task("jttrace", name="other", params={"SPEED": "fast"})
    (fault,) = (f for f in state["graph"]["faults"] if "fast" in f["text"])
    assert fault["tasks"] == ["other"]
