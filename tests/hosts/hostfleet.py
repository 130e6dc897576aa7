"""A master of a subsystem on several hosts, request by request."""

from __future__ import annotations

import contextlib
import secrets

import zenoh
from hostkit import Asking
from long_limits import LIMIT
from nodekit import rmod, svar

from pbonet.errors import PbonetError
from pbonet.xm.net import key_expressions, messages as m

AGED = """
NAME Z0
TYPE double
DESC a variable that ages
UNITS none
NELEM 2
MAXAGE 0.2

NAME Z1
TYPE double
DESC one that is carried slowly
UNITS none
NELEM 2
RATE 5

NAME Z2
TYPE double
DESC another one that ages
UNITS none
NELEM 2
MAXAGE 0.2

NAME TALLY
TYPE double
DESC what a reader of a link has judged
UNITS none
NELEM 8

NAME MASS
TYPE double
DESC a constant
UNITS kg
NELEM 1

EOF
"""


class Desk:
    """A master on one of the hosts.

    Args:
        lab: The hosts and their agents.
        subsystem: Its name.
        rtpus: Those it uses; the first one keeps the table.
        host: Where the master is.
        alone: Seconds without the keeper's machine; 0: its loss is not noticed.
    """

    def __init__(
        self, lab, subsystem, rtpus=("arm0", "arm1", "arm2"), host="a", *, alone=0.0
    ):
        self.lab, self.subsystem, self.host = lab, subsystem, host
        self.rtpus = list(rtpus)
        self.alone = alone
        self.name = f"m{secrets.token_hex(3)}"
        self.epochs: dict[str, int] = {}
        key = key_expressions.master(lab.domain, subsystem, self.name)
        self.token = lab.session(host).liveliness().declare_token(key)
        self._text = svar().replace("\nEOF\n", AGED)
        for rtpu in self.rtpus:
            self.claim(rtpu)

    def claim(self, rtpu):
        """Claim an RTPU, and open the table on its machine."""
        keep = rtpu == self.rtpus[0]
        request = m.Claim(
            svar=self._text,
            svar_name="t.svar",
            keep=keep,
            keeper=self.rtpus[0],
            alone=self.alone,
        )
        self.epochs[rtpu] = self.ask(rtpu, request, m.Claimed).epoch

    def join(self, rtpu):
        """Have one more RTPU take part."""
        self.rtpus.append(rtpu)
        self.claim(rtpu)

    def ask(self, rtpu, request, result=object, *, limit=LIMIT, host=None):
        session = self.lab.session(host or self.host)
        client = Asking(session, self.lab.domain, self.name)
        request.subsystem = self.subsystem
        request.epoch = self.epochs.get(rtpu, 0)
        return client.call(rtpu, request, result, timeout=limit)

    def spawn(self, rtpu, task, module, *, gives="none", **settings):
        text = rmod(module, **settings).replace("OUTCONST none", f"OUTCONST {gives}")
        request = m.Spawn(task=task, rmod=text, rmod_name=f"{task}.rmod")
        return self.ask(rtpu, request, m.TaskStatus)

    def control(self, rtpu, task, signal):
        return self.ask(rtpu, m.Control(task=task, signal=signal), m.TaskStatus)

    def on(self, rtpu, task):
        return self.control(rtpu, task, "on")

    def off(self, rtpu, task):
        return self.control(rtpu, task, "off")

    def write(self, name, values):
        self.ask(self.rtpus[0], m.Write(name=name, values=values))

    def look(self, rtpu, request, result=object):
        """Ask an RTPU on its own host, however cables are."""
        return self.ask(rtpu, request, result, host=self.lab.agents[rtpu][0])

    def value(self, rtpu, name):
        """Return a variable as it stands on an RTPU's machine."""
        return self.look(rtpu, m.Display(names=[name]), list[m.VarValue])[0]

    def flag(self, rtpu, cause, *, up):
        self.ask(rtpu, m.Flag(cause=cause, up=up))

    def illegal(self, rtpu):
        """Return the causes that stand on an RTPU's machine, as one text."""
        return "; ".join(self.look(rtpu, m.Status(), m.RtpuStatus).illegal)

    def status(self, rtpu, task):
        return self.look(rtpu, m.Status(task=task), m.RtpuStatus).tasks[0]

    def events(self, rtpu, code):
        """Return the texts of an RTPU's events of one code."""
        found = self.look(rtpu, m.Events(), list[m.Event])
        return [event.text for event in found if event.code == code]

    def close(self):
        """Stop everything and give the RTPUs back, as far as they can be reached."""
        for rtpu in self.rtpus:
            with contextlib.suppress(PbonetError):
                self.ask(rtpu, m.Stop(), m.Stopped)
        for rtpu in reversed(self.rtpus):
            with contextlib.suppress(PbonetError):
                self.ask(rtpu, m.Release())
        with contextlib.suppress(zenoh.ZError):  # a test has undeclared it
            self.token.undeclare()


__all__ = ["Desk"]
