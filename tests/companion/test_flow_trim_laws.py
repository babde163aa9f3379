"""What holds for the trim on every sprayer: it settles, it does not swing, it keeps its limits."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.options import flow_trim
from companion.core.options.flow_trim import FlowTrim
from companion.core.types import FlowReport
from tests.companion.trim_bench import TrimBench

# A meter's white noise of 1 % a PWM period, as on the twin, is this in a step of 50 ms.
NOISE = 0.01 * (1.0 / 11.0 / 0.05) ** 0.5
RIPPLE = 0.006


@settings(max_examples=25)
@given(
    gain=st.floats(0.8, 1.2),
    dead_s=st.floats(0.0, 0.5),
    wanted_l_min=st.floats(2.0, 6.0),
    tau_s=st.floats(3.0, 6.0),
    seed=st.integers(0, 1000),
)
def test_the_loop_settles_without_swinging(
    gain: float, dead_s: float, wanted_l_min: float, tau_s: float, seed: int
) -> None:
    bench = TrimBench(
        law=FlowTrim(tau_s=tau_s),
        gain=gain,
        dead_s=dead_s,  # the trim reckons with 0.16 s, whatever it is
        wanted_l_min=wanted_l_min,
        meter_noise=NOISE,
        seed=seed,
    )
    bench.run(4.0 + 7.0 * tau_s)
    end = min(max(gain, 0.85), 1.15)
    way = 1.0 if end >= 1.0 else -1.0
    assert abs(bench.trim - end) <= RIPPLE
    # No overshoot, and no way back but the meter's noise.
    assert all(way * (trim - end) <= RIPPLE for trim in bench.trims)
    best = 1.0
    for trim in bench.trims:
        best = max(best, trim, key=lambda value: way * value)
        assert way * (best - trim) <= RIPPLE


@settings(max_examples=20)
@given(
    counts=st.lists(
        st.tuples(
            st.floats(allow_nan=True, allow_infinity=True),
            st.floats(-1.0, 1.0),
            st.booleans(),
        ),
        max_size=60,
    ),
    limit=st.floats(0.01, 0.25),
)
def test_no_count_of_the_meter_brings_the_trim_out_of_its_limits(
    counts: list[tuple[float, float, bool]], limit: float
) -> None:
    bench = TrimBench(law=FlowTrim(limit=limit)).run(6.0)
    assert bench.trim != 1.0
    for volume_ml, late_s, is_steady in counts:
        report = FlowReport(received_s=bench.now_s + 0.05 - late_s, volume_ml=volume_ml)
        bench.step(report=report, is_steady=is_steady)
        bench.step()
        assert 1.0 - limit <= bench.trim <= 1.0 + limit


@settings(max_examples=20)
@given(
    drop=st.floats(0.15, 1.0),
    gain=st.floats(0.87, 1.13),
    phase=st.integers(0, 60),
    seed=st.integers(0, 1000),
)
def test_no_sudden_drop_is_compensated(drop: float, gain: float, phase: int, seed: int) -> None:
    bench = TrimBench(gain=gain, meter_noise=NOISE, seed=seed).run(30.0 + 0.05 * phase)
    trim = bench.trim
    assert abs(trim - gain) < 0.02
    bench.gain = gain * (1.0 - drop)
    bench.run(30.0)
    assert bench.state is flow_trim.FlowTrimState.SUDDEN_CHANGE
    assert abs(bench.trim - trim) < 0.01


@settings(max_examples=15)
@given(gain=st.floats(0.9, 1.1), shift_s=st.floats(-50.0, 1000.0))
def test_the_trim_does_not_depend_on_when_the_clock_began(gain: float, shift_s: float) -> None:
    here, there = TrimBench(gain=gain), TrimBench(gain=gain, begin_s=100.0 + shift_s)
    assert abs(here.run(10.0).trim - there.run(10.0).trim) < 1e-3


@settings(max_examples=15)
@given(gain=st.floats(0.9, 1.1), more_ml=st.floats(0.0, 1e6))
def test_only_differences_of_the_count_matter(gain: float, more_ml: float) -> None:
    here, there = TrimBench(gain=gain), TrimBench(gain=gain)
    there.metered_ml += more_ml
    assert abs(here.run(10.0).trim - there.run(10.0).trim) < 1e-3
