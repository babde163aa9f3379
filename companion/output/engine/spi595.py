"""A chain of 74HC595 (or TPIC6B595) registers on an SPI device: 24 outputs on three wires.

Data and clock are the bus's; its chip select is the latch, whose rise shows all outputs at once.
Output 0 is the first of the register nearest to the computer. A chain holds its last byte for
ever: its output-enable belongs to the ALIVE monostable.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
from collections.abc import Iterable
from typing import Protocol

# linux/spi/spidev.h: SPI_IOC_WR_MAX_SPEED_HZ, SPI_IOC_MESSAGE(1).
_SPEED = 0x40046B04
_MESSAGE = 0x40206B00


class SpiPort(Protocol):
    """A full-duplex transfer."""

    def transfer(self, data: bytes) -> bytes:
        """Shift bytes out; return those that came in."""

    def close(self) -> None:
        """Close the device."""


class _Transfer(ctypes.Structure):
    _fields_ = (
        ("tx_buf", ctypes.c_uint64),
        ("rx_buf", ctypes.c_uint64),
        ("len", ctypes.c_uint32),
        ("speed_hz", ctypes.c_uint32),
        ("delay_usecs", ctypes.c_uint16),
        ("bits_per_word", ctypes.c_uint8),
        ("cs_change", ctypes.c_uint8),
        ("tx_nbits", ctypes.c_uint8),
        ("rx_nbits", ctypes.c_uint8),
        ("word_delay_usecs", ctypes.c_uint8),
        ("pad", ctypes.c_uint8),
    )


class SpiDevice:
    """`/dev/spidevB.C` in mode 0."""

    def __init__(self, path: str, speed_hz: int) -> None:
        self._file = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        self._speed_hz = speed_hz
        try:
            fcntl.ioctl(self._file, _SPEED, speed_hz.to_bytes(4, "little"))
        except OSError:
            os.close(self._file)
            raise

    def transfer(self, data: bytes) -> bytes:
        """Shift bytes out; return those that came in."""
        out = ctypes.create_string_buffer(data, len(data))
        back = ctypes.create_string_buffer(len(data))
        what = _Transfer(
            tx_buf=ctypes.addressof(out),
            rx_buf=ctypes.addressof(back),
            len=len(data),
            speed_hz=self._speed_hz,
            bits_per_word=8,
        )
        fcntl.ioctl(self._file, _MESSAGE, what)
        return back.raw

    def close(self) -> None:
        """Close the device."""
        os.close(self._file)


def open_port(path: str, speed_hz: int) -> SpiPort:
    """Return the SPI device."""
    return SpiDevice(path if path.startswith("/") else f"/dev/{path}", speed_hz)


class SpiRegister:
    """The outputs of the chain. What the wiring does not use stays low."""

    def __init__(self, port: SpiPort, outputs: Iterable[int], *, levels: int) -> None:
        self._port = port
        self._outputs = tuple(outputs)
        self._bytes = max(self._outputs) // 8 + 1
        self.write(levels)

    def _shifted(self, levels: int) -> bytes:
        """Return the bytes: the farthest register's first, each from its highest output."""
        word = 0
        for number, output in enumerate(self._outputs):
            word |= (levels >> number & 1) << output
        return word.to_bytes(self._bytes, "big")

    def write(self, levels: int) -> None:
        """Shift all outputs out; they change together when the latch rises."""
        self._port.transfer(self._shifted(levels))

    def read(self) -> int | None:
        """Return nothing: a chain without a way back cannot tell."""
        return None

    def release(self) -> None:
        """Close the device; the chain keeps its last outputs."""
        self._port.close()
