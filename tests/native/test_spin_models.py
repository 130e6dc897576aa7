"""Models of the state variable table and of a core's lease, searched whole by spin.

They stand in tests/native: register.pml, cut.pml, owner.pml, safe.pml and lease.pml.
What they leave out is said in docs/svar-model.md. Each must hold, and must fail for
every fence, check or step that is taken out: a model that cannot fail proves nothing.
"""

import os
import re
import shutil
import subprocess
from dataclasses import dataclass

import pytest
from svar_rig import HEADERS, NATIVE, ROOT, build, compiler

MODELS = {
    "one reader, two reads": ("register",),
    "two readers": ("register", "READERS=2", "READS=1", "COMMITS=3"),
    "cut": ("cut",),
    "cut, one register lapped": ("cut", "COMMITS_P=4", "COMMITS_Q=1"),
    "takeover from the dead": ("owner",),
    "turned on again": ("owner", "RECLAIM"),
    "safe values": ("safe",),
    "lease": ("lease",),
}
MUTATIONS = {
    "register": {
        "NO_WRITE_FENCE": "R1: the next commit's bytes may overtake the head",
        "NO_RELEASE": "R2: the head may overtake its commit's bytes",
        "NO_ACQUIRE": "R3: bytes may be loaded before the head that names their slot",
        "NO_READ_FENCE": "R4: the second look may come before the bytes",
        "NO_SECOND_LOOK": "whatever was copied is taken",
        "LATE_LOOK": "one commit more passes the second look than the head keeps",
        "KEEP_MORE": "a head promises three commits, one more than there are slots for",
        "KEEP_AT_ONCE": "a head promises two commits right behind one that kept none",
        "ONE_MOVE": "the writer goes to and fro whatever it has promised",
        "SAME_SLOT": "the writer writes over the published commit",
    },
    "cut": {
        "NO_WRITE_FENCE": "R1, against the stricter look of a cut",
        "NO_RELEASE": "R2: the head may overtake its commit's bytes",
        "NO_ACQUIRE": "R3: first looks and copies in any order",
        "NO_CUT_FENCE": "C3: second looks may come before the copies",
        "WHOLE_WILL_DO": "groups that are whole each are called a consistent cut",
        "HALF_LOOK": "the register looked at first may have gone on",
        "LOOK_EACH": "look, copy, look again at one register after the other",
    },
    "owner": {
        "NO_RELEASE": "R2: a generation may be seen before its directory",
        "NO_ACQUIRE": "C2: entries may be loaded before the generation",
        "NO_PLAN_FENCE": "C1: the look behind the plan may come before its loads",
        "NO_PLAN_CHECK": "C1: a plan is used although its generation has passed",
        "NO_GENERATION_CHECK": "C4: the generation is not looked at again",
        "NO_REUSE_FENCE": "O1: a register is used again before all see it freed",
        "NO_HANDOVER": "L1, L2: the lock orders nothing",
        "NO_LOCK": "two tasks claim at the same time",
        "NO_RECOVERY": "the lock of a dead claimer is not given on",
        "NO_REFUSAL": "a variable is taken from a live owner",
        "PUBLISH_FIRST": "ownership is published before the first commit",
        "ONE_BY_ONE": "each variable changes hands in a generation of its own",
        "IN_PLACE": "the present directory is changed instead of a copy",
        "SWEEP_NAMED": "a register is freed while variables stand in it",
        "SWEEP_HELD": "a register is freed while its holder lives",
        "RECLAIM_IN_PLACE": "a claim's commit goes where some of its variables stand",
    },
    "safe": {
        "COMMIT_UNASKED": "a cycle commits although it was taken",
        "NO_LOOK_BEFORE": "S1: a failure from before the cycle began waits for its end",
        "NO_LOOK_AFTER": "S4: a failure amid the cycle's commit is forgotten",
        "NO_TAKEOVER": "what a killed dispatcher has begun is not finished",
        "TAKE_UNLOCKED": "the dispatcher publishes without the lock",
    },
    "lease": {
        "NO_RING": "a next release that is written rings no bell",
        "RING_GRANTED": "it rings only after a grant, not after a give-up",
        "RING_FIRST": "the bell is rung before the next release is written",
        "BELL_LATE": "the bell is loaded after the next release",
        "END_LATE": "the end is marked after its task has loaded the next release",
        "GRANT_FIRST": "a grant's number is stored before its times",
        "BELL_FIRST": "the bell of a grant is rung before its number is stored",
        "RECALL_LATE": "a turn reads what was taken before it calls the lease back",
        "FORGET_CYCLE": "a turn takes the cycle under way out of the word, too",
        "MAIL_LATE": "the dispatcher loads its mailbox after the turn",
        "RELEASE_FIRST": "a task loads its release before the word",
        "LIMIT_FIRST": "a task loads the end of the lease before the word",
        "TAKE_UNASKED": "a release is taken without an exchange",
        "SLEEP_AFTER_LOSS": "whoever loses the exchange sleeps until it is woken",
        "NO_SECOND_LOOK": "a task that saw no lease does not load the word again",
        "NO_KICK": "a task that slept through a release wakes no dispatcher",
        "CPU_LATE": "the CPU clock is stored after the word",
        "ONE_CLOCK": "two releases that follow one another have one CPU clock",
        "GIVE_BACK_FIRST": "a cycle leaves the word before it is marked as ended",
        "END_AFTER_WORD": "the end is marked after its task has loaded the word",
        "GIVE_BACK_UNASKED": "a cycle leaves the word without an exchange",
        "WORD_FIRST": "the word is opened before the end of the lease is stored",
        "NEXT_LAST": "the word is opened before the next release is written",
        "LEND_OVERRUN": "there is a lease while a cycle overruns",
        "NO_LOOK_AT_END": "a cycle that ends as the word is opened stays in it",
        "TIME_FIRST": "the dispatcher reads the time before it opens the word",
        "NO_TIME": "the dispatcher does not read the time after that",
    },
}
NEEDS = {"RECLAIM_IN_PLACE": ("RECLAIM",)}
SETTINGS = {"COMMITS", "READS", "READERS", "COMMITS_P", "COMMITS_Q", "POOL"} | {
    "RECLAIM",
    "HINTS",
    "CYCLES",
    "INSTANTS",
}
DEPTH = 10_000
THOROUGH = ("-O1",)
# Another order of search, which meets most errors early: then compiling takes longest.
HASTY = ("-O0", "-DREVERSE", "-DT_REVERSE")
CUT_SHORT = ("Search not completed", "max search depth", "out of memory")


@dataclass(frozen=True)
class Search:
    """What spin's verifier printed."""

    text: str

    @property
    def errors(self) -> int:
        """How many errors the verifier reports; it stops at the first."""
        found = re.search(r"errors: (\d+)", self.text)
        assert found, self.text
        return int(found[1])

    @property
    def states(self) -> int:
        """How many different states there were."""
        found = re.search(r"([\d.e+]+) states, stored", self.text)
        assert found, self.text
        return int(float(found[1]))

    @property
    def complete(self) -> bool:
        """Whether every state was seen: no bound of the search was met."""
        return not any(words in self.text for words in CUT_SHORT)

    @property
    def unreached(self) -> list[str]:
        """Statements that no execution came to; the memory itself never ends."""
        return [
            f"{process}: {line.strip()}"
            for process, lines in re.findall(
                r"unreached in (\w[\w ]*)\n((?:\t.*\n)*)", self.text
            )
            for line in lines.splitlines()
            if ", state " in line
            and not (process.endswith("Memory") and '"-end-"' in line)
        ]


@pytest.fixture
def spin() -> str:
    """Return the program; without it skip, but fail where CI says it must be there."""
    found = shutil.which("spin")
    if found is None:
        if os.environ.get("CI"):
            pytest.fail("spin is not installed, and CI must run it (apt install spin)")
        pytest.skip("spin is not installed (apt install spin)")
    return found


@pytest.fixture
def search(spin, tmp_path):
    """Return a function that searches a model with these definitions."""

    def run(*command: str) -> str:
        done = subprocess.run(
            command, cwd=tmp_path, check=False, capture_output=True, text=True
        )
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
        return done.stdout

    def search_model(model: str, *defines: str, flags: tuple[str, ...]) -> Search:
        named = [f"-D{name}" for name in defines]
        run(spin, *named, "-a", str(NATIVE / f"{model}.pml"))
        limits = ("-DSAFETY", "-DCOLLAPSE", "-DMEMLIM=900")
        run(compiler(), *flags, "-w", *limits, "-o", "pan", "pan.c")
        return Search(run("./pan", f"-m{DEPTH}", "-w22"))

    return search_model


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("name", MODELS)
def test_the_protocol_holds(name, search):
    model, *defines = MODELS[name]
    found = search(model, *defines, flags=THOROUGH)
    assert found.errors == 0, found.text
    assert found.complete, found.text
    assert found.unreached == [], "the model does everything that it can say"
    assert found.states > 1_000_000


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    ("model", "mutation"),
    [(model, name) for model, names in MUTATIONS.items() for name in names],
)
def test_the_protocol_needs_every_fence_and_check(model, mutation, search):
    found = search(model, *NEEDS.get(mutation, ()), mutation, flags=HASTY)
    assert found.errors == 1, MUTATIONS[model][mutation]
    what = "invalid end state" if mutation == "NO_RECOVERY" else "assertion violated"
    assert f"pan:1: {what}" in found.text


def test_every_mutation_of_the_models_is_tried():
    tried = {name for names in MUTATIONS.values() for name in names}
    named = {
        name
        for path in NATIVE.glob("*.pml")
        for line in path.read_text().splitlines()
        if re.match(r"#(?:if|ifdef|ifndef|elif)\b", line)
        for name in re.findall(r"\b[A-Z][A-Z_]+\b", line)
    }
    assert named == tried | SETTINGS


def test_every_sync_point_of_the_headers_is_accounted_for():
    page = (ROOT / "docs" / "svar-model.md").read_text()
    points = {
        point
        for header in HEADERS.glob("*.h")
        for point in re.findall(r"SYNC POINT (\w+)", header.read_text())
    }
    assert {"R1", "C1", "O1", "L1"} <= points
    listed = set(re.findall(r"^\| ([A-Z]\d) \|", page, re.MULTILINE))
    assert listed == points


@pytest.mark.slow
def test_being_turned_on_again_is_one_event(tmp_path):
    program = build("svar_again.c", tmp_path / "again")
    done = subprocess.run([program], check=True, capture_output=True, text=True)
    cuts = [tuple(map(int, line.split())) for line in done.stdout.splitlines()]
    assert cuts[0] == (5, 10)
    assert cuts[-1] == (20, 20)
    assert set(cuts) == {(5, 10), (20, 20)}
