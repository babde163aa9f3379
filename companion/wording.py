"""Words that every text for a person puts together in the same way."""

from __future__ import annotations


def counted(count: int, name: str) -> str:
    """Return a number with its noun.

    >>> counted(1, "hole"), counted(2, "hole")
    ('1 hole', '2 holes')
    """
    return f"{count} {name}{'' if count == 1 else 's'}"
