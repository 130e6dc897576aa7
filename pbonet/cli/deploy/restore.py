"""``pbonet restore``: give machines back what a backup has."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated as A

from pbonet.cli import options
from pbonet.cli.parser import Argument

from . import shared_arguments as shared


def command(
    *,
    file: shared.Hosts,
    folder: A[Path, Argument("The folder that `backup` made.")],
    apply: shared.Apply = False,
    host: shared.Host = None,
    json_: options.Json = False,
) -> int:
    """Give machines back what a backup has, and have agents read it.

    The status is 1 if a machine failed.

    Examples:
        Print what would change:
        pbonet restore lab.toml backups/monday
        Restore one machine:
        pbonet restore lab.toml backups/monday --host arm-pc --apply
    """
    from pbonet import deploy

    hosts = deploy.read_hosts(file, host or ())
    reports = deploy.backup.restore(hosts, folder, apply=apply)
    text = deploy.host_reports.text(reports, planned=not apply)
    options.show(text, deploy.host_reports.data(reports), as_data=json_)
    return deploy.host_reports.status(reports)
