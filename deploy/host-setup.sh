#!/usr/bin/env bash
# Make this machine one that runs pbonet agents as services. Read it: it is short.
#
#   deploy/host-setup.sh                  says what it would do, and does nothing
#   sudo deploy/host-setup.sh --apply     does it
#   sudo deploy/host-setup.sh --remove    takes it back; /etc/pbonet stays
#
# RTPUs follow as words: `--apply arm0 arm1` also enables their agents. A file that stands
# is never written over; what changes is copied from this folder, so that a second run
# after an update brings the machine up to date.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
top=$(dirname "$here")
mode=--show
case "${1:-}" in --apply | --remove | --show) mode=$1 && shift ;; esac
rtpus=("$@")

die() { printf 'host-setup: %s\n' "$*" >&2; exit 2; }
step() { printf '\n# %s\n' "$*"; }
run() {
  printf '  %s\n' "$*"
  if [ "$mode" != --show ]; then "$@"; fi
}
# A machine that was started by something else than systemd (a container, a chroot) takes
# the files all the same; its services begin when systemd next starts it.
service() { if [ -d /run/systemd/system ]; then run systemctl "$@"; fi }

for rtpu in ${rtpus[@]+"${rtpus[@]}"}; do
  [[ $rtpu =~ ^[A-Za-z_][A-Za-z0-9_-]{0,30}$ ]] || die "'$rtpu' is no name of an RTPU: a letter or _ first, then letters, digits, _ and -"
done
if [ "$mode" != --show ] && [ "$(id -u)" != 0 ]; then die "$mode needs root: sudo $0 $mode"; fi
command -v systemctl >/dev/null || die "this machine has no systemd; docs/deployment.md says what an agent needs"

units=/etc/systemd/system
if [ "$mode" = --remove ]; then
  step "stop the agents; each turns its tasks off first"
  service stop 'pbonet-agent@*'
  service disable pbonet-agent@.service
  step "remove what --apply has put there"
  run rm -f "$units/pbonet-agent@.service" /etc/sysusers.d/pbonet.conf \
    /etc/tmpfiles.d/pbonet.conf /etc/security/limits.d/pbonet.conf
  run rm -rf /opt/pbonet /run/pbonet
  service daemon-reload
  exit 0
fi

step "a user for the agents, and a runtime folder that they share"
run install -D -m 0644 "$here/systemd/pbonet.sysusers" /etc/sysusers.d/pbonet.conf
run systemd-sysusers pbonet.conf
run install -D -m 0644 "$here/systemd/pbonet.tmpfiles" /etc/tmpfiles.d/pbonet.conf
run systemd-tmpfiles --create pbonet.conf

step "pbonet itself, in a place of its own"
if [ ! -x /opt/pbonet/bin/python ]; then run python3 -m venv /opt/pbonet; fi
source=$(mktemp -d) # built in a copy: nothing of root's stays in the checkout
trap 'rm -rf "$source"' EXIT
run cp -r "$top/pyproject.toml" "$top/README.md" "$top/pbonet" "$source"
run /opt/pbonet/bin/python -m pip install --quiet --upgrade "${source}[robot,devices,files]"

step "real time for people: members of the group pbonet who log in may start agents by hand"
run install -D -m 0644 "$here/limits.conf" /etc/security/limits.d/pbonet.conf

step "the service"
run install -D -m 0644 "$here/systemd/pbonet-agent@.service" "$units/pbonet-agent@.service"
run install -d -m 0755 /etc/pbonet
service daemon-reload

for rtpu in ${rtpus[@]+"${rtpus[@]}"}; do
  step "the agent of RTPU $rtpu"
  if [ ! -e "/etc/pbonet/$rtpu.toml" ]; then
    run install -m 0644 "$here/agent.toml" "/etc/pbonet/$rtpu.toml"
  fi
  service enable --now "pbonet-agent@$rtpu"
done

cat <<'END'

# For people to decide, since it concerns the whole machine (docs/deployment.md):
#   isolcpus=K nohz_full=K rcu_nocbs=K on the kernel's command line keeps a core for an RTPU
#   the governor `performance` keeps a core from changing its speed
# Then ask: PBONET_RUN_DIR=/run/pbonet pbonet doctor
END
if [ "$mode" = --show ]; then printf '\nNothing was done. Do it with: sudo %s --apply\n' "$0"; fi
