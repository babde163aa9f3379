"""Whether the vehicle at the other end is simulated: what it is asked, and what its answers mean.

An inertial sensor's device number says in its lowest three bits which bus it hangs on. Autopilots
of both makers keep the bus 4 for sensors that are simulated (ArduPilot `AP_HAL::Device::BusType`,
PX4 `DeviceBusType`), and a real board has its own sensors on I2C, SPI, CAN or a serial line. That
tells both ways, without trust in what is missing. Measured 2026-11-23: ArduCopter 4.7-dev in SITL
has INS_ACC_ID = 2753028 and SIM_SPEEDUP = 1, PX4 1.16-alpha in SIH has CAL_ACC0_ID = 1310988 and
SYS_HITL = 0. Names that begin with SIM_ alone do not tell: boards of PX4 have some of them too.

No single message decides: `yes` takes two signs from two different answers, `no` takes both
sensors and no sign against it. Questions are asked only while the vehicle is disarmed.
"""

from __future__ import annotations

from dataclasses import dataclass

from companion.link.census import Vehicle
from companion.link.messages import ParamValue
from companion.link.outputs import ParameterReader, parameter_value, px4_parameter_value
from companion.simulated import NOT_ASKED, Simulated

_SENSORS = {False: ("INS_ACC_ID", "INS_GYR_ID"), True: ("CAL_ACC0_ID", "CAL_GYRO0_ID")}
# Its mere presence is a sign on ArduPilot; its value on PX4 (1: hardware in the loop, 2: SIH).
_MODE = {False: "SIM_SPEEDUP", True: "SYS_HITL"}
_BUS_MASK, _SIMULATED_BUS = 0b111, 4
# What only a simulation sends by itself, and how often it has to come: one frame is no sign.
SIMSTATE, SIM_STATE = 164, 108
MESSAGES_MIN = 3
_NAMES = {SIMSTATE: "SIMSTATE", SIM_STATE: "SIM_STATE"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Sign:
    """What one source says; None: it does not tell."""

    source: str
    is_simulated: bool | None
    text: str


def sensor_sign(name: str, value: float | None) -> Sign:
    """Return what the device number of an inertial sensor says.

    >>> sensor_sign("INS_ACC_ID", 2753028.0).is_simulated
    True
    >>> sensor_sign("INS_ACC_ID", 3408394.0).is_simulated
    False
    >>> sensor_sign("INS_ACC_ID", 0.0).is_simulated is None
    True
    """
    # NaN, negative and fractional numbers are no device's.
    if value is None or not 0.0 < value < 2.0**31 or value != int(value):
        told = "no answer" if value is None else "not a device number"
        return Sign(source=name, is_simulated=None, text=f"{name}: {told}")
    bus = int(value) & _BUS_MASK
    if bus == 0:
        return Sign(source=name, is_simulated=None, text=f"{name} {value:.0f} names no bus")
    kind = "a simulated" if bus == _SIMULATED_BUS else "a real"
    return Sign(
        source=name,
        is_simulated=bus == _SIMULATED_BUS,
        text=f"{name} {value:.0f} is {kind} sensor",
    )


def mode_sign(value: float | None, *, is_px4: bool) -> Sign:
    """Return what the parameter of the simulation itself says."""
    name = _MODE[is_px4]
    if value is None:
        return Sign(source=name, is_simulated=False, text=f"no {name}")
    is_on = value in (1.0, 2.0) if is_px4 else True
    return Sign(source=name, is_simulated=is_on, text=f"{name} is {value:g}")


def judge(signs: list[Sign], *, sensors: tuple[str, str]) -> Simulated:
    """Return the verdict: two signs for a simulation, or both real sensors and no sign for one."""
    found = [sign for sign in signs if sign.is_simulated]
    if len(found) >= 2:
        return Simulated(word="yes", because="; ".join(sign.text for sign in found))
    if found:
        others = [sign.text for sign in signs if not sign.is_simulated]
        return Simulated(
            word="unknown", because=f"only one sign: {found[0].text}; but {', '.join(others)}"
        )
    told = {sign.source: sign for sign in signs}
    of_sensors = [told[name] for name in sensors if name in told]
    if len(of_sensors) == len(sensors) and all(sign.is_simulated is False for sign in of_sensors):
        return Simulated(word="no", because="; ".join(sign.text for sign in of_sensors))
    unsaid = [sign.text for sign in of_sensors if sign.is_simulated is None]
    return Simulated(word="unknown", because="; ".join(unsaid) or NOT_ASKED.because)


class SimulationWatch:
    """Asks one vehicle a few parameters, once, and says what follows."""

    def __init__(self) -> None:
        self._reader = ParameterReader()
        self._vehicle: Vehicle | None = None
        self._known: dict[str, float | None] | None = None
        self._hil_count = 0
        self._said = NOT_ASKED

    @property
    def verdict(self) -> Simulated:
        """Return what is known so far."""
        return self._said

    def meet(self, vehicle: Vehicle) -> None:
        """Take the vehicle, also again: after a reboot it is asked anew."""
        self._vehicle = vehicle
        self._reader.clear()
        self._reader.want((*_SENSORS[vehicle.is_px4], _MODE[vehicle.is_px4]))

    def next_name(self, now_s: float) -> str | None:
        """Return the parameter to ask for now; not to be asked in flight."""
        return self._reader.next_name(now_s)

    def parameter(self, found: ParamValue) -> None:
        """Take a parameter of the autopilot; what nobody asked for is ignored."""
        if self._vehicle is not None:
            meant = px4_parameter_value if self._vehicle.is_px4 else parameter_value
            self._reader.take(found.name, meant(found.value, found.kind))

    def heartbeat(self, *, is_hil: bool) -> None:
        """Take whether a heartbeat says that hardware is in the loop of a simulation."""
        self._hil_count = self._hil_count + 1 if is_hil else 0

    def news(self, counts: dict[int, int], *, is_armed: bool) -> Simulated | None:
        """Return the verdict where it has changed; `counts` are the autopilot's messages by id.

        A simulation stays one: after a verdict of `yes` nothing takes it back.
        """
        known = self._reader.finished()
        if known is not None:
            self._known = known
        if self._said.is_simulated or self._vehicle is None:
            return None
        verdict = self._verdict(counts, is_armed=is_armed)
        if verdict == self._said:
            return None
        self._said = verdict
        return verdict

    def _verdict(self, counts: dict[int, int], *, is_armed: bool) -> Simulated:
        assert self._vehicle is not None
        is_px4 = self._vehicle.is_px4
        signs = [
            Sign(source=name, is_simulated=True, text=f"it sends {name}")
            for number, name in _NAMES.items()
            if counts.get(number, 0) >= MESSAGES_MIN
        ]
        if self._hil_count >= MESSAGES_MIN:
            text = "its heartbeat says hardware in the loop"
            signs.append(Sign(source="HEARTBEAT", is_simulated=True, text=text))
        if self._known is not None:
            signs += [sensor_sign(name, self._known.get(name)) for name in _SENSORS[is_px4]]
            signs.append(mode_sign(self._known.get(_MODE[is_px4]), is_px4=is_px4))
        elif is_armed and len(signs) < 2:
            return Simulated(
                word="unknown", because="the vehicle was armed, and is not asked in flight"
            )
        elif not signs:
            return NOT_ASKED
        return judge(signs, sensors=_SENSORS[is_px4])
