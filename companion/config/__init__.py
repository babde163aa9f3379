"""The configuration: one TOML file, read, checked and turned into types of the core.

`load` either returns a `Config` that can be used or raises a `ConfigError` of one line, which
names the file, the key, the value and what to write instead.
"""

from __future__ import annotations

from companion.config.model import Config, load

__all__ = ["Config", "load"]
