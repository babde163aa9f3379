#!/bin/sh
# Builds a User-Mode-Linux kernel with gpio-sim from Debian's linux-source package, once, and says
# where it is. It is an ordinary program of 3 to 4 MB: no root, no virtual machine, no module.
# Ends with 77 and a reason where it cannot be built. VRSPRAY_UML names a kernel to take instead.
set -eu
here=$(dirname "$(readlink -f "$0")")
cache=${XDG_CACHE_HOME:-$HOME/.cache}/vrspray-uml

cannot() { echo "$*" >&2; exit 77; }

if [ -n "${VRSPRAY_UML:-}" ]; then
    [ -x "$VRSPRAY_UML" ] || cannot "VRSPRAY_UML names no program: $VRSPRAY_UML"
    echo "$VRSPRAY_UML"
    exit
fi
# Built anew when the configuration or this script changes.
kernel=$cache/linux-$(cat "$here/kernel.config" "$here/kernel.sh" | cksum | cut -d ' ' -f 1)
if [ -x "$kernel" ]; then
    echo "$kernel"
    exit
fi

case $(uname -m) in x86_64) ;; *) cannot "User-Mode-Linux is for x86 only; a kernel with gpio-sim does as well" ;; esac
for tool in apt-get dpkg-deb gcc make flex bison bc xz; do
    command -v $tool >/dev/null || cannot "$tool is missing: apt-get install gcc make flex bison bc xz-utils (on Debian)"
done
package=$(apt-cache depends linux-source 2>/dev/null | awk '/Depends: linux-source-/ {print $2; exit}')
[ -n "$package" ] || cannot "no package linux-source: apt-get update first"

work=$(mktemp -d "${TMPDIR:-/tmp}/vrspray-uml.XXXXXX")
trap 'rm -rf "$work"' EXIT
trap 'exit 1' INT TERM
mkdir -p "$cache"
cd "$work"
echo "Fetching $package (140 MB) ..." >&2
apt-get --quiet --quiet download "$package" >&2 || cannot "$package cannot be fetched"
dpkg-deb --extract "$package"_*.deb package
rm "$package"_*.deb
mkdir source
tar --extract --file "$(echo package/usr/src/linux-source-*.tar.*)" --directory source --strip-components 1
rm -r package
cd source
# 64 interrupts are all taken: without more, a request for edge events ends with ENXIO.
sed -i '/^#define NR_IRQS/s/UM_LAST_SIGNAL_IRQ$/256/' arch/um/include/asm/irq.h
grep -q '^#define NR_IRQS[[:space:]]*256$' arch/um/include/asm/irq.h \
    || cannot "arch/um/include/asm/irq.h of $package is another one than that of Linux 6.1"
make -s ARCH=um KCONFIG_ALLCONFIG="$here/kernel.config" allnoconfig >&2
for option in $(grep ^CONFIG_ "$here/kernel.config"); do
    grep -qx "$option" .config || cannot "$package does not know $option"
done
echo "Building the kernel, once (10 minutes or more) ..." >&2
nice -n 5 make -s -j "${JOBS:-2}" ARCH=um linux >"$cache/build.log" 2>&1 \
    || cannot "the kernel could not be built, see $cache/build.log"
strip linux
mv linux "$kernel"
echo "$kernel"
