from __future__ import annotations

import math
import time

import pytest

from sitl.workers import do_all


@pytest.mark.parametrize("processes", [1, 2])
def test_results_come_in_the_order_of_the_work(processes: int) -> None:
    told: list[None] = []
    found = do_all(
        math.sqrt, [9.0, 4.0, 1.0], processes=processes, on_done=lambda: told.append(None)
    )
    assert found == [3.0, 2.0, 1.0]
    assert len(told) == 3


@pytest.mark.parametrize("processes", [1, 2])
def test_error_of_one_piece_of_work_is_ours(processes: int) -> None:
    with pytest.raises(ValueError, match="math domain error"):
        do_all(math.sqrt, [4.0, -1.0], processes=processes)


def test_interrupt_ends_the_processes_at_once_whatever_they_are_at() -> None:
    def interrupt() -> None:
        raise KeyboardInterrupt

    began_s = time.monotonic()
    # That no process is left behind, every test makes sure of.
    with pytest.raises(KeyboardInterrupt):
        do_all(time.sleep, [0.0, 60.0, 60.0], processes=2, on_done=interrupt)
    assert time.monotonic() - began_s < 30.0
