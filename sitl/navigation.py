"""What the autopilot tells of its position: late, noisy, quantised as on the wire."""

from __future__ import annotations

import heapq
import math
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from companion.core.types import AttitudeReport, ImuReport, SpeedReport, Telemetry
from sitl.airframes import DRAWN, EstimatorNoise
from sitl.trajectory import Trajectory
from sitl.vehicle import GRAVITY_M_S2, MEAN_S, Leaning, leaning

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sitl.earth import Earth
    from sitl.trajectory import Truth

SPEED_REPORT_RATE_HZ = 10.0
# What an estimator's attitude is off by: it wanders as its accelerometer's bias is learned.
TILT_SD_RAD, TILT_TIME_S = math.radians(0.4), 30.0
YAW_SD_RAD, ATTITUDE_NOISE_RAD = math.radians(2.0), math.radians(0.05)
# The accelerometer: an offset of its own, the vibration that its filter leaves, and how late that
# makes it (ArduPilot: INS_ACCEL_FILTER, 20 Hz).
IMU_BIAS_SD_M_S2, IMU_NOISE_M_S2, IMU_LATE_S = 0.1, 0.3, 0.01
_DRAWS, _IMU_DRAWS = 8, 9

Heard = Telemetry | SpeedReport | AttitudeReport | ImuReport


class TruthSource(Protocol):
    """Whoever knows where the vehicle really is."""

    def truth_at(self, time_s: float) -> Truth:
        """Return the truth at `time_s`."""


class Navigation:
    """Turns the truth into position and speed messages, in the order of their arrival.

    A message of the time t carries the state of `estimator_lag_s` before t and arrives
    `message_delay_s` and a jitter after t, never before an earlier one of its kind. `rounded` is as
    GLOBAL_POSITION_INT has it; LOCAL_POSITION_NED tells the same estimate in floats.
    """

    def __init__(
        self,
        source: TruthSource,
        earth: Earth,
        *,
        seed: int,
        start_s: float = 0.0,
        position_rate_hz: float = 10.0,
        estimator_lag_s: float = 0.031,
        message_delay_s: float = 0.005,
        jitter_s: float = 0.003,
        noise: bool = True,
        off: EstimatorNoise = DRAWN.noise,
        boot_s: float = 0.0,
        imu_rate_hz: float = 0.0,
        speed_rate_hz: float = SPEED_REPORT_RATE_HZ,
        rounded: bool = True,
    ) -> None:
        if not (0.1 <= position_rate_hz <= 1000.0 and message_delay_s >= 0.0 and jitter_s >= 0.0):
            raise ValueError("rate, delay and jitter of the position must be sensible")
        self._source = source
        self._rounded = rounded
        self._earth = earth
        self._period_s = 1.0 / position_rate_hz
        self._lag_s, self._delay_s, self._jitter_s = estimator_lag_s, message_delay_s, jitter_s
        self._noise = 1.0 if noise else 0.0
        self._start_s, self._boot_s = start_s, boot_s
        self._off, self._kept = off, off.kept(self._period_s)
        position_seed, speed_seed, imu_seed, drift_seed = np.random.SeedSequence(seed).spawn(4)
        self._drift_rng = np.random.default_rng(drift_seed)
        self._pace_off: Any = off.velocity_drift_m_s * self._drift_rng.standard_normal(2)
        self._position_rng = np.random.default_rng(position_seed)
        self._speed_rng = np.random.default_rng(speed_seed)
        self._speed_rate_hz, self._imu_rate_hz = speed_rate_hz, imu_rate_hz
        self._imu_rng = np.random.default_rng(imu_seed)
        self._tilt = TILT_SD_RAD * self._noise * self._imu_rng.standard_normal(2)
        self._yaw_off = YAW_SD_RAD * self._noise * float(self._imu_rng.standard_normal())
        self._imu_bias = IMU_BIAS_SD_M_S2 * self._noise * self._imu_rng.standard_normal(3)
        self._imu_count = 0
        self._imu_received_s = -math.inf
        east, north = self._position_rng.standard_normal(2).tolist()
        self._wander = (off.drift_m * east, off.drift_m * north)
        self._position_count = self._speed_count = self._order = 0
        self._position_received_s = self._speed_received_s = -math.inf
        self._under_way: list[tuple[float, int, Heard]] = []

    def advance(self, until_s: float) -> list[Heard]:
        """Return what has arrived since the last call up to `until_s`."""
        self._send_positions(until_s)
        self._send_speeds(until_s)
        self._send_imu(until_s)
        arrived = []
        while self._under_way and self._under_way[0][0] <= until_s:
            arrived.append(heapq.heappop(self._under_way)[2])
        return arrived

    def _send_positions(self, until_s: float) -> None:
        times_s = []
        while (at_s := self._start_s + self._position_count * self._period_s) <= until_s:
            times_s.append(at_s)
            self._position_count += 1
        if not times_s:
            return
        draws = self._position_rng.standard_normal((len(times_s), _DRAWS))
        truths = self._truths(times_s)
        east_m, north_m = self._positions(truths, draws)
        places = self._earth.to_geographic_all(east_m, north_m)
        latitudes, longitudes = (np.asarray(each).tolist() for each in places)
        off_m_s = self._off.velocity_m_s * draws[:, 4:7]
        off_m_s[:, :2] += self._paces_off(len(times_s))
        velocity = (self._noise * off_m_s).tolist()
        jitter = draws[:, 7].tolist()
        for i, truth in enumerate(truths):
            received_s = self._receive_s(times_s[i], jitter[i], self._position_received_s)
            self._position_received_s = received_s
            message = Telemetry(
                received_s=received_s,
                boot_s=math.floor((times_s[i] - self._boot_s) * 1e3 + 1e-6) / 1e3,
                latitude_deg=self._told(latitudes[i], 1e7),
                longitude_deg=self._told(longitudes[i], 1e7),
                relative_altitude_m=round(truth.height_m * 1e3) / 1e3,
                velocity_north_m_s=self._told(truth.velocity_north_m_s + velocity[i][0], 1e2),
                velocity_east_m_s=self._told(truth.velocity_east_m_s + velocity[i][1], 1e2),
                velocity_down_m_s=round(velocity[i][2] * 1e2) / 1e2,
                heading_deg=round(truth.heading_deg * 1e2) % 36_000 / 1e2,
            )
            self._put(received_s, message)

    def _told(self, value: float, per_unit: float) -> float:
        return round(value * per_unit) / per_unit if self._rounded else value

    def _positions(
        self, truths: list[Truth], draws: NDArray[np.float64]
    ) -> tuple[list[float], list[float]]:
        east_m, north_m = [], []
        (east, north), (decay, _, kick, _), noise = self._wander, self._kept, self._noise
        white_m = self._off.white_m
        for truth, draw in zip(truths, draws[:, :4].tolist(), strict=True):
            east, north = decay * east + kick * draw[2], decay * north + kick * draw[3]
            east_m.append(truth.east_m + noise * (east + white_m * draw[0]))
            north_m.append(truth.north_m + noise * (north + white_m * draw[1]))
        self._wander = (east, north)
        return east_m, north_m

    def _paces_off(self, count: int) -> NDArray[np.float64]:
        """Return how far the velocities of the next messages have drifted, north and east."""
        _, keep, _, kick = self._kept
        found = []
        for draw in self._drift_rng.standard_normal((count, 2)):
            self._pace_off = keep * self._pace_off + kick * draw
            found.append(self._pace_off)
        return np.array(found)

    def _truths(self, sent_s: list[float]) -> list[Truth]:
        """Return what the messages sent at these times tell of."""
        times_s = [at_s - self._lag_s for at_s in sent_s]
        if isinstance(self._source, Trajectory):
            return self._source.truths_at(times_s)
        return [self._source.truth_at(time_s) for time_s in times_s]

    def _send_speeds(self, until_s: float) -> None:
        # Half a period after the position: the two streams of an autopilot do not coincide.
        times_s = []
        while True:
            at_s = self._start_s + (self._speed_count + 0.5) / self._speed_rate_hz
            if not at_s <= until_s:
                break
            times_s.append(at_s)
            self._speed_count += 1
        draws = self._speed_rng.standard_normal((len(times_s), 2)).tolist()
        truths = self._truths(times_s)
        for at_s, truth, (error, jitter) in zip(times_s, truths, draws, strict=True):
            speed_m_s = math.hypot(truth.velocity_east_m_s, truth.velocity_north_m_s)
            speed_m_s = abs(speed_m_s + self._off.velocity_m_s * self._noise * error)
            received_s = self._receive_s(at_s, jitter, self._speed_received_s)
            self._speed_received_s = received_s
            self._put(received_s, SpeedReport(received_s=received_s, ground_speed_m_s=speed_m_s))

    def _send_imu(self, until_s: float) -> None:
        """Send attitude and accelerometer one behind the other, as an autopilot's streams do."""
        if not self._imu_rate_hz > 0.0:
            return
        times_s = []
        while (at_s := self._start_s + (self._imu_count + 0.25) / self._imu_rate_hz) <= until_s:
            times_s.append(at_s)
            self._imu_count += 1
        decay = math.exp(-1.0 / (self._imu_rate_hz * TILT_TIME_S))
        kick = TILT_SD_RAD * self._noise * math.sqrt(1.0 - decay * decay)
        for at_s in times_s:
            draws = self._imu_rng.standard_normal(_IMU_DRAWS)
            self._tilt = decay * self._tilt + kick * draws[:2]
            received_s = self._receive_s(at_s, float(draws[2]), self._imu_received_s)
            self._imu_received_s = received_s
            self._put(received_s, self._attitude(at_s, received_s, draws[3:6]))
            self._put(received_s, self._imu(at_s, received_s, draws[6:9]))

    def _leaning(self, at_s: float) -> Leaning:
        before, now = self._source_truths([at_s - MEAN_S, at_s])
        return leaning(before, now, MEAN_S)

    def _source_truths(self, times_s: list[float]) -> list[Truth]:
        if isinstance(self._source, Trajectory):
            return self._source.truths_at(times_s)
        return [self._source.truth_at(time_s) for time_s in times_s]

    def _attitude(
        self, at_s: float, received_s: float, draws: NDArray[np.float64]
    ) -> AttitudeReport:
        now, before = self._leaning(at_s), self._leaning(at_s - MEAN_S)
        off = ATTITUDE_NOISE_RAD * self._noise * draws
        turned = math.remainder(now.yaw_rad - before.yaw_rad, 2.0 * math.pi)
        return AttitudeReport(
            received_s=received_s,
            boot_s=self._boot(at_s),
            roll_deg=math.degrees(now.roll_rad + self._tilt[0] + off[0]),
            pitch_deg=math.degrees(now.pitch_rad + self._tilt[1] + off[1]),
            yaw_deg=math.degrees(now.yaw_rad + self._yaw_off + off[2]),
            roll_rate_deg_s=math.degrees((now.roll_rad - before.roll_rad) / MEAN_S),
            pitch_rate_deg_s=math.degrees((now.pitch_rad - before.pitch_rad) / MEAN_S),
            yaw_rate_deg_s=math.degrees(turned / MEAN_S),
        )

    def _imu(self, at_s: float, received_s: float, draws: NDArray[np.float64]) -> ImuReport:
        """Return SCALED_IMU's: thousandths of gravity."""
        force = self._leaning(at_s - IMU_LATE_S).felt_m_s2
        off = self._imu_bias + IMU_NOISE_M_S2 * self._noise * draws
        unit = GRAVITY_M_S2 / 1000.0
        x, y, z = (round((f + d) / unit) * unit for f, d in zip(force, off.tolist(), strict=True))
        return ImuReport(
            received_s=received_s,
            boot_s=self._boot(at_s),
            forward_m_s2=x,
            right_m_s2=y,
            down_m_s2=z,
        )

    def _boot(self, at_s: float) -> float:
        return math.floor((at_s - self._boot_s) * 1e3 + 1e-6) / 1e3

    def _receive_s(self, sent_s: float, jitter: float, after_s: float) -> float:
        received_s = sent_s + max(self._delay_s + self._jitter_s * jitter, 0.0)
        return max(received_s, after_s)

    def _put(self, received_s: float, message: Heard) -> None:
        self._order += 1
        heapq.heappush(self._under_way, (received_s, self._order, message))
