"""``pbonet upgrade``: another release for the machines of a running system."""

from __future__ import annotations

from typing import Annotated as A

from pbonet.cli import options
from pbonet.cli.parser import Option

from . import shared_arguments as shared


def command(
    *,
    file: shared.Hosts,
    apply: shared.Apply = False,
    yes: A[bool, Option("Turn tasks off that are ON, whatever the job says.")] = False,
    back: A[bool, Option("Return to the release that was used before.")] = False,
    host: shared.Host = None,
    wheel: shared.Wheel = None,
    wheelhouse: shared.Wheelhouse = None,
    build: shared.Build = False,
    place: options.Watching,
    json_: options.Json = False,
) -> int:
    """Upgrade machines one after the other, while the others run.

    Of each: tasks move to their fallbacks or are turned off, the agents end, the new
    release is used, the agents start, and jobs of the file are started again. It stops
    at the first machine that does not come back. The status is 1 then.

    Examples:
        Print the plan, and what becomes of tasks that are ON:
        pbonet upgrade lab.toml --wheel pbonet-0.2.0-cp311-cp311-linux_x86_64.whl
        Return one machine to the release before:
        pbonet upgrade lab.toml --back --host arm-pc --apply --connect tls/10.0.0.1:7447
    """
    from pbonet import deploy

    hosts = deploy.read_hosts(file, host or ())
    releases = (
        [] if back else shared.needed_releases(hosts, wheel, wheelhouse, build=build)
    )
    reports = deploy.rolling_upgrade.upgrade(
        hosts, releases, place, apply=apply, yes=yes
    )
    text = deploy.host_reports.text(reports, planned=not apply)
    options.show(text, deploy.host_reports.data(reports), as_data=json_)
    return deploy.host_reports.status(reports)
