"""What label and permit ask for, as data: one TOML file beside the configuration.

`[limits] file` names it. It is read with the configuration, and enforced at five places: `map
check` and `plan` before the flight, `doctor`, the safety stage in flight (`core/label.py`), and
the report. What no sensor on board tells is declared by the operator under [application] and
[product]; what is not declared is not kept.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from pathlib import Path, PurePath
from typing import Annotated, Any, Literal, Self

from pydantic import Field, FiniteFloat, ValidationError, model_validator

from companion.config.tables import Buffer, Rate, Table, Text, Texts, contradiction
from companion.core.label import LabelLimits, Span, is_from
from companion.core.types import Inhibit
from companion.errors import ConfigError
from companion.wording import read_toml

SIZE_MAX_BYTES = 100_000
# Where the journal keeps them.
LIMITS_META = "limits_json"
DAY = r"^[0-9]{4}-[0-9]{2}-[0-9]{2}$"
CLOCK = r"([01][0-9]|2[0-3]):[0-5][0-9]"
# ASABE S572.1 and ISO 25358: from the finest to the coarsest.
DropletClass = Literal[
    "extremely-fine", "very-fine", "fine", "medium", "coarse", "very-coarse", "extremely-coarse",
    "ultra-coarse",
]  # fmt: skip
Wind = Annotated[FiniteFloat, Field(ge=0, le=30)]
Height = Annotated[FiniteFloat, Field(ge=0, le=120)]
Speed = Annotated[FiniteFloat, Field(ge=0, le=50)]
Degrees = Annotated[FiniteFloat, Field(ge=0, le=360)]
Celsius = Annotated[FiniteFloat, Field(ge=-40, le=60)]
Percent = Annotated[FiniteFloat, Field(ge=0, le=100)]
Hours = Annotated[str, Field(pattern=f"^{CLOCK}-{CLOCK}$")]
OBSERVED_AT = "application.observed_at"
# What the operator observes, and declares anew on the page: older weather is none beside it.
WEATHER = (
    "application.wind_m_s", "application.wind_from_deg", "application.temperature_c",
    "application.humidity_percent", "application.inversion", OBSERVED_AT,
)  # fmt: skip
DROPLETS = "product.droplet_class"
# Observed this long after the autopilot's time is still now: nobody's watch is right.
WATCH_S = 300.0
_PAIRS = ("rate_l_ha", "wind_m_s", "height_m", "speed_m_s", "temperature_c", "humidity_percent")


class BufferTable(Table):
    """Ground to keep away from, and how far."""

    kind: Text = Field(
        description="what to keep away from, as the label names it: water, garden, hives"
    )
    distance_m: float = Field(ge=0, le=1000, description="distance to keep from it")
    files: Texts = Field(
        min_length=1, description="maps of it: areas, lines or points; relative to this file"
    )


class LimitsFile(Table):
    """The limits of one label with its permit; what is absent is not limited."""

    version: int = Field(ge=1, le=1, description="of this format")
    title: Text = Field(description="label and permit, as the record names them")
    rate_min_l_ha: Rate | None = Field(default=None, description="least mixture, where any")
    rate_max_l_ha: Rate | None = Field(default=None, description="most mixture")
    wind_min_m_s: Wind | None = Field(default=None, description="least wind")
    wind_max_m_s: Wind | None = Field(default=None, description="most wind")
    wind_from_deg: Annotated[
        tuple[Annotated[tuple[Degrees, Degrees], Field(strict=False)], ...],
        Field(strict=False, max_length=20),
    ] = Field(default=(), description="[[from, to], ...] clockwise: where the wind may come from")
    wind_by: Literal["autopilot", "operator"] = Field(
        default="autopilot", description="who measures it; operator: application.wind_m_s"
    )
    height_min_m: Height | None = Field(default=None, description="least height above the crop")
    height_max_m: Height | None = Field(default=None, description="most height above the crop")
    speed_min_m_s: Speed | None = Field(default=None, description="least ground speed")
    speed_max_m_s: Speed | None = Field(default=None, description="most ground speed")
    droplet_classes: Annotated[tuple[DropletClass, ...], Field(strict=False, max_length=8)] = Field(
        default=(), description="ASABE S572; product.droplet_class must be one"
    )
    temperature_min_c: Celsius | None = Field(default=None, description="of the air")
    temperature_max_c: Celsius | None = Field(default=None, description="of the air")
    humidity_min_percent: Percent | None = Field(default=None, description="of the air, relative")
    humidity_max_percent: Percent | None = Field(default=None, description="of the air, relative")
    inversion: Literal["forbidden"] | None = Field(
        default=None, description="no spraying during one: the operator declares that there is none"
    )
    observed_max_h: Annotated[FiniteFloat, Field(gt=0, le=24)] = Field(
        default=2.0,
        description="how long declared weather counts after observed_at",
    )
    hours: Annotated[tuple[Hours, ...], Field(strict=False, max_length=20)] = Field(
        default=(), description='["06:00-10:00", ...] of each day'
    )
    utc_offset: str | None = Field(
        default=None,
        pattern=r"^[+-](0[0-9]|1[0-4]):[0-5][0-9]$",
        description="of these hours and days, such as +02:00",
    )
    first_day: str | None = Field(default=None, pattern=DAY, description="of the permit")
    last_day: str | None = Field(default=None, pattern=DAY, description="of the permit")
    reentry_h: Annotated[FiniteFloat, Field(ge=0, le=8760)] | None = Field(
        default=None, description="re-entry interval: nobody enters for this long after spraying"
    )
    buffer: Annotated[tuple[BufferTable, ...], Field(strict=False, max_length=50)] = Field(
        default=(), description="ground to keep away from, one table each"
    )

    @model_validator(mode="after")
    def _agree(self) -> Self:
        for name in _PAIRS:
            low, high = self.ends(name)
            if low is not None and high is not None and not low <= high:
                key, _, unit = name.partition("_")
                raise contradiction((f"{key}_min_{unit}", f"above {key}_max_{unit} = {high:g}"))
        if (self.hours or self.first_day or self.last_day) and self.utc_offset is None:
            raise contradiction(("utc_offset", "missing; hours and days need it, such as +02:00"))
        for name in ("first_day", "last_day"):
            try:
                date.fromisoformat(getattr(self, name) or "2000-01-01")
            except ValueError:
                raise contradiction((name, "no such day; write YYYY-MM-DD")) from None
        if self.first_day and self.last_day and self.first_day > self.last_day:
            raise contradiction(("first_day", f"after last_day = {self.last_day}"))
        if any(text[:5] == text[6:] for text in self.hours):
            raise contradiction(("hours", "a span of no time; leave hours out for the whole day"))
        return self

    def as_meta(self) -> dict[str, str]:
        """Return the limits as the journal keeps them."""
        return {LIMITS_META: self.model_dump_json()}

    def ends(self, name: str) -> tuple[float | None, float | None]:
        """Return least and most of a quantity such as `wind_m_s`; None: not limited."""
        key, _, unit = name.partition("_")
        return getattr(self, f"{key}_min_{unit}"), getattr(self, f"{key}_max_{unit}")

    def span(self, name: str) -> Span | None:
        """Return the span of a quantity; None where neither end is limited."""
        low, high = self.ends(name)
        if low is None and high is None:
            return None
        least = -math.inf if name == "temperature_c" else 0.0
        return (least if low is None else low, math.inf if high is None else high)

    def buffers(self, file: str) -> tuple[Buffer, ...]:
        """Return the buffers; `file` is how the configuration names these limits."""
        folder = PurePath(file).parent
        return tuple(
            Buffer(each.kind, each.distance_m, tuple(str(folder / name) for name in each.files))
            for each in self.buffer
        )

    def wind_words(self) -> str:
        """Return where the wind may come from in words."""
        return "from " + ", ".join(f"{a:g} to {b:g} deg" for a, b in self.wind_from_deg)

    def when(self) -> str:
        """Return days and hours in words."""
        hours = ", ".join(self.hours) or "all day"
        days = f"{self.first_day or 'any day'} to {self.last_day or 'any day'}"
        return f"{hours} ({self.utc_offset}), {days}"

    def words(self, name: str, unit: str) -> str:
        """Return the span of a quantity in words."""
        low, high = self.ends(name)
        if low is None:
            return f"at most {high:g} {unit}"
        return f"at least {low:g} {unit}" if high is None else f"{low:g} to {high:g} {unit}"

    def flown(self, values: Mapping[str, object]) -> LabelLimits:
        """Return what the safety stage checks, after what the operator declared."""
        offset_s = _offset_s(self.utc_offset)
        hours_s = tuple(
            ((_second(text[:5]) - offset_s) % 86_400.0, (_second(text[6:]) - offset_s) % 86_400.0)
            for text in self.hours
        )
        days_s = None
        if self.first_day is not None or self.last_day is not None:
            last = math.inf if self.last_day is None else _day_s(self.last_day) + 86_400.0
            first = 0.0 if self.first_day is None else _day_s(self.first_day)
            days_s = (first - offset_s, last - offset_s)
        return LabelLimits(
            speed_m_s=self.span("speed_m_s"),
            height_m=self.span("height_m"),
            wind_m_s=self.span("wind_m_s"),
            wind_required=self.wind_by == "autopilot",
            wind_from_deg=self.wind_from_deg,
            hours_s=hours_s,
            days_s=days_s,
            observed_s=self._observed_s(values),
            is_observed=any(True for _ in self._weather(values)),
            broken=frozenset(each.reason for each in self.declared(values) if not each.is_kept),
        )

    def _observed_s(self, values: Mapping[str, object]) -> Span | None:
        """Return how long what the operator observed counts; None where nothing has to be."""
        told = values.get(OBSERVED_AT)
        if told is None or not any(row.key == OBSERVED_AT for row in self.declared(values)):
            return None
        seen_s = (datetime.fromisoformat(str(told)) - _EPOCH) / timedelta(seconds=1)
        return (seen_s - WATCH_S, seen_s + self.observed_max_h * 3600.0)

    def declared(self, values: Mapping[str, object]) -> Iterator[Declared]:
        """Yield each limit that the operator answers for, with what was declared by dotted key."""
        weather = list(self._weather(values))
        yield from weather
        if weather:
            value = values.get(OBSERVED_AT)
            yield Declared(
                Inhibit.LABEL_WEATHER_AGE, "observed_at", OBSERVED_AT,
                f"a time at most {self.observed_max_h:g} h before spraying", value,
                value is not None,
            )  # fmt: skip
        if self.droplet_classes:
            value = values.get(DROPLETS)
            yield Declared(
                Inhibit.LABEL_DROPLETS, "droplet_class", DROPLETS,
                " or ".join(self.droplet_classes), value, self.is_droplet_class(value),
            )  # fmt: skip

    def is_droplet_class(self, value: object) -> bool:
        """Return whether droplets of a class, as people write it, are allowed."""
        name = str(value or "").strip().lower().replace(" ", "-")
        return not self.droplet_classes or name in self.droplet_classes

    def _weather(self, values: Mapping[str, object]) -> Iterator[Declared]:
        """Yield what the operator has to observe; it counts for a while."""
        rows: list[tuple[Inhibit, str, str, str]] = [
            (Inhibit.LABEL_TEMPERATURE, "temperature_c", "application.temperature_c", "deg C"),
            (Inhibit.LABEL_HUMIDITY, "humidity_percent", "application.humidity_percent", "%"),
        ]
        if self.wind_by == "operator":
            rows.append((Inhibit.LABEL_WIND, "wind_m_s", "application.wind_m_s", "m/s"))
        for reason, name, key, unit in rows:
            span = self.span(name)
            if span is not None:
                value = values.get(key)
                kept = isinstance(value, int | float) and span[0] <= value <= span[1]
                yield Declared(reason, name, key, self.words(name, unit), value, kept)
        if self.wind_by == "operator" and self.wind_from_deg:
            key = "application.wind_from_deg"
            value = values.get(key)
            kept = isinstance(value, int | float) and is_from(float(value), self.wind_from_deg)
            yield Declared(
                Inhibit.LABEL_WIND_DIRECTION, "wind_from_deg", key, self.wind_words(), value, kept
            )
        if self.inversion is not None:
            value = values.get("application.inversion")
            yield Declared(
                Inhibit.LABEL_INVERSION, "inversion", "application.inversion", "no (none was seen)",
                value, value == "no",
            )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Declared:
    """A limit that the operator answers for; `value` is None where nothing was declared."""

    reason: Inhibit
    name: str
    key: str
    words: str
    value: object
    is_kept: bool


def _second(clock: str) -> float:
    return int(clock[:2]) * 3600.0 + int(clock[3:]) * 60.0


def _offset_s(text: str | None) -> float:
    if text is None:
        return 0.0
    return math.copysign(_second(text[1:]), -1.0 if text[0] == "-" else 1.0)


def _day_s(text: str) -> float:
    return (datetime.fromisoformat(text).replace(tzinfo=UTC) - _EPOCH) / timedelta(seconds=1)


_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def declared_over(before: Mapping[str, Any], said: Mapping[str, Any]) -> dict[str, Any]:
    """Return what is declared after a new declaration: weather of before does not get its time.

    >>> declared_over({"application.temperature_c": 20.0, "product.name": "A"},
    ...               {"application.wind_m_s": 2.0})
    {'product.name': 'A', 'application.wind_m_s': 2.0}
    """
    return {key: value for key, value in before.items() if key not in WEATHER} | dict(said)


def limits_of(meta: Mapping[str, str]) -> LimitsFile | None:
    """Return the limits that a journal keeps; None for none, and for what are none."""
    try:
        return LimitsFile.model_validate_json(meta.get(LIMITS_META, ""))
    except ValidationError:
        return None


def read_limits(path: Path, named: str) -> LimitsFile:
    """Return the limits in a file; `named` says which configuration names it.

    Raises:
        ConfigError: in one line: file, key, value, what to write instead.
    """
    what = "label and permit"
    if not path.is_file():  # a pipe would keep the start waiting
        raise ConfigError(f"{named}: no such file; give the .toml file of {what}")
    _, raw = read_toml(path, what=what, named=named, bytes_max=SIZE_MAX_BYTES)
    return LimitsFile.checked(raw, path)
