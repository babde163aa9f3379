"""A flight as MCAP messages in JSON, for Foxglove and its kin: position, spraying, events.

Times are those of the flight in UTC. Of a job each sortie has topics of its own. Chunks are small,
so that a file that was cut in transfer loses little. The facts of the flight are a metadata record
named `vrspray`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mcap.writer import CompressionType, Writer

from analysis.exports.columns import utc_ms

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from analysis.exports.output import Content
    from analysis.exports.source import Source

_CHUNK_BYTES = 64 * 1024
_NS_A_MS = 1_000_000
_NUMBER: dict[str, object] = {"type": ["number", "null"]}
_NUMBERS: dict[str, object] = {"type": "array", "items": _NUMBER}
_TIME: dict[str, object] = {
    "type": "object",
    "title": "time",
    "properties": {
        "sec": {"type": "integer", "minimum": 0},
        "nsec": {"type": "integer", "minimum": 0, "maximum": 999_999_999},
    },
}
# The well-known schema by which map panels find a position (docs.foxglove.dev).
_LOCATION: dict[str, object] = {
    "timestamp": _TIME,
    "frame_id": {"type": "string"},
    "latitude": {"type": "number"},
    "longitude": {"type": "number"},
    "altitude": {"type": "number"},
    "position_covariance": {
        "type": "array", "items": {"type": "number"}, "minItems": 9, "maxItems": 9,
    },
    "position_covariance_type": {"type": "integer"},
}  # fmt: skip
_SPRAY_NUMBERS = (
    "height_m", "speed_m_s", "course_deg", "heading_deg", "target_rate_l_ha", "applied_rate_l_ha",
    "target_flow_l_min", "flow_l_min", "volume_ml", "width_m", "duty", "pressure_kpa",
)  # fmt: skip
_SPRAY_LISTS = ("valve_target_rate_l_ha", "valve_flow_l_min", "valve_duty")
_EVENT: dict[str, object] = {
    "timestamp": _TIME,
    "kind": {"type": "string"},
    "text": {"type": "string"},
}


def make(source: Source, out: Path) -> Content:
    """Return one file."""
    packed = BytesIO()
    writer = Writer(packed, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
    writer.start(profile="", library=source.about.exported_by)
    writer.add_metadata("vrspray", _facts(source))
    messages: list[tuple[int, str, int]] = []
    for number, part in enumerate(source.parts, start=1):
        begin = f"/sortie_{number}" if source.also else ""
        position = _channel(writer, f"{begin}/position", "foxglove.LocationFix", _LOCATION)
        spray = _channel(writer, f"{begin}/spray", "vrspray.Applied", _spray_properties())
        event = _channel(writer, f"{begin}/events", "vrspray.Event", _EVENT)
        ms = utc_ms(part.samples.utc_s).tolist()
        messages += [
            *zip(ms, _positions(part, ms), [position] * len(ms), strict=True),
            *zip(ms, _sprayed(part, ms), [spray] * len(ms), strict=True),
            *((at, text, event) for at, text in _events(part)),
        ]
    messages.sort(key=lambda message: message[0])
    for number, (at, text, channel) in enumerate(messages):
        at_ns = at * _NS_A_MS
        writer.add_message(
            channel, log_time=at_ns, publish_time=at_ns, sequence=number, data=text.encode()
        )
    writer.finish()  # type: ignore[no-untyped-call]
    return {out.name: [packed.getvalue()]}


def _channel(writer: Writer, topic: str, name: str, properties: dict[str, object]) -> int:
    schema = {"title": name, "type": "object", "properties": properties}
    number = writer.register_schema(
        name=name, encoding="jsonschema", data=json.dumps(schema).encode()
    )
    channel: int = writer.register_channel(topic=topic, message_encoding="json", schema_id=number)
    return channel


def _spray_properties() -> dict[str, object]:
    return {
        "timestamp": _TIME,
        **dict.fromkeys(_SPRAY_NUMBERS, _NUMBER),
        **dict.fromkeys(_SPRAY_LISTS, _NUMBERS),
        "inhibits": {"type": "string"},
    }


def _positions(source: Source, ms: list[int]) -> Iterator[str]:
    samples = source.samples
    places = zip(
        samples.latitude_deg.tolist(), samples.longitude_deg.tolist(), samples.height_m.tolist(),
        strict=True,
    )  # fmt: skip
    for at, (latitude_deg, longitude_deg, height_m) in zip(ms, places, strict=True):
        yield json.dumps(
            {
                "timestamp": _time(at),
                "frame_id": "gps",
                "latitude": round(latitude_deg, 9),
                "longitude": round(longitude_deg, 9),
                # The schema knows no missing height.
                "altitude": _number(height_m) or 0.0,
                "position_covariance": [0.0] * 9,
                "position_covariance_type": 0,
            }
        )


def _sprayed(source: Source, ms: list[int]) -> Iterator[str]:
    samples = source.samples
    columns: list[NDArray[np.float64] | None] = [
        samples.height_m, samples.speed_m_s, samples.course_deg, samples.heading_deg,
        samples.rate_l_ha, samples.applied_l_ha, samples.target_flow_l_min, samples.flow_l_min,
        samples.volume_ml, samples.width_m, samples.duty, samples.pressure_kpa,
    ]  # fmt: skip
    numbers = {
        name: values.tolist()
        for name, values in zip(_SPRAY_NUMBERS, columns, strict=True)
        if values is not None
    }
    of_valves = (samples.valve_rate_l_ha, samples.valve_flow_l_min, samples.valve_duty)
    lists = {name: values.tolist() for name, values in zip(_SPRAY_LISTS, of_valves, strict=True)}
    for row, at in enumerate(ms):
        message: dict[str, Any] = {"timestamp": _time(at)}
        message |= {name: _number(values[row]) for name, values in numbers.items()}
        message |= {
            name: [_number(value) for value in values[row]] for name, values in lists.items()
        }
        message["inhibits"] = samples.inhibits[row]
        yield json.dumps(message, allow_nan=False)


def _events(source: Source) -> Iterator[tuple[int, str]]:
    offset_s = source.flight.utc_offset_s
    for event in source.flight.events:
        if math.isfinite(event.at_s):
            at = round(1000.0 * (event.at_s + offset_s))
            text = {"timestamp": _time(at), "kind": event.kind, "text": event.text}
            yield at, json.dumps(text)


def _facts(source: Source) -> dict[str, str]:
    return {
        name: value if isinstance(value, str) else json.dumps(value, allow_nan=False)
        for name, value in source.facts().items()
        if value is not None
    }


def _number(value: float) -> float | None:
    return round(value, 6) if math.isfinite(value) else None


def _time(ms: int) -> dict[str, int]:
    seconds, rest = divmod(ms, 1000)
    return {"sec": seconds, "nsec": rest * _NS_A_MS}
