"""How long each export of a journal takes, and how large it is.

python -m tests.bench.exports flights/flight-0001.gpkg
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from analysis.exports.cli import FORMATS, Format
from analysis.exports.source import Shape, Source
from analysis.flown.read_applied import read_applied


def main(path: Path) -> None:
    """Print a line for reading, and one for each format and geometry."""
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    flight = read_applied(path)
    wall_s, cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s
    say(f"flight of {flight.duration_s:.0f} s, {len(flight.changes.valve)} changes of valves")
    say(f"{'reading':12} {'':8} {wall_s:6.2f} s wall {cpu_s:6.2f} s processor")
    for form in FORMATS:
        for shape in form.shapes:
            form.maker()
            source = Source(flight=flight, shape=shape)
            wall_s, cpu_s = time.perf_counter(), time.process_time()
            size = size_of(form, source)
            wall_s, cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s
            say(line(form, shape, source, size=size, wall_s=wall_s, cpu_s=cpu_s))


def say(text: str) -> None:
    """Print a line at once."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def size_of(form: Format, source: Source) -> int:
    """Return the bytes of an export that is made and thrown away."""
    out = Path("x" + (*form.suffixes, *form.also)[-1])
    content = form.maker()(source, out)
    return sum(len(chunk) for chunks in content.values() for chunk in chunks)


def line(
    form: Format, shape: Shape, source: Source, *, size: int, wall_s: float, cpu_s: float
) -> str:
    """Return the figures of one export."""
    return (
        f"{form.name:12} {shape:8} {wall_s:6.2f} s wall {cpu_s:6.2f} s processor "
        f"{size / 1e6:6.2f} MB {source.rows:7} rows"
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
