"""More parts of the page, which other packages announce by entry points.

Nobody here knows who they are: a distribution names its parts in the group `vrspray.web`. A part
runs in the page's process, on the ground only, and must leave what computes or reads strangers'
files to a child of that process.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING

from companion.web.child import Work
from companion.web.guard import API

if TYPE_CHECKING:
    from fastapi import APIRouter

_logger = logging.getLogger(__name__)

GROUP = "vrspray.web"


@dataclass(frozen=True, slots=True, kw_only=True)
class Host:
    """What the page gives to a part.

    `folder`: where it may keep files. `config`: arguments that name the configuration of the
    flight. `upload_link`: a second link to the autopilot, or nothing. `journals`: their folder.
    `flying`: why nothing may be begun now. `work`: what is being worked on, by any part.
    """

    folder: str
    config: tuple[str, ...] | list[str]
    upload_link: str
    journals: str
    flying: Callable[[], str | None]
    work: Work = field(default_factory=Work)


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """A part of the page: a title for its link, its files, and what adds its interface.

    Of its files `main.html` is what its page has between header and end; a part NAME brings
    NAME.js and NAME.css for it, and may use `static/part.js`.

    `files_at` is the path below its interface at which the body of a POST is a file.
    """

    title: str
    static: Path
    add: Callable[[APIRouter, Host], None]
    files_at: str | None = None


@contextmanager
def or_refused() -> Iterator[None]:
    """Refuse what this computer cannot keep or copy, in one line, instead of failing."""
    from fastapi import HTTPException

    try:
        yield
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise HTTPException(507, f"not done on this computer: {reason}") from error


def registered() -> dict[str, Part]:
    """Return the parts that are installed, by their names; one that cannot be loaded is missing."""
    found: dict[str, Part] = {}
    for point in entry_points(group=GROUP):
        try:
            part = point.load()
        except (ImportError, AttributeError) as error:
            _logger.warning("the page has no %s: %s", point.name, error)
            continue
        if isinstance(part, Part) and point.name.isidentifier():
            found[point.name] = part
    return dict(sorted(found.items()))


def uploads(parts: Mapping[str, Part]) -> tuple[str, ...]:
    """Return the paths below which the body of a POST is a file."""
    pairs = ((name, part.files_at) for name, part in parts.items())
    return tuple(f"{API}{name}/{place}/" for name, place in pairs if place)
