#!/bin/sh
# `make test-gpio`: the tests on gpio-sim, on this computer's kernel where it has it and we are
# root, else in a User-Mode-Linux kernel. Where neither is to be had it says why, and is no failure.
# Arguments go to pytest.
set -eu
here=$(dirname "$(readlink -f "$0")")
root=$(readlink -f "$here/../..")
cd "$root"
python=$root/.venv/bin/python

skip() { echo "make test-gpio: skipped: $1"; exit 0; }

"$python" -c 'import gpiod' 2>/dev/null || skip "the package gpiod is missing: pip install 'vrspray[vehicle]'"
if [ "$(id -u)" = 0 ]; then
    modprobe gpio-sim 2>/dev/null || true
    mountpoint -q /sys/kernel/config || mount -t configfs configfs /sys/kernel/config 2>/dev/null || true
fi
if [ -d /sys/kernel/config/gpio-sim ] && [ "$(id -u)" = 0 ]; then
    echo "gpio-sim of $(uname -sr)"
    exec "$python" -m pytest tests/gpio "$@"
fi

kernel=$("$here/kernel.sh") && state=0 || state=$?
[ $state != 77 ] || skip "this kernel has no gpio-sim, and no other one can be built here (see above)"
[ $state = 0 ] || exit 1
echo "gpio-sim of User-Mode-Linux $("$kernel" --version)"
# A kernel's command line parts its words at spaces, but for those in quotes.
count=$#
for word; do set -- "$@" "\"$word\""; done
shift $count
# The console is its standard output; the files of this computer are its own, read-only.
out=$(mktemp)
trap 'rm -f "$out"' EXIT
timeout --kill-after 10 "${GPIO_TIMEOUT_S:-1800}" "$kernel" mem=512M quiet panic=-1 \
    root=98:0 rootfstype=hostfs rootflags=/ ro con0=null,fd:1 con=null init="$here/inside.sh" \
    -- "$root" tests/gpio "$@" end-of-arguments </dev/null | tee "$out" || true
grep -q '^pytest-exit-code=0' "$out" || { echo "make test-gpio: failed" >&2; exit 1; }
