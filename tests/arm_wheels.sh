#!/usr/bin/env bash
# arm_wheels.sh PYTHON: every pinned package of a vehicle and an office has a wheel for 64-bit ARM, for
# the Pythons of Raspberry Pi OS: 3.11 (bookworm) and 3.13 (trixie). Downloads them all, some 700 MB.
set -eu

python=$1
locks=$(dirname "${BASH_SOURCE[0]}")/../requirements
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
# glibc 2.28 is older than both: Debian 12 has 2.36.
platforms=(--platform manylinux_2_28_aarch64 --platform manylinux_2_17_aarch64 --platform manylinux2014_aarch64)

for version in 3.11 3.13; do
    for role in vehicle office; do
        into=$folder/$version-$role
        "$python" -m pip --disable-pip-version-check download --quiet --no-deps --require-hashes \
            --only-binary=:all: "${platforms[@]}" --implementation cp --python-version "$version" \
            --requirement "$locks/$role.txt" --dest "$into"
        echo "Python $version, $role: $(find "$into" -name '*.whl' | wc -l) wheels for aarch64"
    done
done
