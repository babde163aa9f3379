"""How the link does: counts since the start, rates since the last line."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from companion.link.codec import AUTOPILOT_COMPONENT, Codec


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkStatistics:
    """Counts since the link was opened, and the mean rates since the statistics before."""

    bytes_in: int
    bytes_out: int
    frames_in: int
    frames_out: int
    bad_frames: int
    refused_frames: int
    unsent_frames: int
    lost_percent: float | None
    frames_per_s: float | None
    bytes_in_per_s: float | None
    bytes_out_per_s: float | None
    position_hz: float | None
    round_trip_s: float | None
    copied_positions: int = 0

    def line(self) -> str:
        """Return it in one line, for the record of a flight and the log."""
        parts = [
            f"in {self.frames_in} frames{_rate(self.frames_per_s, '/s')}",
            f"{self.bytes_in} B{_rate(self.bytes_in_per_s, ' B/s')}",
            f"out {self.frames_out} frames",
            f"{self.bytes_out} B{_rate(self.bytes_out_per_s, ' B/s')}",
            f"bad {self.bad_frames}",
            f"refused {self.refused_frames}",
            f"unsent {self.unsent_frames}",
        ]
        if self.copied_positions:
            parts.append(f"positions twice or too late {self.copied_positions}")
        if self.lost_percent is not None:
            parts.append(f"lost {self.lost_percent:.2f} % of the autopilot's")
        if self.position_hz is not None:
            parts.append(f"positions {self.position_hz:.1f} Hz")
        if self.round_trip_s is not None:
            parts.append(f"round trip {1000.0 * self.round_trip_s:.1f} ms")
        return ", ".join(parts)


def _rate(rate: float | None, unit: str) -> str:
    return "" if rate is None else f" ({rate:.1f}{unit})"


# So many positions that came twice or too late, in so long, are told; once in a minute.
COPIES_MANY = 20
COPIES_IN_S = 10.0
COPIES_AGAIN_S = 60.0


class Meter:
    """Counts what goes out, and compares counts with those of the last time it was read."""

    def __init__(self) -> None:
        self.bytes_out = 0
        self.frames_out = 0
        self.unsent_frames = 0
        self.copied_positions = 0
        self._copied_s: deque[float] = deque(maxlen=COPIES_MANY)
        self._copies_told_s = float("-inf")
        self._before: dict[str, tuple[float, int, int, int]] = {}

    def sent(self, size: int, *, has_left: bool) -> None:
        """Count one frame that went out, or could not."""
        if has_left:
            self.frames_out += 1
            self.bytes_out += size
        else:
            self.unsent_frames += 1

    def copied(self, now_s: float) -> bool:
        """Count a position that came twice or too late; return whether many are to be told of."""
        self.copied_positions += 1
        self._copied_s.append(now_s)
        if len(self._copied_s) < COPIES_MANY or now_s - self._copied_s[0] > COPIES_IN_S:
            return False
        if now_s - self._copies_told_s < COPIES_AGAIN_S:
            return False
        self._copies_told_s = now_s
        return True

    def read(
        self,
        codec: Codec,
        now_s: float,
        *,
        series: str = "line",
        position_hz: float | None = None,
        round_trip_s: float | None = None,
    ) -> LinkStatistics:
        """Return the statistics up to now; rates are those since the last of this series."""
        counts = (now_s, codec.frame_count, codec.byte_count, self.bytes_out)
        before = self._before.get(series)
        self._before[series] = counts
        rates: list[float | None] = [None] * 3
        if before is not None and now_s > before[0]:
            span_s = now_s - before[0]
            rates = [(counts[k] - before[k]) / span_s for k in (1, 2, 3)]
        vehicle = codec.vehicle
        lost_percent = None
        if vehicle is not None:
            autopilot = (vehicle.system_id, AUTOPILOT_COMPONENT)
            came, lost = codec.lost_frames.get(autopilot, (0, 0))
            lost_percent = 100.0 * lost / (came + lost) if came else None
        return LinkStatistics(
            bytes_in=codec.byte_count,
            bytes_out=self.bytes_out,
            frames_in=codec.frame_count,
            frames_out=self.frames_out,
            bad_frames=codec.bad_frame_count,
            refused_frames=codec.refused_frame_count,
            unsent_frames=self.unsent_frames,
            lost_percent=lost_percent,
            frames_per_s=rates[0],
            bytes_in_per_s=rates[1],
            bytes_out_per_s=rates[2],
            position_hz=position_hz,
            round_trip_s=round_trip_s,
            copied_positions=self.copied_positions,
        )
