#!/usr/bin/env bash
# Make this machine one that runs pbonet agents as services. Read it: it is short.
#
#   deploy/host-setup.sh                  says what it would do, and does nothing
#   sudo deploy/host-setup.sh --apply     does it
#   sudo deploy/host-setup.sh --remove    takes it back; /etc/pbonet stays
#
# RTPUs follow as words: `--apply arm0=3 arm1` also enables their agents, arm0 on core 3.
# One without a core gets a core that the kernel keeps free (isolcpus), if there is one
# left. A configuration that stands is never written over; what changes is copied from this
# folder, so that a second run after an update brings the machine up to date.
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

# What stands in a file of the kernel such as 0,2-3, as lines.
cores() {
  local part
  for part in $(tr , ' ' <"/sys/devices/system/cpu/$1" || true); do seq "${part%-*}" "${part#*-}"; done
}
among() { grep -qx "$1" <<<"$2"; }
# What comes in is put into the file $1.
put() {
  local text
  text=$(cat)
  printf '  %s:\n' "$1"
  printf '    %s\n' "${text//$'\n'/$'\n'    }"
  if [ "$mode" != --show ]; then
    mkdir -p "$(dirname "$1")"
    printf '%s\n' "$text" >"$1"
    chmod 0644 "$1"
  fi
}

# The core that configurations name.
said() { sed -n 's/^core *= *\([0-9]*\).*/\1/p' "$@" 2>/dev/null || true; }

units=/etc/systemd/system etc=/etc/pbonet
online=$(cores online) isolated=$(cores isolated)
declare -A core=() # what is each RTPU's own: as told, as its configuration says, or one that is free
for word in ${rtpus[@]+"${rtpus[@]}"}; do
  rtpu=${word%%=*}
  [[ $rtpu =~ ^[A-Za-z_][A-Za-z0-9_-]{0,30}$ ]] || die "'$rtpu' is no name of an RTPU: a letter or _ first, then letters, digits, _ and -"
  core[$rtpu]=$(said "$etc/$rtpu.toml")
  if [ "$rtpu" = "$word" ]; then continue; fi
  told=${word#*=}
  among "$told" "$online" || die "'$word': this machine has the cores ${online//$'\n'/ }"
  [ "${core[$rtpu]:-$told}" = "$told" ] || die "'$word': $etc/$rtpu.toml says core = ${core[$rtpu]}; change it there, or leave =$told away"
  core[$rtpu]=$told
done
rtpus=(${rtpus[@]+"${rtpus[@]%%=*}"})
for rtpu in ${rtpus[@]+"${rtpus[@]}"}; do
  if [ -n "${core[$rtpu]}" ] || [ -e "$etc/$rtpu.toml" ]; then continue; fi
  taken=$(said "$etc"/*.toml; printf '%s\n' "${core[@]}")
  core[$rtpu]=$(grep -vxF "$taken" <<<"$isolated" | head -n 1 || true)
done
taken=$(said "$etc"/*.toml; printf '%s\n' "$isolated" ${core[@]+"${core[@]}"})
others=$(grep -vxF "$taken" <<<"$online" || true)
if [ "$mode" != --show ] && [ "$(id -u)" != 0 ]; then die "$mode needs root: sudo $0 $mode"; fi
if [ "$mode" = --apply ] && [ -L /opt/pbonet ]; then die "'pbonet deploy' has set this machine up; use it again (docs/operations.md)"; fi
command -v systemctl >/dev/null || die "this machine has no systemd; docs/deployment.md says what an agent needs"

if [ "$mode" = --remove ]; then
  step "stop the agents; each turns its tasks off first"
  service stop 'pbonet-agent@*'
  service disable pbonet-agent@.service
  step "remove what --apply has put there"
  run rm -f "$units/pbonet-agent@.service" /etc/sysusers.d/pbonet.conf \
    /etc/tmpfiles.d/pbonet.conf /etc/security/limits.d/pbonet.conf
  run rm -rf /opt/pbonet /opt/pbonet-releases /run/pbonet "$units"/pbonet-agent@*.service.d
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
run /opt/pbonet/bin/python -m pip install --quiet --upgrade "${source}[robot,trajectory,devices,files]"

step "real time for people: members of the group pbonet who log in may start agents by hand"
run install -D -m 0644 "$here/limits.conf" /etc/security/limits.d/pbonet.conf

step "the service"
run install -D -m 0644 "$here/systemd/pbonet-agent@.service" "$units/pbonet-agent@.service"
run install -d -m 0755 "$etc"
service daemon-reload

for rtpu in ${rtpus[@]+"${rtpus[@]}"}; do
  step "the agent of RTPU $rtpu"
  own=${core[$rtpu]}
  if [ ! -e "$etc/$rtpu.toml" ]; then
    sed "${own:+s/^# core = .*/core = $own/}" "$here/agent.toml" | put "$etc/$rtpu.toml"
  elif [ -n "$own" ] && [ -z "$(said "$etc/$rtpu.toml")" ]; then
    printf '  # write this into %s: core = %s\n' "$etc/$rtpu.toml" "$own"
  fi
  if [ -n "$own" ] && [ -n "$others" ]; then # else it may use them all
    put "$units/pbonet-agent@$rtpu.service.d/cores.conf" <<END
# Core $own is the RTPU's own; the others are for its agent and all that is not real time.
[Service]
CPUAffinity=${others//$'\n'/ } $own
END
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
