# Installs a release beside others, and marks it as complete; run on a machine, as root.
# It is sent over ssh to `flock LOCK sh -s -- FOLDER INCOMING COMPLETE PYTHON PIP...`.
# Whoever holds the lock installs alone, so that two operators do not remove each other's
# files; who gets it later finds a release that is complete, or makes it anew.
folder=$1 incoming=$2 complete=$3 python=$4
shift 4
end() {
  status=$?
  if [ "$status" -ne 0 ]; then # half a release would keep the disk full
    rm -rf "$folder"
  fi
  rm -rf "$incoming"
  exit "$status"
}
failed() { # venv does not say that the disk is full; mkdir, pip and touch do
  free=$(df --output=avail -k "$folder" | tail -n 1)
  if [ "$free" -lt 1024 ]; then
    echo "No space left on device: $folder" >&2
  fi
  exit 1
}
trap end EXIT
if [ -e "$folder/$complete" ]; then
  exit 0
fi
rm -rf "$folder"
mkdir -p "$folder" || exit 1
"$python" -m venv "$folder" < /dev/null || failed
"$folder/bin/python" -m pip install --quiet --disable-pip-version-check --no-cache-dir \
  "$@" < /dev/null || exit 1
"$folder/bin/pbonet" --version < /dev/null > /dev/null || exit 1
touch "$folder/$complete" || exit 1
