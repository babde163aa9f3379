"""Our parameters: a short fixed list that any ground station can read and set.

Classic protocol (mavlink.io/en/services/parameter.html), REAL32 only. A refused value is answered
with the one that stays. What is kept outlives a restart; lags act from the next start on.
"""

from __future__ import annotations

import json
import stat
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from companion.atomic_write import write_atomically
from companion.errors import LinkError

RATE_PERCENT = "SPR_RATE_PCT"
VALUES_HZ = "SPR_VAL_HZ"
TANK_L = "SPR_TANK_L"


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameter:
    """One parameter: its range, what it is at the first start, and which setting it stands for.

    `setting` is the key of the configuration that it takes the place of at the next start; such a
    one, and any that is kept, can only be set while the vehicle is disarmed.
    """

    name: str
    low: float
    high: float
    value: float
    setting: str | None = None
    is_kept: bool = True

    def __post_init__(self) -> None:
        if not 1 <= len(self.name) <= 16:
            raise ValueError(f"a parameter's name has 1 to 16 characters, got {self.name!r}")


# The settings that a ground station may change, with their range: measured, so found in the field.
SETTINGS = {
    "SPR_LAG_ON": ("lag.on_s", 0.0, 30.0),
    "SPR_LAG_OFF": ("lag.off_s", 0.0, 30.0),
    "SPR_LAG_UP": ("lag.up_s", 0.0, 30.0),
    "SPR_LAG_DOWN": ("lag.down_s", 0.0, 30.0),
    "SPR_LAG_POS": ("lag.position_s", -0.5, 0.5),
}

Save = Callable[[Mapping[str, float]], bool]
Check = Callable[[Mapping[str, float]], str | None]


def known_parameters(
    settings: Mapping[str, float], *, tank_l: float | None = None
) -> tuple[Parameter, ...]:
    """Return the list: `settings` are the values now in force of the keys in `SETTINGS`."""
    own = (
        # 80 to 110 %: wider, and it is another prescription. Forgotten at a restart on purpose.
        Parameter(name=RATE_PERCENT, low=80.0, high=110.0, value=100.0, is_kept=False),
        Parameter(name=VALUES_HZ, low=0.2, high=5.0, value=1.0),
        Parameter(name=TANK_L, low=0.0, high=10_000.0, value=tank_l or 0.0),
    )
    lags = tuple(
        Parameter(name=name, low=low, high=high, value=settings[key], setting=key)
        for name, (key, low, high) in SETTINGS.items()
        if key in settings
    )
    return own + lags


class Parameters:
    """The values, and what may become of them."""

    def __init__(
        self,
        known: tuple[Parameter, ...] = (),
        *,
        kept: Mapping[str, float] | None = None,
        save: Save | None = None,
        check: Check | None = None,
        stop_file: Path | None = None,
    ) -> None:
        self._stop_file = stop_file
        self.is_stopped = stop_file is not None and stop_file.exists()
        self._known = {one.name: one for one in known}
        self._order = [one.name for one in known]
        self._values = {one.name: one.value for one in known}
        self._kept = {
            name: value
            for name, value in (kept or {}).items()
            if name in self._known and self._in_range(self._known[name], value)
        }
        self._values.update(self._kept)
        self._save, self._check = save, check

    def keep_stop(self, is_stopped: bool) -> None:
        """Keep that a stop was commanded, and not ended yet, for the next start too."""
        if is_stopped == self.is_stopped or self._stop_file is None:
            return
        self.is_stopped = is_stopped
        if is_stopped:
            write_state(self._stop_file, {"stopped": 1.0})
        else:
            with suppress(OSError):
                self._stop_file.unlink(missing_ok=True)

    @staticmethod
    def _in_range(one: Parameter, value: float) -> bool:
        return one.low <= value <= one.high

    def __len__(self) -> int:
        return len(self._order)

    def get(self, name: str, default: float) -> float:
        """Return a value; `default` where this list does not have it."""
        return self._values.get(name, default)

    def at(self, index: int) -> tuple[str, float] | None:
        """Return name and value by place; None beyond the list."""
        if not 0 <= index < len(self._order):
            return None
        return self._order[index], self._values[self._order[index]]

    def index(self, name: str) -> int | None:
        """Return the place of a name; None for a name that we do not have."""
        return self._order.index(name) if name in self._known else None

    def set(self, name: str, value: float | None, *, is_frozen: bool) -> str | None:
        """Take a value; return None, or why the old one stays."""
        one = self._known[name]
        # A float of 32 bits has seven digits: 0.12 shall not become 0.11999999731779099.
        value = None if value is None else float(f"{value:.6g}")
        if value is None or not self._in_range(one, value):
            return f"{one.low:g} to {one.high:g} only"
        if value == self._values[name]:
            return None
        if not one.is_kept:
            self._values[name] = value
            return None
        if is_frozen:
            return "disarm first"
        after = {**self._kept, name: value}
        refusal = self._check(after) if self._check is not None else None
        if refusal is None and self._save is not None and not self._save(after):
            refusal = "cannot be stored"
        if refusal is None:
            self._kept, self._values[name] = after, value
        return refusal


# Small files of numbers that outlive a run: parameters that a station set, the signing stamp.

_SIZE_MAX_BYTES = 100_000


class DamagedStateError(LinkError):
    """The file can be read, but is none that this program wrote."""


def read_state(path: Path) -> dict[str, float]:
    """Return the numbers in `path`, nothing where there is no file.

    Raises:
        LinkError: where the file is there and is no such file.
    """
    try:
        found = path.stat()
        if not stat.S_ISREG(found.st_mode):
            raise LinkError(f"{path}: no file; remove it, or give another link.state_folder")
        if found.st_size > _SIZE_MAX_BYTES:
            raise DamagedStateError(f"{path}: too large for what it should be; delete it")
        content = json.loads(path.read_text("utf-8"))
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise LinkError(f"{path}: {(error.strerror or 'cannot be read').lower()}") from error
    except ValueError as error:
        raise DamagedStateError(f"{path}: damaged; delete it and set its values again") from error
    if not isinstance(content, dict) or not all(
        isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e18
        for value in content.values()
    ):
        raise DamagedStateError(
            f"{path}: not names with numbers; delete it and set its values again"
        )
    return {name: float(value) for name, value in content.items()}


def write_state(path: Path, values: Mapping[str, float]) -> bool:
    """Replace the file as a whole; return whether that worked: a full disk stops no flight."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, json.dumps(dict(values), indent=1).encode())
    except OSError:
        return False
    return True
