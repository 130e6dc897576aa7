from . import (
    backup as backup,
    host_reports as host_reports,
    rolling_upgrade as rolling_upgrade,
    set_up_hosts as set_up_hosts,
    steps as steps,
)
from .hosts_file import HostsFile as HostsFile, read_hosts as read_hosts
from .release import Release as Release, built as built, releases_of as releases_of
