"""How the valves hang on the autopilot's outputs: channels, and the two ends of the pulse."""

from __future__ import annotations

from dataclasses import dataclass

# An alive dither moves each open valve's width this often, so 5 Hz to and fro. A board that closes
# after 0.3 s of standstill then outlives two lost orders in a row.
DITHER_S = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveOutput:
    """A motor's output: where it stops, and the end of its range."""

    channel: int
    stop_us: int = 1000
    max_us: int = 2000

    def __post_init__(self) -> None:
        if not 500 <= self.stop_us < self.max_us <= 2500:
            raise ValueError(
                f"stop_us and max_us must rise from 500 to 2500, got {self.stop_us}, {self.max_us}"
            )

    def pulse_us(self, fraction: float) -> int:
        """Return the pulse for a fraction of the range.

        >>> DriveOutput(channel=5, stop_us=1100, max_us=1900).pulse_us(0.5)
        1500
        """
        return round(self.stop_us + fraction * (self.max_us - self.stop_us))


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoOptions:
    """The outputs: one channel a valve, left to right, and the two ends of the pulse.

    Drives have ends of their own; without valves they are all there is.

    At `return_channel`, if there is one, `full_us` opens a return valve and `closed_us` shuts it.
    With `dither_us` the pulse of an open valve moves to and fro by that much, around its own width,
    every `DITHER_S`: a board that wants to see it closes when the autopilot goes on with a pulse
    of the past. The valves take turns, to keep the wire free; with `dithers_together` they move at
    once, for an autopilot whose one order carries all outputs.
    """

    channels: tuple[int, ...]
    closed_us: int = 1000
    full_us: int = 2000
    refresh_s: float = 1.0
    dither_us: int = 0
    dithers_together: bool = False
    return_channel: int | None = None
    drives: tuple[DriveOutput, ...] = ()

    def __post_init__(self) -> None:
        if not self.outputs or len(set(self.outputs)) != len(self.outputs):
            raise ValueError(f"each valve needs a channel of its own, got {self.channels}")
        if not all(1 <= channel <= 32 for channel in self.outputs):
            raise ValueError(f"servo channels are 1 to 32, got {self.outputs}")
        for name, pulse_us in (("closed_us", self.closed_us), ("full_us", self.full_us)):
            # The autopilot clamps nothing; what is outside is no servo pulse.
            if not 500 <= pulse_us <= 2500:
                raise ValueError(f"{name} must lie in [500, 2500], got {pulse_us}")
        if not abs(self.full_us - self.closed_us) >= 100:
            raise ValueError(f"closed_us and full_us are too near: {self.closed_us}")
        if not 0 <= self.dither_us <= 50:
            raise ValueError(f"dither_us must lie in [0, 50], got {self.dither_us}")
        if not 0.05 <= self.refresh_s <= 10.0:
            raise ValueError(f"refresh_s must lie in [0.05, 10], got {self.refresh_s}")

    @property
    def outputs(self) -> tuple[int, ...]:
        """Return all channels: of the valves, of the return valve, of the drives."""
        more = () if self.return_channel is None else (self.return_channel,)
        return self.channels + more + tuple(drive.channel for drive in self.drives)

    def drive_at(self, channel: int) -> DriveOutput | None:
        """Return the drive on a channel, if it is one."""
        return next((drive for drive in self.drives if drive.channel == channel), None)

    def ends_us(self, output: int) -> tuple[int, int]:
        """Return the pulses of 0 and of 1 at an output, counted as in `outputs`."""
        number = output - (len(self.outputs) - len(self.drives))
        if number < 0:
            return self.closed_us, self.full_us
        return self.drives[number].stop_us, self.drives[number].max_us

    def pulse_at(self, output: int, value: float) -> int:
        """Return the pulse for a duty, or for a drive's fraction, at an output.

        >>> pump = DriveOutput(channel=5, stop_us=1100)
        >>> ServoOptions(channels=(9,), drives=(pump,)).pulse_at(1, 0.0)
        1100
        """
        low_us, high_us = self.ends_us(output)
        return round(low_us + value * (high_us - low_us))

    def pulse_us(self, duty: float) -> int:
        """Return the pulse for `duty`.

        >>> ServoOptions(channels=(9,)).pulse_us(0.25)
        1250
        """
        return round(self.closed_us + duty * (self.full_us - self.closed_us))

    def dithered_us(self, pulse_us: int, *, is_up: bool) -> int:
        """Return what is sent for `pulse_us`: half the dither to either side, but never past full.

        >>> options = ServoOptions(channels=(9,), dither_us=8)
        >>> [options.dithered_us(1500, is_up=is_up) for is_up in (False, True)]
        [1496, 1504]
        >>> [options.dithered_us(2000, is_up=is_up) for is_up in (False, True)]
        [1992, 2000]
        >>> options.dithered_us(1000, is_up=True)
        1000
        """
        if pulse_us == self.closed_us or not self.dither_us:
            return pulse_us
        sign = 1 if self.full_us > self.closed_us else -1
        open_us = sign * (pulse_us - self.closed_us)
        full_us = sign * (self.full_us - self.closed_us)
        low_us = min(open_us - self.dither_us // 2, full_us - self.dither_us)
        return self.closed_us + sign * (low_us + (self.dither_us if is_up else 0))

    def is_move(self, from_us: int, to_us: int) -> bool:
        """Return whether a board that wants to see its width move counts this: half the dither.

        >>> options = ServoOptions(channels=(9,), dither_us=8)
        >>> options.is_move(1500, 1496), options.is_move(1500, 1503)
        (True, False)
        """
        return 2 * abs(to_us - from_us) >= self.dither_us
