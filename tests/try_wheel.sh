#!/usr/bin/env bash
# try_wheel.sh PYTHON WHEEL [ROLE]: install the wheel into an empty environment with the pinned versions
# of a role (vehicle, by default, or office), and use it in an empty folder.
set -eu

python=$(cd "$(dirname "$1")" && pwd)/$(basename "$1")
wheel=$(realpath "$2") role=${3:-vehicle}
locks=$(cd "$(dirname "${BASH_SOURCE[0]}")/../requirements" && pwd)

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
unset PYTHONPATH

"$python" -m venv "$folder/env"
PATH="$folder/env/bin:$PATH"
pip="python -m pip --disable-pip-version-check --quiet"
$pip install --require-hashes --requirement "$locks/$role.txt"
$pip install --no-deps "$wheel"

mkdir "$folder/empty"
cd "$folder/empty"
say() { echo "--- $*" >&2; "$@"; }
say vrspray --version
vrspray --help >help.txt
say vrspray demo --speed 5 --fidelity averaged >demo.txt
test -s demo-out/flight-0001.gpkg
say vrspray replay demo-out/flight-0001.gpkg
say vrspray examples copy anyang
say vrspray config check examples/anyang/config.toml
say vrspray sitl fly --config examples/anyang/config.toml --mission examples/anyang/mission.waypoints
# Nobody comes: the stub has its field and its sprayer, says so, and ends with 1.
say vrspray sitl serve --link udpout:127.0.0.1:9 --wait-s 0.1 && exit 1
if [ "$role" = office ]; then
    say vrspray report demo-out/flight-0001.gpkg --out report || [ $? = 1 ]
    test -s report/report.html
fi
echo "The wheel works outside the source tree."
