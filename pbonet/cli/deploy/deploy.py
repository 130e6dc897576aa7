"""``pbonet deploy``: set machines up over ssh."""

from __future__ import annotations

from typing import Annotated as A

from pbonet.cli import options
from pbonet.cli.parser import Option

from . import shared_arguments as shared


def command(
    *,
    file: shared.Hosts,
    apply: shared.Apply = False,
    host: shared.Host = None,
    wheel: shared.Wheel = None,
    wheelhouse: shared.Wheelhouse = None,
    build: shared.Build = False,
    fail_fast: A[bool, Option("Leave the others alone when one fails.")] = False,
    json_: options.Json = False,
) -> int:
    """Set machines up over ssh: user, limits, release, keys, agents.

    It prints for each machine what is so, what will change and what has changed, and
    can be repeated. No agent that runs is stopped: `upgrade` does that. The status is 1
    if a machine failed.

    Examples:
        Print what would be done:
        pbonet deploy lab.toml --wheel pbonet-0.2.0-cp311-cp311-linux_x86_64.whl
        Do it on one machine:
        pbonet deploy lab.toml --host arm-pc --apply
    """
    from pbonet import deploy

    hosts = deploy.read_hosts(file, host or ())
    releases = shared.releases_of(hosts, wheel, wheelhouse, build=build)
    reports = deploy.set_up_hosts.deploy(
        hosts, releases, apply=apply, fail_fast=fail_fast
    )
    text = deploy.host_reports.text(reports, planned=not apply)
    options.show(text, deploy.host_reports.data(reports), as_data=json_)
    return deploy.host_reports.status(reports)
