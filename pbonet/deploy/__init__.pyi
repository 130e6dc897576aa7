from . import (
    backup as backup,
    deploying as deploying,
    report as report,
    rolling_upgrade as rolling_upgrade,
    steps as steps,
)
from .hosts_file import HostsFile as HostsFile, read_hosts as read_hosts
from .release import Release as Release, built as built, release_of as release_of
