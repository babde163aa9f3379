"""All that is constant in a flight, checked once; what follows from it is worked out here."""

from __future__ import annotations

from dataclasses import dataclass, field

from companion.core.boom import Boom
from companion.core.crossings import ROUTES_KEPT_S, Across, Border
from companion.core.frame import LocalFrame
from companion.core.inputs import AutopilotLiquid
from companion.core.nozzle import NozzleSet, Sprayer
from companion.core.options.atomisers import Atomiser
from companion.core.options.coverage import Coverage
from companion.core.options.drift import Drift
from companion.core.options.flow_meter import Detection, Watching
from companion.core.options.flow_trim import FlowTrim, Trimming
from companion.core.options.lines import Lines
from companion.core.options.overlap import OverlapGuard
from companion.core.options.pump import Pump, Pumping
from companion.core.options.treated_area import Lags, TreatedAreaSettings
from companion.core.prescription import Prescription
from companion.core.safety import Limits
from companion.core.schedule import LagModel, Timing
from companion.core.standing import MOST_M_S2
from companion.core.types import Method, PwmLimits


@dataclass(frozen=True, slots=True, kw_only=True)
class Setup:
    """All that is constant in a flight."""

    frame: LocalFrame
    prescription: Prescription
    boom: Boom
    nozzle_sets: tuple[NozzleSet, ...]
    pwm: PwmLimits
    lag: LagModel
    method: Method
    look_ahead_s: float
    limits: Limits
    border: Border = "inside"
    border_buffer_m: float = 0.1
    across: Across = "centre"
    lease_s: float = 0.3
    flow_trim: FlowTrim | None = None
    detection: Detection | None = None
    autopilot_liquid: AutopilotLiquid | None = None
    drift: Drift | None = None
    rate_max_l_ha: float | None = None
    mission_braking_m_s2: float | None = None  # None: what the mission says is not used
    pump: Pump | None = None
    atomisers: tuple[Atomiser, ...] = ()
    lines: Lines | None = None  # None: sprayed wherever the map has a rate
    record_coverage: bool = False
    overlap: OverlapGuard | None = None  # None: treated ground is sprayed again
    # What earlier flights treated; not compared by hash: tiles are a mapping.
    treated: Coverage | None = field(default=None, repr=False, hash=False)
    # The output opens a valve with a new period, the pulse in its middle: our own engine does.
    centres_pulses: bool = False
    most_m_s2: float = MOST_M_S2  # the vehicle's acceleration
    # Where nothing may fall outside, whatever was foretold: `standing.py`.
    guarded: Prescription | None = field(init=False, repr=False, compare=False)
    timing: Timing = field(init=False, repr=False, compare=False)
    timings: tuple[Timing, ...] = field(init=False, repr=False, compare=False)  # of each valve
    # The longest lead of any order: of valves, pump and atomisers.
    longest_s: float = field(init=False, repr=False, compare=False)
    # All leads of orders, in order: a path in a turn is exact there.
    leads_s: tuple[float, ...] = field(init=False, repr=False, compare=False)
    # Within this, what is ordered now has its first or last flow.
    flows_s: float = field(init=False, repr=False, compare=False)
    # How far behind a path begins, so that short stays are seen whole.
    back_s: float = field(init=False, repr=False, compare=False)
    # How far ahead a path must reach: the lease, the longest lead and a short stay.
    ahead_s: float = field(init=False, repr=False, compare=False)
    pumping: Pumping | None = field(init=False, repr=False, compare=False)
    trimming: Trimming | None = field(init=False, repr=False, compare=False)
    watching: Watching | None = field(init=False, repr=False, compare=False)
    recording: TreatedAreaSettings | None = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not 0.05 <= self.lease_s <= 5.0:
            raise ValueError(f"lease_s must lie in [0.05, 5] s, got {self.lease_s}")
        if not 0.0 <= self.look_ahead_s <= 30.0:
            raise ValueError(f"look_ahead_s must lie in [0, 30] s, got {self.look_ahead_s}")
        if not 0.0 <= self.border_buffer_m <= 100.0:
            raise ValueError(f"border_buffer_m must lie in [0, 100] m, got {self.border_buffer_m}")
        braking_m_s2 = self.mission_braking_m_s2
        if braking_m_s2 is not None and not 0.1 <= braking_m_s2 <= 20.0:
            raise ValueError(f"mission_braking_m_s2 must lie in [0.1, 20], got {braking_m_s2}")
        if not 0.0 < self.most_m_s2 <= 20.0:
            raise ValueError(f"most_m_s2 must lie in (0, 20], got {self.most_m_s2}")
        if not self.nozzle_sets:
            raise ValueError("at least one nozzle set is needed")
        count = len(self.boom.valves)
        if any(valve >= count for nozzles in self.nozzle_sets for valve in nozzles.valves):
            raise ValueError("a nozzle set names a valve that the boom does not have")
        object.__setattr__(self, "guarded", self._guarded())
        object.__setattr__(self, "timing", self._timing(self.lag))
        timings = tuple(self._timing(self.lag.of_valve(valve)) for valve in self.boom.valves)
        object.__setattr__(self, "timings", timings)
        object.__setattr__(self, "pumping", self._pumping())
        stays_s = 2.0 * max(timing.dwell_min_s for timing in timings)
        object.__setattr__(self, "leads_s", self._leads_s())
        object.__setattr__(self, "longest_s", self.leads_s[-1])
        flows_s = [max(timing.border_on_s, timing.border_off_s) for timing in timings]
        if self.pumping is not None:
            pump = self.pumping.timing
            flows_s += [pump.border_on_s, pump.border_off_s]
        object.__setattr__(self, "flows_s", self.lease_s + max(flows_s))
        object.__setattr__(self, "back_s", 0.1 + stays_s)
        ahead_s = self.lease_s + (self.longest_s + stays_s) + ROUTES_KEPT_S + 0.05
        object.__setattr__(self, "ahead_s", ahead_s)
        law, doses = self.flow_trim, self.doses
        trimming = None if law is None else Trimming.of(law, doses.lag, doses.pwm)
        object.__setattr__(self, "trimming", trimming)
        watching = None
        if self.detection is not None:
            # What a step needs is loaded now: in flight nothing is.
            from companion.core.options import liquid_faults  # noqa: F401

            watching = Watching.of(self.detection, doses.nozzle_sets, doses.lag, doses.pwm)
        object.__setattr__(self, "watching", watching)
        object.__setattr__(self, "recording", self._recording() if self.records_coverage else None)

    def _guarded(self) -> Prescription | None:
        """Return the field; where its border is judged by volume, the ground without its holes."""
        if self.method is not Method.SCHEDULED:
            return None
        return self.prescription if self.border == "inside" else self.prescription.without_border

    def _timing(self, lag: LagModel) -> Timing:
        return Timing.of(
            self.method,
            lag,
            look_ahead_s=self.look_ahead_s,
            period_s=self.pwm.period_s,
            centred=self.pwm if self.centres_pulses else None,
        )

    def _recording(self) -> TreatedAreaSettings:
        return TreatedAreaSettings(
            boom=self.boom,
            lags=Lags(valve=self.lag, flow=self.doses.lag),
            is_pumped=self.pumping is not None,
            treated=self.treated,
        )

    def _pumping(self) -> Pumping | None:
        if self.pump is None:
            return None
        if self.pump.curve is not None and len(self.nozzle_sets) > 1:
            raise ValueError("a pump that makes the flow has one nozzle set")
        return Pumping.of(
            self.pump,
            self.boom,
            method=self.method,
            look_ahead_s=self.look_ahead_s,
            valve_timing=self.timing,
            rate_max_l_ha=self.rate_max_l_ha,
        )

    @property
    def records_coverage(self) -> bool:
        """Return whether it is kept which ground was treated: a guard needs it too."""
        return self.record_coverage or self.overlap is not None

    @property
    def doses(self) -> Sprayer:
        """Return what makes the flow: the valves, or the pump in their place."""
        return self if self.pumping is None else self.pumping

    def _leads_s(self) -> tuple[float, ...]:
        leads = {lead_s for timing in self.timings for lead_s in timing.leads_s}
        if self.pumping is not None:
            leads.update(self.pumping.timing.leads_s)
        leads.update(atomiser.spin_up_s + self.lag.output_s for atomiser in self.atomisers)
        return tuple(sorted(leads))
