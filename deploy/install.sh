#!/bin/sh
# Install vrspray on the companion computer of an aircraft, from a wheel:
#
#   sudo sh install.sh vrspray-0.1.0-py3-none-any.whl       install, or replace an earlier version
#   sh install.sh --dry-run vrspray-0.1.0-py3-none-any.whl  print every command, do nothing
#   sudo sh install.sh --uninstall                          take the program away again
#
# What it does, and no more:
#   a user `vrspray` without a password, in the groups of serial lines, GPIO lines and I2C buses
#   a virtual environment in /opt/vrspray with the wheel and its extra `vehicle`; with a file
#     vehicle.txt beside the wheel (requirements/vehicle.txt) exactly those versions, by their hashes
#   a link /usr/local/bin/vrspray
#   /etc/vrspray, for configuration, journals and state
#   a udev rule that gives the group gpio the GPIO chips, where the system has none
# It writes no configuration, starts nothing, and opens no valve. It removes no journal.
set -eu

# DESTDIR: a folder that stands for the root, to try this script in.
VENV=${DESTDIR:-}/opt/vrspray LINK=${DESTDIR:-}/usr/local/bin/vrspray HOME_DIR=${DESTDIR:-}/etc/vrspray
RULE=${DESTDIR:-}/etc/udev/rules.d/60-vrspray-gpio.rules
GROUPS_WANTED="dialout gpio i2c"

refuse() {
    echo "error: $*" >&2
    exit 2
}
run() {
    echo "+ $*"
    [ "$dry" = yes ] || "$@"
}

dry=no wheel='' remove=no
for word in "$@"; do
    case $word in
        --dry-run) dry=yes ;;
        --uninstall) remove=yes ;;
        -*) refuse "$word: no such option; see the head of this file" ;;
        *) wheel=$word ;;
    esac
done

[ "$dry" = yes ] || [ "$(id -u)" = 0 ] || refuse "needs root; put sudo before it, or give --dry-run"

if [ "$remove" = yes ]; then
    [ ! -x "$VENV/bin/vrspray" ] || run "$VENV/bin/vrspray" service uninstall ||
        echo "note: no service was removed" >&2
    run rm -rf "$VENV"
    run rm -f "$LINK" "$RULE"
    echo "Removed. $HOME_DIR with configuration and journals, and the user vrspray, are left."
    exit 0
fi

[ -n "$wheel" ] || refuse "which wheel? sudo sh install.sh vrspray-0.1.0-py3-none-any.whl"
[ -f "$wheel" ] || refuse "$wheel: no such file; make it with: make wheel"
[ "$(uname -s)" = Linux ] || refuse "needs Linux"
[ "$(getconf LONG_BIT)" = 64 ] ||
    refuse "this is a 32-bit system; install the 64-bit Raspberry Pi OS (uname -m: aarch64)"
python3 -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null ||
    refuse "needs Python 3.11 or newer, as in Debian 12 (bookworm)"
python3 -c 'import ensurepip' 2>/dev/null || refuse "needs venv: sudo apt install python3-venv"
wheel=$(cd "$(dirname "$wheel")" && pwd)/$(basename "$wheel")
locks=$(dirname "$wheel")/vehicle.txt

if ! getent group gpio >/dev/null; then
    run groupadd --system gpio
    if [ "$dry" = no ]; then
        echo 'SUBSYSTEM=="gpio", KERNEL=="gpiochip*", GROUP="gpio", MODE="0660"' >"$RULE"
        udevadm control --reload && udevadm trigger --subsystem-match=gpio || true
    else
        echo "+ write $RULE"
    fi
fi
if ! getent passwd vrspray >/dev/null; then
    run useradd --system --home-dir "$HOME_DIR" --shell /usr/sbin/nologin vrspray
fi
for group in $GROUPS_WANTED; do
    ! getent group "$group" >/dev/null || run usermod --append --groups "$group" vrspray
done
run install --directory --owner vrspray --group vrspray "$HOME_DIR"

# What was there stays until pip has everything at hand.
[ -x "$VENV/bin/python" ] || run python3 -m venv "$VENV"
if [ -f "$locks" ]; then
    run "$VENV/bin/pip" install --quiet --require-hashes --requirement "$locks"
    run "$VENV/bin/pip" install --quiet --no-deps --force-reinstall "$wheel"
else
    run "$VENV/bin/pip" install --quiet "${wheel}[vehicle]"
    run "$VENV/bin/pip" install --quiet --no-deps --force-reinstall "$wheel"
fi
run ln -sf "$VENV/bin/vrspray" "$LINK"
run "$LINK" --version

[ "$dry" = yes ] && done_='Nothing was changed. After the installation' || done_='Installed. Next'
cat <<END

$done_, each by hand:
  1. write $HOME_DIR/config.toml      (docs: Configure; examples: vrspray examples copy profiles)
  2. vrspray config check $HOME_DIR/config.toml
  3. sudo -u vrspray vrspray doctor --config $HOME_DIR/config.toml
  4. sudo vrspray service install --run-as vrspray
END
