#!/bin/sh
# The first process of the User-Mode-Linux kernel: mounts what is needed, runs pytest, turns off.
# Arguments: the repository, those of pytest, `end-of-arguments`; the kernel adds some of its own.
# The host's files are there, read-only.
export PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin HOME=/dev/shm LC_ALL=C.UTF-8
mount -t proc proc /proc
mount -t sysfs sysfs /sys
mount -t configfs configfs /sys/kernel/config
[ -e /dev/null ] || mount -t devtmpfs devtmpfs /dev
mkdir -p /dev/shm /dev/pts
mount -t tmpfs tmpfs /dev/shm
mount -t devpts devpts /dev/pts
[ -e /dev/fd ] || ln -s /proc/self/fd /dev/fd
ip link set lo up 2>/dev/null
export TMPDIR=/dev/shm PYTHONDONTWRITEBYTECODE=1
cd "$1" || exit 1
shift
count=$#
for word; do
    [ "$word" != end-of-arguments ] || break
    set -- "$@" "$word"
done
shift $count
"${GPIO_PYTHON:-.venv/bin/python}" -m pytest -p no:cacheprovider -p no:xdist "$@"
echo "pytest-exit-code=$?"
# LINUX_REBOOT_CMD_POWER_OFF
exec "${GPIO_PYTHON:-.venv/bin/python}" -c 'import ctypes; ctypes.CDLL(None).reboot(0x4321FEDC)'
