"""The rows of a campaign in a folder: Parquet in parts, and a manifest of what they are rows of.

    DIR/manifest.json                      versions, hashes, counts
    DIR/campaign.toml                      the file as it was
    DIR/flights/part=00000/flights.parquet a fixed number of flights each, in order
    DIR/log.jsonl                          when and how fast; no part of the dataset

A part appears whole or not at all, and nothing in it tells when or where it was flown: a campaign
that was killed and resumed, or flown elsewhere, leaves the same bytes.
"""

from __future__ import annotations

import io
import json
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from companion.atomic_write import write_atomically
from companion.errors import ConfigError
from companion.wording import missing, writing
from sitl.campaign.bundle import Bundle, code_sha256, versions
from sitl.campaign.design import Campaign, read_campaign
from sitl.campaign.flying import BY_RATE, BY_RATE_COUNTS, figure_types

if TYPE_CHECKING:
    import pyarrow as pa

FORMAT = 1
MANIFEST, COPY, FLIGHTS, LOG = "manifest.json", "campaign.toml", "flights", "log.jsonl"
FILE = "flights.parquet"
# What of a manifest changes where seeds are added.
GROWING = ("campaign_sha256", "flights", "seeds", "seed_blocks")
# Flights of a part: what a kill may cost, against files that are too many to be read quickly.
PARTS_WANTED, PART_LEAST, PART_MOST = 200, 10, 5000
# Columns before the figures, the settings between them, and columns after.
BEFORE: Mapping[str, type] = {"flight": int, "case": str, "point": int, "seed": int}
AFTER: Mapping[str, type] = {
    "method": str, "speed_m_s": float, "plant": str, "fidelity": str, "output": str,
    "inhibits": str, "error": str,
}  # fmt: skip


def part_size(flights: int) -> int:
    """Return how many flights are in a part, but for the last.

    >>> [part_size(flights) for flights in (30, 2_000, 100_000, 1_000_000)]
    [10, 10, 500, 5000]
    """
    return min(max(-(-flights // PARTS_WANTED), PART_LEAST), PART_MOST)


def arrow() -> Any:
    """Return pyarrow.

    Raises:
        ConfigError: it is missing.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise ConfigError(missing("pyarrow", "campaign")) from error
    return pyarrow


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """The folder of one campaign."""

    folder: Path
    campaign: Campaign
    size: int
    schema: pa.Schema

    @cached_property
    def parts(self) -> tuple[range, ...]:
        """Return the flights of every part; seeds that were added begin a new one."""
        found: list[range] = []
        first = 0
        for seeds in self.campaign.blocks:
            end = first + seeds * self.campaign.settings_count
            found += [range(at, min(at + self.size, end)) for at in range(first, end, self.size)]
            first = end
        return tuple(found)

    def flights_of(self, part: int) -> range:
        """Return the flights of a part."""
        return self.parts[part]

    def part_of(self, number: int) -> int:
        """Return the part of a flight."""
        return bisect_right(self.parts, number, key=lambda part: part.start) - 1

    def path_of(self, part: int) -> Path:
        """Return the file of a part."""
        return self.folder / FLIGHTS / f"part={part:05d}" / FILE

    def missing(self) -> list[int]:
        """Return the parts that are still to be flown."""
        return [part for part in range(len(self.parts)) if not self.path_of(part).is_file()]

    def row(self, number: int, figures: Mapping[str, Any], error: str | None) -> dict[str, Any]:
        """Return a row: the flight, its settings, its figures."""
        case, settings, seed = self.campaign.flight(number)
        given = dict(settings)
        varied = {name: _told(given.get(name)) for name in self.campaign.varied}
        return {
            "flight": number,
            "case": case,
            "point": self.campaign.place(number)[0],
            "seed": seed,
            **varied,
            **figures,
            "error": error,
        }

    def write(self, part: int, rows: Sequence[Mapping[str, Any]]) -> None:
        """Write a part as a whole."""
        ordered = sorted(rows, key=lambda row: row["flight"])
        path = self.path_of(part)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, parquet_of(arrow().Table.from_pylist(ordered, schema=self.schema)))

    def log(self, entry: Mapping[str, Any]) -> None:
        """Add a line on how it went."""
        with (self.folder / LOG).open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry) + "\n")


def parquet_of(table: pa.Table) -> bytes:
    """Return a table as a file of Parquet."""
    content = io.BytesIO()
    arrow().parquet.write_table(
        table, content, compression="zstd", compression_level=3, version="2.6"
    )
    return content.getvalue()


def _told(value: Any) -> Any:
    """Return a setting as a column has it: a list as text."""
    return json.dumps(value) if isinstance(value, tuple) else value


def open_dataset(campaign: Campaign, bundle: Bundle, folder: Path) -> Dataset:
    """Begin the dataset of a campaign, or go on with it.

    Raises:
        ConfigError: the folder holds something else, or flights of another program or file.
    """
    arrow()
    before = read_manifest(folder) if (folder / MANIFEST).is_file() else None
    blocks: tuple[int, ...] = ()
    grows = False
    if before is not None:
        blocks = tuple(before.get("seed_blocks", [before["seeds"]]))
        grows = _is_continued(folder, campaign, sum(blocks))
    if before is None or grows:
        blocks += (len(campaign.seeds) - sum(blocks),)
    dataset = Dataset(
        folder=folder,
        campaign=replace(campaign, blocks=blocks),
        size=part_size(campaign.flights) if before is None else before["part_flights"],
        schema=_schema(campaign),
    )
    manifest = {
        "format": FORMAT,
        "name": campaign.name,
        "campaign_sha256": campaign.sha256,
        "design": campaign.kind,
        "flights": campaign.flights,
        "settings": campaign.settings_count,
        "seeds": len(campaign.seeds),
        "seed_blocks": list(blocks),
        "part_flights": dataset.size,
        "varied": list(campaign.varied),
        "columns": {field.name: str(field.type) for field in dataset.schema},
        "files": bundle.hashes(),
        "versions": versions(),
        "code_sha256": code_sha256(),
        "simulated": True,
    }
    text = json.dumps(manifest, indent=1, sort_keys=True) + "\n"
    with writing(f"--out {folder}"):
        if before is not None:
            _refuse_other(folder, before, manifest, GROWING if grows else ())
            if not grows:
                return dataset
        elif folder.is_dir() and any(folder.iterdir()):
            raise ConfigError(f"--out {folder}: holds other files; give a new folder")
        (folder / FLIGHTS).mkdir(parents=True, exist_ok=True)
        write_atomically(folder / COPY, campaign.text.encode())
        write_atomically(folder / MANIFEST, text.encode())
    return dataset


def _is_continued(folder: Path, campaign: Campaign, flown: int) -> bool:
    """Return whether a campaign is the one of a folder but for seeds behind its own."""
    was = read_campaign(folder / COPY, checked=False)
    same = replace(was, path=campaign.path, text=campaign.text, name=campaign.name,
                   seeds=campaign.seeds) == campaign  # fmt: skip
    return same and len(campaign.seeds) > flown and was.seeds[:flown] == campaign.seeds[:flown]


def _refuse_other(
    folder: Path, before: Mapping[str, Any], manifest: Mapping[str, Any], growing: Sequence[str]
) -> None:
    for key, value in manifest.items():
        if before.get(key) != value and key not in growing:
            raise ConfigError(
                f"--out {folder}: holds flights with another {key} (see its {MANIFEST}), which do "
                "not go with these; give another --out, or change nothing but add seeds behind "
                "the others"
            )


def read_manifest(folder: Path) -> dict[str, Any]:
    """Read what a folder's rows are rows of.

    Raises:
        ConfigError: it is no campaign's folder.
    """
    path = folder / MANIFEST
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(found, dict) or found.get("format") != FORMAT:
            raise ValueError("of another format")
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise ConfigError(
            f"{path}: no campaign's manifest ({reason}); give the folder that `vrspray campaign` "
            "wrote"
        ) from error
    return found


def read_columns(folder: Path, names: Sequence[str] | None) -> pa.Table:
    """Return some columns, or all, of the rows that there are, in the order of their flights.

    Raises:
        ConfigError: a part is damaged.
    """
    pa = arrow()
    import pyarrow.parquet as pq

    tables = []
    for path in sorted((folder / FLIGHTS).glob(f"part=*/{FILE}")):
        try:
            tables.append(pq.ParquetFile(path).read(columns=None if names is None else list(names)))
        except (OSError, pa.ArrowException) as error:
            raise ConfigError(
                f"{path}: damaged ({error}); delete it and run the campaign again"
            ) from error
    if not tables:
        raise ConfigError(f"{folder}: no flight is written yet; run the campaign first")
    return pa.concat_tables(tables)


def _schema(campaign: Campaign) -> pa.Schema:
    import pyarrow as pa

    kinds = {int: pa.int64(), float: pa.float64(), str: pa.string(), bool: pa.bool_()}
    fields = [(name, kinds[kind]) for name, kind in BEFORE.items()]
    fields += [(name, kinds[_kind_of(campaign, name)]) for name in campaign.varied]
    fields += [(name, kinds[kind]) for name, kind in figure_types().items()]
    fields += [(name, pa.list_(pa.float64())) for name in BY_RATE]
    fields += [(name, pa.list_(pa.int64())) for name in BY_RATE_COUNTS]
    fields += [(name, kinds[kind]) for name, kind in AFTER.items()]
    return pa.schema(fields)


def _kind_of(campaign: Campaign, name: str) -> type:
    """Return the type of a setting's column: of all values that it has, or text."""
    kinds = {type(given[name]) for given in campaign.tried() if name in given}
    if kinds <= {int, float}:
        return float if float in kinds else int
    if len(kinds) == 1 and kinds <= {str, bool}:
        return kinds.pop()
    return str
