"""The plan for a machine: a function of what it has and what it is to have."""

from __future__ import annotations

import difflib
import hashlib
import secrets
from typing import TYPE_CHECKING, Final

from pbonet.errors import NodeError
from pbonet.xm.net import credentials

from . import steps
from .hosts_file import KEYS
from .steps import Put, Run, Step, packaged

if TYPE_CHECKING:
    from collections.abc import Iterator

    from .host_facts import Facts
    from .host_keys import HostKeys
    from .hosts_file import Machine
    from .release import Release

BEFORE: Final = "before-deploy"
"""The name of a release that host-setup.sh installed."""
INCOMING: Final = f"{steps.RELEASES}/incoming"
ALONE: Final = ("flock", "/run/pbonet-install.lock")
"""Waits for what still installs there: another operator, or a pip whose connection was
lost."""
_CLEAR: Final = (
    '[ ! -e "$1" ] || find "$1" -mindepth 1 -maxdepth 1 -mmin +30 -exec rm -rf {} +'
)
"""Removes wheels whose connection was lost, and none that are being sent now."""
_UNCHANGED: Final = """
[ -L "$1" ] && now=$(basename "$(readlink -f "$1")") || now=
[ "$now" = "$2" ] || { echo "${now:-none}"; exit 1; }
"""
"""Whether a link leads to a release, or is not there; else prints where it leads."""


class Plan:
    """The steps for one machine.

    Args:
        machine: What it is to have.
        facts: What it has.
        release: What is to be installed; None: what is there stays.
        keys: Its keys; None: it has none of ours.
    """

    def __init__(
        self,
        machine: Machine,
        facts: Facts,
        release: Release | None,
        keys: HostKeys | None,
    ) -> None:
        self.machine = machine
        self.facts = facts
        self.release = release
        self.keys = keys
        self._reread: set[str] = set()
        """RTPUs whose agents read their configuration or keys again."""

    @property
    def rtpus(self) -> list[str]:
        """RTPUs of the machine, those too that are not to be there."""
        return list(dict.fromkeys((*self.machine.configs, *self.facts.enabled)))

    def steps(self) -> list[Step]:
        """Return all steps, in the order in which they are done.

        Raises:
            NodeError: The machine cannot take pbonet.
        """
        self.check()
        found = [*self._user(), self._limits(), *self._install(), *self._use()]
        found += [*self._keys(), *self._configs(), self._unit()]
        return [*found, *self._services(), *self._strangers()]

    def install_steps(self) -> list[Step]:
        """Return the steps that install the release beside others.

        Raises:
            NodeError: There is no room for it.
        """
        return [*self._install()]

    def check(self) -> None:
        """Raise if the machine cannot take pbonet."""
        facts = self.facts
        if not facts.systemctl:
            raise NodeError(
                "the machine has no systemd",
                where=self.machine.name,
                remedy="docs/deployment.md says what an agent needs without it",
            )
        if self.release is not None and not facts.venv:
            raise NodeError(
                f"{self.machine.host.python} makes no environments there",
                where=self.machine.name,
                remedy="apt-get install python3-venv on the machine",
            )

    # -- what every machine has ---

    def _user(self) -> Iterator[Step]:
        there = self.facts.groups is not None and "dialout" in self.facts.groups
        yield self._file(
            "user",
            steps.SYSUSERS,
            packaged("systemd/pbonet.sysusers"),
            "user pbonet, in the group dialout",
            Run(("systemd-sysusers", steps.SYSUSERS)),
            lacks=not there,
        )
        yield self._file(
            "runtime folder",
            steps.TMPFILES,
            packaged("systemd/pbonet.tmpfiles"),
            "/run/pbonet, for all agents of the machine",
            Run(("systemd-tmpfiles", "--create", steps.TMPFILES)),
            lacks=not self.facts.run_folder,
        )

    def _limits(self) -> Step:
        what = "real-time rights of people in the group pbonet"
        return self._file("limits", steps.LIMITS, packaged("limits.conf"), what)

    def _unit(self) -> Step:
        text = packaged("systemd/pbonet-agent@.service")
        running = any(map(self.facts.running, self.machine.configs))
        what = "pbonet-agent@.service"
        if running and self.facts.text(steps.UNIT) != text:
            what += "; it holds for agents that are started from now on"
        unread = any(unit.unread for unit in self.facts.units.values())
        read = self._read_units()
        return self._file("unit", steps.UNIT, text, what, *read, lacks=unread)

    def _read_units(self) -> tuple[Run, ...]:
        return (Run(("systemctl", "daemon-reload")),) if self.facts.systemd else ()

    def _file(
        self,
        name: str,
        path: str,
        text: str,
        what: str,
        *follow: Run,
        lacks: bool = False,
    ) -> Step:
        """Return the step that gives a file its text, and what follows from that.

        Args:
            name: The step's name.
            path: The file.
            text: Its text.
            what: What the step is about.
            follow: What is run when the file has changed.
            lacks: Whether that is to be run even if it has not.
        """
        before = self.facts.text(path)
        put = () if before == text else (Put(path=path, data=text.encode()),)
        if not put and not lacks:
            return Step(name=name, state="same", what=what)
        diff = _diff(path, before, text) if put and before is not None else ""
        actions = (*put, *follow)
        return Step(name=name, state="change", what=what, diff=diff, actions=actions)

    # -- releases ---

    def _install(self) -> Iterator[Step]:
        release = self.release
        if release is None:
            return
        if release.name in self.facts.releases:
            yield Step(name="release", state="same", what=f"{release.name} is there")
            return
        _check_room(self.machine, self.facts, release)
        yield Step(
            name="release",
            state="change",
            what=f"{release.name} is installed beside others, "
            + ("with its wheels" if release.wheelhouse else "packages by pip there"),
            actions=tuple(install(self.machine, release)),
        )

    def _use(self) -> Iterator[Step]:
        """Use the release, unless agents run with another one."""
        release, facts = self.release, self.facts
        if release is None:
            return
        if facts.current == release.name:
            yield Step(name="in use", state="same", what=release.name)
            return
        running = [one for one in self.rtpus if facts.running(one)]
        old = facts.current or ("that of host-setup.sh" if facts.folder else "")
        if running and old:
            what = f"{', '.join(running)} run {old}: 'pbonet upgrade' changes that"
            yield Step(name="in use", state="waits", what=what)
            return
        yield Step(
            name="in use",
            state="change",
            what=f"{release.name}, before: {old or 'none'}",
            actions=tuple(use(facts, release.name)),
        )

    # -- keys and configurations ---

    def _keys(self) -> Iterator[Step]:
        keys = self.keys
        if keys is None:
            return
        names = ", ".join(self.machine.reached_at)
        if keys.lacks:
            what = f"a certificate for {names} is made and put there: {keys.lacks}"
            yield Step(name="keys", state="change", what=what)
            self._reread |= {*self.machine.configs}
            return
        there = self.facts.files | self.facts.secrets
        wanted = [
            Put(
                path=f"{KEYS}/{name}",
                data=keys.files[name],
                mode=0o600 if name == credentials.KEY else 0o644,
                owner=steps.USER,
            )
            for name in (credentials.KEY, credentials.CERT, credentials.CA)
        ]
        puts = [one for one in wanted if not _stands(there.get(one.path), one)]
        what = f"certificate for {names}"
        if not puts:
            yield Step(name="keys", state="same", what=what)
            return
        self._reread |= {*self.machine.configs}
        yield Step(name="keys", state="change", what=what, actions=tuple(puts))

    def _configs(self) -> Iterator[Step]:
        for rtpu, text in self.machine.configs.items():
            path = steps.config_of(rtpu)
            step = self._file(rtpu, path, text, f"configuration of RTPU {rtpu}")
            if step.state == "change":
                self._reread.add(rtpu)
            yield step
            if rtpu in self.machine.cores:
                yield self._cores(rtpu)
            elif self.facts.text(steps.cores_of(rtpu)) is not None:
                yield self._no_cores(rtpu)

    def _cores(self, rtpu: str) -> Step:
        own = self.machine.cores[rtpu]
        online, facts = self.facts.online, self.facts
        if own not in online:
            raise NodeError(
                f"RTPU {rtpu} is to have core {own}",
                where=self.machine.name,
                expected=f"one of {', '.join(map(str, online))}",
                remedy="correct its core in the file of hosts",
            )
        taken = {*self.machine.cores.values(), *facts.isolated}
        others = [str(core) for core in online if core not in taken]
        affinity = " ".join([*others, str(own)])
        text = (
            f"# Core {own} is the RTPU's own; the others are for its agent and all "
            f"that is not real time.\n[Service]\nCPUAffinity={affinity}\n"
        )
        what = f"cores of RTPU {rtpu}: {own}, and {' '.join(others) or 'no other'}"
        return self._file(rtpu, steps.cores_of(rtpu), text, what, *self._read_units())

    def _no_cores(self, rtpu: str) -> Step:
        """Return the step for an RTPU that names no core any more."""
        path = steps.cores_of(rtpu)
        what = f"cores of RTPU {rtpu}: all, as it names none"
        if self.facts.running(rtpu):
            what += "; it holds when its agent is started again"
        diff = _diff(path, self.facts.text(path) or "", "")
        actions = (Run(("rm", "-f", path)), *self._read_units())
        return Step(name=rtpu, state="change", what=what, diff=diff, actions=actions)

    # -- services ---

    def _services(self) -> Iterator[Step]:
        for rtpu in self.machine.configs:
            unit = steps.unit_of(rtpu)
            found = self.facts.units.get(unit)
            enabled = rtpu in self.facts.enabled
            if not self.facts.systemd:
                enable = (Run(("systemctl", "enable", unit)),)
                yield self._service(
                    rtpu, "starts with systemd", () if enabled else enable
                )
            elif not enabled or found is None or not self.facts.running(rtpu):
                start = Run(("systemctl", "enable", "--now", unit), must=False)
                state = "" if found is None else f", before: {found.state}"
                yield self._service(rtpu, f"is enabled and started{state}", (start,))
            elif rtpu in self._reread or self._is_behind(rtpu):
                reload = Run(("systemctl", "reload", unit))
                what = "reads its configuration and keys again; its tasks go on"
                yield self._service(rtpu, what, (reload,))
            else:
                yield self._service(rtpu, "runs", ())

    def _is_behind(self, rtpu: str) -> bool:
        """Return whether files were written, and then the connection was lost."""
        keys = [f"{KEYS}/{name}" for name in credentials.FILES]
        return self.facts.behind(rtpu, [steps.config_of(rtpu), *keys])

    def _service(self, rtpu: str, what: str, actions: tuple[Run, ...]) -> Step:
        state: steps.State = "change" if actions else "same"
        what = f"the agent of {rtpu} {what}"
        return Step(name="service", state=state, what=what, actions=actions)

    def _strangers(self) -> Iterator[Step]:
        for rtpu in self.facts.enabled:
            if rtpu not in self.machine.configs:
                what = (
                    f"the agent of {rtpu} is not in the file of hosts, and stays: "
                    f"'systemctl disable --now {steps.unit_of(rtpu)}' ends it"
                )
                yield Step(name="service", state="same", what=what)


def install(machine: Machine, release: Release) -> Iterator[Put | Run]:
    """Yield what installs a release beside others; it is not used yet."""
    folder = f"{steps.RELEASES}/{release.name}"
    incoming = f"{INCOMING}/{release.name}-{secrets.token_hex(3)}"
    yield Run(("sh", "-c", _CLEAR, "sh", INCOMING))
    for path in (release.wheel, *release.wheelhouse):
        yield Put(path=f"{incoming}/{path.name}", data=path.read_bytes())
    index = ("--no-index", f"--find-links={incoming}") if release.wheelhouse else ()
    here = (folder, incoming, steps.COMPLETE, machine.host.python)
    yield Run(
        (*ALONE, "sh", "-s", "--", *here, *index, f"{incoming}/{release.requirement}"),
        data=packaged("install_release.sh").encode(),
        what=f"the release {release.name} cannot be installed",
    )


def use(facts: Facts, name: str) -> Iterator[Run]:
    """Yield what makes a release the one in use, while no agent runs.

    The one that is replaced stays, and can be used again.
    """
    before = facts.current
    if before == name:
        return
    yield Run(
        ("sh", "-c", _UNCHANGED, "sh", steps.OPT, before),
        what=f"the release in use is not {before or 'none'} any more, as planned",
        remedy="agree with who else works on the machine, and repeat",
    )
    if facts.folder:
        before = BEFORE
        target = f"{steps.RELEASES}/{BEFORE}"
        yield Run(("mkdir", "-p", steps.RELEASES))
        yield Run(("mv", "-T", steps.OPT, target))
        yield Run(("touch", f"{target}/{steps.COMPLETE}"))
    if before:
        yield Run(("ln", "-sfnT", before, steps.PREVIOUS))
    new = f"{steps.OPT}.new"
    yield Run(("ln", "-sfnT", f"{steps.RELEASES}/{name}", new))
    yield Run(("mv", "-fT", new, steps.OPT))


def _check_room(machine: Machine, facts: Facts, release: Release) -> None:
    if facts.free < release.size:
        raise NodeError(
            "there is no room for another release",
            where=f"{machine.name}: /opt",
            expected=f"{release.size >> 20} MiB",
            got=f"{facts.free >> 20} MiB are free",
            remedy="remove what is not needed, such as old releases in "
            f"{steps.RELEASES}",
        )


def _stands(there: object, wanted: Put) -> bool:
    digest = hashlib.sha256(wanted.data).hexdigest()
    mine = (digest, wanted.mode, wanted.owner)
    has = [getattr(there, name, None) for name in ("digest", "mode", "owner")]
    return tuple(has) == mine


def _diff(path: str, before: str, after: str) -> str:
    lines = difflib.unified_diff(
        before.splitlines(), after.splitlines(), path, path, lineterm="", n=1
    )
    return "\n".join(lines)
