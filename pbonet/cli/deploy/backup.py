"""``pbonet backup``: copies of what machines are configured by."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated as A

from pbonet.cli import options
from pbonet.cli.parser import Argument

from . import shared_arguments as shared


def command(
    *,
    file: shared.Hosts,
    folder: A[Path, Argument("A new folder.")],
    host: shared.Host = None,
    json_: options.Json = False,
) -> int:
    """Copy configurations of machines: agents, units, certificates, jobs.

    Private keys are not copied. The status is 1 if a machine failed.

    Examples:
        Copy all machines:
        pbonet backup lab.toml backups/monday
        Copy one:
        pbonet backup lab.toml backups/arm --host arm-pc
    """
    from pbonet import deploy

    hosts = deploy.read_hosts(file, host or ())
    reports = deploy.backup.save(hosts, folder)
    options.show(
        deploy.host_reports.text(reports),
        deploy.host_reports.data(reports),
        as_data=json_,
    )
    return deploy.host_reports.status(reports)
