"""A pump that makes the flow, and on-off valves that divide it among sections of the boom."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sitl.meter import MeterStream, VolumeMeter
from sitl.plant import Faults, Floats, Plant
from sitl.profile import ML_S_PER_L_MIN, flow_table
from sitl.section_flow import SectionFlow

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from sitl.edges import Edge
    from sitl.profile import PlantProfile
    from sitl.supply import Supply


class SectionPlant(Plant):
    """Takes changes of duty or edges (above 0 is open), and orders of the pump.

    There are no pulses, so that both fidelities are the same.
    """

    def __init__(
        self,
        profile: PlantProfile,
        *,
        seed: int,
        perfect: bool = False,
        start_s: float = 0.0,
        faults: Faults | None = None,
    ) -> None:
        supply = profile.supply
        if supply is None or supply.control != "modulates":
            raise ValueError(f"the sprayer {profile.name} has no pump that feeds sections")
        if faults is not None and (faults.stuck_open or faults.stuck_closed):
            raise ValueError("valves that stick are not simulated behind a pump")
        super().__init__(profile, seed=seed, perfect=perfect, start_s=start_s)
        self._pump: Supply = supply
        self._pump_ml_s = flow_table(profile)
        scales = np.array(self._scatter.flow_scale)
        self._flow = SectionFlow(
            (scales / scales.sum()).tolist(),
            up_s=supply.up_s,
            down_s=supply.down_s,
            most_ml_s=supply.relief * profile.nozzle_sets[-1].flow_max_l_min * ML_S_PER_L_MIN,
            start_s=start_s,
            is_open=not supply.valves,
        )
        self._flows = (_Whole(self._flow),)
        self._heard_s = start_s
        self._fraction = 0.0
        # When each valve began to move last, and when it stands: none overtakes itself.
        self._began_s = [start_s] * profile.valve_count
        self._stands_s = [start_s] * profile.valve_count

    def _check_kind(self) -> None:
        """Refuse nothing more: the constructor has seen that there is a pump."""

    @property
    def flow(self) -> SectionFlow:
        """Return the flow itself: what the pump has given, too."""
        return self._flow

    def record_pump(self, at_s: float, pulse_us: float) -> None:
        """Take down that the pump is ordered so from `at_s` on."""
        fraction = self._pump.fraction(pulse_us)
        if fraction == self._fraction:
            return
        dead_s = self._pump.spin_up_s if self._fraction == 0.0 else self._pump.dead_s
        self._fraction = fraction
        self._heard_s = max(at_s + dead_s, self._heard_s)
        count = self.profile.valve_count
        self._flow.pump(self._heard_s, count * self._pump_ml_s.mean_ml_s(fraction, count))

    def record_change(self, at_s: float, valve: int, duty: float) -> None:
        """Take down that a valve is ordered to be open (above 0) or shut from `at_s` on."""
        if not 0.0 <= duty <= 1.0:
            raise ValueError(f"duty outside [0, 1]: {duty}")
        is_open = duty > 0.0
        self._duty[valve] = duty
        if is_open == self._is_open[valve] or not self._pump.valves:
            return
        self._is_open[valve] = is_open
        profile = self.profile
        dead_s = profile.dead_open_s if is_open else profile.dead_close_s
        ramp_s = profile.ramp_s if is_open else profile.closing_s
        begin_s = at_s + max(dead_s + self._scatter.shift_s[valve], 0.0)
        begin_s = max(begin_s, self._began_s[valve])
        # A valve that is still moving turns round from where it has come to.
        end_s = max(begin_s + ramp_s, self._stands_s[valve])
        self._began_s[valve], self._stands_s[valve] = begin_s, end_s
        self._flow.ramp(valve, begin_s, end_s - begin_s, is_open=is_open)

    def record(self, edges: Iterable[Edge]) -> None:
        """Take down edges."""
        for edge in edges:
            self.record_change(edge.at_s, edge.valve, 1.0 if edge.is_open else 0.0)

    def volume_ml(self, times_s: Floats) -> Floats:
        """Return (n, valves): what each section has delivered up to each time."""
        times_s = np.asarray(times_s, dtype=np.float64)
        if len(times_s) and not times_s.min() >= self._forgotten_s - 1e-9:
            raise ValueError(f"{times_s.min()} s was forgotten or lies before the start")
        return self._flow.volumes_ml(times_s)

    def meter_counter(self) -> Callable[[float], int]:
        """Return the meter to be read in passing."""
        return self.meter_stream().count

    def meter_stream(self) -> MeterStream:
        """Return the meter before the sections, behind the way back to the tank."""
        return VolumeMeter(self._flow, self._metering())


class _Whole:
    """All sections together, as the base class keeps flows."""

    def __init__(self, flow: SectionFlow) -> None:
        self._flow = flow

    def volume_ml(self, times_s: Floats) -> Floats:
        result: Floats = self._flow.volumes_ml(times_s).sum(axis=1)
        return result

    def forget(self, before_s: float) -> None:
        self._flow.forget(before_s)
