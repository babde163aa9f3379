"""All tests: `python -m tests.whole MAKE`, which is `make test`.

Flights in real time mostly wait: four at once take a quarter of a core, but want it the moment they
ask. So what computes runs beside them, nicer than they, and takes what they leave.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile


def main() -> int:
    """Run both halves, show the flights' output after the other, and return whether any failed."""
    make = [sys.argv[1], "--no-print-directory"]
    with tempfile.TemporaryFile() as told:
        # In a session of their own: Ctrl-C comes to them from here, and once.
        flights = subprocess.Popen(
            [*make, "test-flights"], stdout=told, stderr=told, start_new_session=True
        )
        try:
            computed = subprocess.call(["nice", "-n", "9", *make, "test-computing"])
            flown = flights.wait()
        except KeyboardInterrupt:
            os.killpg(flights.pid, signal.SIGINT)
            flights.wait()
            return 130
        told.seek(0)
        sys.stdout.buffer.write(told.read())
    return computed or flown


if __name__ == "__main__":
    sys.exit(main())
