"""What a broken, foreign or malicious sender could send instead of a frame."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from pymavlink.generator.mavcrc import x25crc

from companion.link.codec import FROM_ANYONE, FROM_VEHICLE

READ = tuple(sorted({*FROM_VEHICLE, *FROM_ANYONE}))
_ALL = tuple(sorted(mavlink.mavlink_map))
# What a field takes at the ends of its type: 0, all ones, the largest and the smallest, NaN.
_EXTREMES = (b"\x00", b"\xff", b"\x7f", b"\x80", b"\x00\x00\xc0\x7f")

_MAX_FLOAT = 3.4028234663852886e38
_FLOATS = (math.nan, math.inf, -math.inf, _MAX_FLOAT, -_MAX_FLOAT, 1e-45, -0.0, 1e19, 2.0**31, -1.0)


def sealed(message_id: int, payload: bytes, *, system_id: int, component_id: int) -> bytes:
    """Return a frame of MAVLink 2 with a right checksum, whatever is in it."""
    cut = payload.rstrip(b"\x00") or b"\x00"
    head = bytes([len(cut), 0, 0, 7, system_id, component_id]) + message_id.to_bytes(3, "little")
    crc = x25crc(head + cut + bytes([mavlink.mavlink_map[message_id].crc_extra])).crc
    return b"\xfd" + head + cut + crc.to_bytes(2, "little")


def random_frame(rng: np.random.Generator, frame: bytes, *, system_id: int) -> bytes:
    """Return random content, `frame` with changed content, `frame` damaged, or noise."""
    way = rng.random()
    if way < 0.45:
        return _random_message(rng, system_id)
    if way < 0.75:
        return _changed_field(rng, frame, system_id)
    if way < 0.9:
        return _damaged(rng, frame)
    return rng.bytes(int(rng.integers(1, 60)))


def _random_message(rng: np.random.Generator, system_id: int) -> bytes:
    known = rng.random() < 0.8
    message_id = int(rng.choice(READ if known else _ALL))
    size = mavlink.mavlink_map[message_id].unpacker.size
    payload = rng.bytes(size)
    if rng.random() < 0.5:
        extreme = _EXTREMES[int(rng.integers(len(_EXTREMES)))]
        at = int(rng.integers(0, size))
        payload = (payload[:at] + extreme * size)[:size]
    system, component = system_id, 1
    if rng.random() < 0.3:
        system, component = (int(number) for number in rng.integers(0, 256, 2))
    return sealed(message_id, payload, system_id=system, component_id=component)


def _changed_field(rng: np.random.Generator, frame: bytes, system_id: int) -> bytes:
    """Return a healthy message with some bytes of it replaced, and a right checksum."""
    message_id = int.from_bytes(frame[7:10], "little")
    size = mavlink.mavlink_map[message_id].unpacker.size
    payload = bytearray(frame[10:-2].ljust(size, b"\x00"))
    extreme = _EXTREMES[int(rng.integers(len(_EXTREMES)))] if rng.random() < 0.6 else rng.bytes(2)
    at = int(rng.integers(0, size))
    payload[at : at + len(extreme)] = extreme
    return sealed(message_id, bytes(payload[:size]), system_id=system_id, component_id=1)


def _damaged(rng: np.random.Generator, frame: bytes) -> bytes:
    damaged = bytearray(frame)
    for _ in range(int(rng.integers(1, 4))):
        damaged[int(rng.integers(0, len(damaged)))] = int(rng.integers(0, 256))
    return bytes(damaged[: int(rng.integers(1, len(damaged) + 1))])


def _values(kind: str) -> tuple[Any, ...]:
    """Return what a field of a type takes at the ends of it."""
    if kind in ("float", "double"):
        return _FLOATS
    if kind == "char":
        return (b"\x00", b"\xff", b"A", b"\x7f")
    bits = int("".join(letter for letter in kind if letter.isdigit()))
    if kind.startswith("u"):
        return (0, 1, 2 ** (bits - 1), 2**bits - 1)
    return (0, 1, -1, 2 ** (bits - 1) - 1, -(2 ** (bits - 1)))


def packed(message_id: int, change: dict[str, Any]) -> bytes:
    """Return the payload of a message, all fields 0 but those that are changed."""
    kind = mavlink.mavlink_map[message_id]
    given: list[Any] = []
    for name, count in zip(kind.ordered_fieldnames, kind.array_lengths, strict=True):
        is_text = kind.fieldtypes[kind.fieldnames.index(name)] == "char"
        value = change.get(name, b"\x00" if is_text else 0)
        if is_text:
            given.append(value * max(count, 1))
        else:
            given += [value] * max(count, 1)
    return bytes(kind.unpacker.pack(*given))


def _payloads(message_id: int) -> Iterator[tuple[str, bytes]]:
    """Yield each field alone at each extreme, and all fields of a type at it together."""
    kind = mavlink.mavlink_map[message_id]
    types = dict(zip(kind.fieldnames, kind.fieldtypes, strict=True))
    for name, one in types.items():
        for value in _values(one):
            yield f"{name}={value!r}", packed(message_id, {name: value})
    for one in sorted(set(types.values())):
        names = [name for name, other in types.items() if other == one]
        for value in _values(one):
            yield f"all {one}={value!r}", packed(message_id, dict.fromkeys(names, value))
    for number in range(max(len(_values(one)) for one in types.values())):
        change = {name: _values(one)[number % len(_values(one))] for name, one in types.items()}
        yield f"all at extreme {number}", packed(message_id, change)


def extreme_frames(message_id: int) -> Iterator[tuple[str, bytes]]:
    """Yield the vehicle's frames of a message with its fields at their extremes, each named."""
    for label, payload in _payloads(message_id):
        yield label, sealed(message_id, payload, system_id=1, component_id=1)
