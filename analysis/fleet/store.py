"""The fleet's files: Parquet in folders by kind and month, here or in an object store.

Nothing is locked. A writer puts down a new file, which holds what it read and what it adds, and
then removes the files that it read. Two writers at once leave two files with the same flights in
them, of which readers take the record that counts, and the next writer joins. A file is named by
what is in it, so the same flights make the same folder, in whatever order they came.
"""

from __future__ import annotations

import hashlib
import io
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq
from fsspec.core import url_to_fs

from analysis.fleet.jobs import counted_once
from analysis.fleet.row import COLUMNS, ROW_VERSION, Problem, Row, newest
from companion.atomic_write import write_atomically
from companion.errors import ConfigError

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem

_TYPES: dict[str, pa.DataType] = {
    "text": pa.string(),
    "whole number": pa.int64(),
    "number": pa.float64(),
    "yes or no": pa.bool_(),
    "time": pa.timestamp("us", tz="UTC"),
    "closings": pa.list_(
        pa.struct([("reason", pa.string()), ("count", pa.int64()), ("seconds", pa.float64())])
    ),
    "faults": pa.list_(pa.struct([("kind", pa.string()), ("count", pa.int64())])),
    "valves": pa.list_(pa.struct([("valve", pa.string()), ("flow_factor", pa.float64())])),
}
PARTED_BY = ("kind", "month")
# `ground` is what `analysis.fleet.jobs` counts, and nobody is asked for it.
SCHEMA = pa.schema([*((each.name, _TYPES[each.type]) for each in COLUMNS), ("ground", pa.binary())])
_IN_FILE = pa.schema([field for field in SCHEMA if field.name not in PARTED_BY])
_PARTING = ds.partitioning(pa.schema([(name, pa.string()) for name in PARTED_BY]), flavor="hive")
DAMAGED_SCHEMA = pa.schema(
    [(name, pa.string()) for name in ("journal", "journal_sha256", "flight_id", "problem")]
)
FLIGHTS, DAMAGED, FORGOTTEN = "flights", "damaged", "forgotten"
# What `vrspray campaign` puts beside a folder `flights` of its own.
_CAMPAIGN = ("manifest.json", "campaign.toml")
# A file that was listed may be gone when it is opened: somebody has joined it with others.
TRIES = 8
_ROWS_A_GROUP = 50_000

# What fails in a store, by the libraries of all of them.
STORE_ERRORS = (OSError, pa.ArrowException)


class Known(NamedTuple):
    """What is kept of a flight, as far as another `add` has to know it."""

    record_version: str
    journal_sha256: str
    is_evaluated: bool
    is_current: bool
    machine: str | None
    folder: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """What a writer changed: flights by their numbers."""

    added: frozenset[str] = frozenset()
    replaced: frozenset[str] = frozenset()


class Store:
    """A fleet's folder, on a disk or in an object store."""

    def __init__(self, url: str, fs: AbstractFileSystem, root: str) -> None:
        self.url, self.fs, self.root = url, fs, root.rstrip("/")
        self._is_local = "file" in (
            fs.protocol if isinstance(fs.protocol, tuple) else (fs.protocol,)
        )

    @classmethod
    def at(cls, url: str) -> Store:
        """Return the store at a folder or an fsspec URL; else a ConfigError."""
        try:
            fs, root = url_to_fs(str(Path(url).absolute()) if "://" not in url else url)
        except (ImportError, ValueError, OSError) as error:
            raise ConfigError(
                f"{url}: {_line(error)}; give a folder, or a URL of a store whose fsspec package "
                "is installed"
            ) from error
        return cls(url, fs, root)

    def existing(self) -> Store:
        """Return itself where flights are in it; else a ConfigError."""
        try:
            self.refuse_campaign()
            if self._files(FLIGHTS) or self._files(DAMAGED):
                return self
        except STORE_ERRORS as error:
            raise self.refused(error) from error
        raise ConfigError(
            f"{self.url}: no flights are there; add some: vrspray fleet add JOURNAL --into "
            f"{self.url}"
        )

    def refuse_campaign(self) -> None:
        """Refuse the folder of a campaign, whose `flights` are another table; a ConfigError."""
        if all(self.fs.exists(f"{self.root}/{name}") for name in _CAMPAIGN):
            raise ConfigError(
                f"{self.url}: holds the flights of a campaign; give a fleet's folder, or see it "
                f"with: vrspray campaign show {self.url}"
            )

    def refused(self, error: Exception) -> ConfigError:
        """Return what a store said as the error that all commands report."""
        return ConfigError(f"{self.url}: {_line(error)}; give a fleet's folder that can be used")

    def dataset(self) -> ds.Dataset:
        """Return all files of flights; nothing of them is read yet."""
        return self._dataset(self._files(FLIGHTS))

    def _dataset(self, files: Sequence[str]) -> ds.Dataset:
        return ds.dataset(
            list(files),
            schema=SCHEMA,
            format="parquet",
            filesystem=self.fs,
            partitioning=_PARTING,
            partition_base_dir=f"{self.root}/{FLIGHTS}",
        )

    def known(self) -> dict[str, Known]:
        """Return what is kept, by the number of the flight."""
        columns = ["flight_id", "record_version", "journal_sha256", "is_evaluated", "machine"]
        table = self._again(lambda: self.dataset().to_table([*columns, *PARTED_BY]))
        found = {}
        for row in newest(table.to_pylist()).values():
            # The third part of a version is that of the row itself.
            is_current = int(row["record_version"].split(".")[2]) == ROW_VERSION
            found[row["flight_id"]] = Known(
                row["record_version"],
                row["journal_sha256"],
                row["is_evaluated"],
                is_current,
                row["machine"],
                _folder(row),
            )
        return found

    def merge(self, rows: Iterable[Row], known: Mapping[str, Known]) -> Change:
        """Write flights; an earlier record of the same flight goes, wherever it is."""
        forgotten = self._forgotten()
        kept = (each for row in rows if (each := _without(row, forgotten)) is not None)
        better = {
            key: row
            for key, row in newest(kept).items()
            if key not in known or known[key].record_version < row["record_version"]
        }
        change = Change(
            added=frozenset(better.keys() - known.keys()),
            replaced=frozenset(better.keys() & known.keys()),
        )
        better |= self._of_their_jobs(better.values())
        by_folder: dict[str, list[Row]] = defaultdict(list)
        gone: dict[str, set[str]] = defaultdict(set)
        for key, row in better.items():
            by_folder[_folder(row)].append(row)
            if key in known and known[key].folder != _folder(row):
                gone[known[key].folder].add(key)
        # First what is new, then what it takes the place of: a cut in between loses nothing.
        for folder, new in sorted(by_folder.items()):
            self._rewrite(folder, new)
        for folder, keys in sorted(gone.items()):
            self._rewrite(folder, [], without=keys)
        return change

    def _of_their_jobs(self, new: Collection[Row]) -> dict[str, Row]:
        """Return all flights of the jobs of new ones, whose ground is counted together."""
        ids = {row["job"] for row in new if row.get("ground")}
        if not ids:
            return {}
        there = self._again(
            lambda: self.dataset().to_table(filter=ds.field("job").isin(ids)).to_pylist()
        )
        by_job: dict[tuple[str, str], list[Row]] = defaultdict(list)
        for row in newest([*new, *there]).values():
            by_job[row["kind"], row["job"]].append(row)
        return {row["flight_id"]: row for rows in by_job.values() for row in counted_once(rows)}

    def forget(self, operator: str, *, with_flights: bool) -> int:
        """Remove an operator from every file, and keep him out; return of how many flights."""
        marker = f"{self.root}/{FORGOTTEN}/{_marker(operator, with_flights=with_flights)}"
        if not self.fs.exists(marker):
            self._put(marker, b"")
        table = self._again(
            lambda: self.dataset().to_table(
                ["flight_id", *PARTED_BY], filter=ds.field("operator") == operator
            )
        )
        rows = table.to_pylist()
        keys = {row["flight_id"] for row in rows}
        for folder in sorted({_folder(row) for row in rows}):
            self._rewrite(folder, [], without=keys if with_flights else ())
        return len(keys)

    def damaged(self) -> list[dict[str, str]]:
        """Return the journals that gave no row, and of which no other copy did since."""
        files = self._files(DAMAGED)
        if not files:
            return []
        rows = self._again(lambda: self._tables(self._files(DAMAGED), DAMAGED_SCHEMA)).to_pylist()
        table = self._again(lambda: self.dataset().to_table(["flight_id"]))
        there = set(table["flight_id"].to_pylist())
        return [row for row in rows if row["flight_id"] not in there]

    def list_damaged(self, problems: Iterable[Problem]) -> None:
        """Keep which journals are damaged; one that is listed already is no news."""
        old = self._files(DAMAGED)
        rows = self._tables(old, DAMAGED_SCHEMA).to_pylist() if old else []
        rows += [
            {
                "journal": each.path.name,
                "journal_sha256": each.journal_sha256,
                "flight_id": each.flight_id,
                "problem": each.text,
            }
            for each in problems
            if each.is_damaged
        ]
        by_place = {_damaged_key(row): row for row in rows}
        found = [by_place[key] for key in sorted(by_place)]
        if found:
            self._replace(
                f"{self.root}/{DAMAGED}", old, pa.Table.from_pylist(found, DAMAGED_SCHEMA)
            )

    # Files.

    def _files(self, name: str, folder: str = "") -> list[str]:
        """Return the files of a table, or of one folder of it; none where nothing was written."""
        self.fs.invalidate_cache()
        place = f"{self.root}/{name}" + (f"/{folder}" if folder else "")
        found = self.fs.find(place)
        return sorted(each for each in found if _is_part(each))

    def _tables(self, files: Sequence[str], schema: pa.Schema) -> pa.Table:
        tables = []
        for each in files:
            with self.fs.open(each, "rb") as file:
                tables.append(pq.ParquetFile(file).read())
        wanted = [_as(table, schema) for table in tables]
        return pa.concat_tables(wanted) if wanted else schema.empty_table()

    def _rewrite(self, folder: str, new: Sequence[Row], without: Iterable[str] = ()) -> None:
        """Join the files of a folder and what is new into one."""
        for _ in range(TRIES):
            files = self._files(FLIGHTS, folder)
            with suppress(FileNotFoundError):
                old = self._tables(files, _IN_FILE).to_pylist()
                break
        else:
            raise FileNotFoundError(f"{folder}: others write it without an end")
        left, forgotten = frozenset(without), self._forgotten()
        rows = [
            kept
            for row in newest([*new, *old]).values()
            if row["flight_id"] not in left and (kept := _without(row, forgotten)) is not None
        ]
        rows.sort(key=lambda row: (str(row["started_utc"]), row["flight_id"]))
        place = f"{self.root}/{FLIGHTS}/{folder}"
        self._replace(place, files, pa.Table.from_pylist(rows, _IN_FILE))
        # Who was forgotten meanwhile must not come back by what was read before.
        if self._forgotten() != forgotten:
            self._rewrite(folder, ())

    def _forgotten(self) -> frozenset[str]:
        self.fs.invalidate_cache()
        found = self.fs.find(f"{self.root}/{FORGOTTEN}")
        return frozenset(each.rpartition("/")[2] for each in found)

    def _replace(self, place: str, old: Sequence[str], table: pa.Table) -> None:
        """Write a table as the only file of a place; first the new file, then the old ones go."""
        path = ""
        if len(table):
            content = _parquet(table)
            path = f"{place}/part-{hashlib.sha256(content).hexdigest()[:20]}.parquet"
            if path not in old:
                self._put(path, content)
        for each in old:
            if each != path:
                with suppress(FileNotFoundError):
                    self.fs.rm_file(each)

    def _put(self, path: str, content: bytes) -> None:
        """Write a file that is there as a whole or not at all."""
        if self._is_local:
            Path(path).parent.mkdir(parents=True, exist_ok=True)
            write_atomically(Path(path), content)
        else:
            self.fs.pipe_file(path, content)

    def _again(self, read: Callable[[], Any]) -> Any:
        for _ in range(TRIES - 1):
            with suppress(FileNotFoundError):
                return read()
        return read()


def _damaged_key(row: Mapping[str, Any]) -> tuple[str, str]:
    """Return what a damaged journal is known by: empty ones have the same content."""
    return row["journal"], row["journal_sha256"]


def _folder(row: Mapping[str, Any]) -> str:
    return "/".join(f"{name}={row[name]}" for name in PARTED_BY)


def _is_part(path: str) -> bool:
    """Return whether a file is one of ours; drafts of others have a dot before their name."""
    name = path.rpartition("/")[2]
    return name.startswith("part-") and name.endswith(".parquet")


def _marker(operator: str, *, with_flights: bool) -> str:
    """Return the name of the file that says that an operator is forgotten: not his number."""
    digest = hashlib.sha256(f"forgotten {operator}".encode()).hexdigest()[:32]
    return f"{digest}-flights" if with_flights else digest


def _without(row: Row, forgotten: frozenset[str]) -> Row | None:
    """Return a row without an operator who is forgotten; None where his flights are."""
    operator = row["operator"]
    if operator is None:
        return row
    if _marker(operator, with_flights=True) in forgotten:
        return None
    return {**row, "operator": None} if _marker(operator, with_flights=False) in forgotten else row


def _as(table: pa.Table, schema: pa.Schema) -> pa.Table:
    """Return a table of another version with today's columns: what it lacks is missing."""
    columns = [
        table[field.name].cast(field.type)
        if field.name in table.column_names
        else pa.nulls(len(table), field.type)
        for field in schema
    ]
    return pa.table(columns, schema=schema)


def _parquet(table: pa.Table) -> bytes:
    sink = io.BytesIO()
    pq.write_table(table, sink, compression="zstd", row_group_size=_ROWS_A_GROUP)
    return sink.getvalue()


def _line(error: Exception) -> str:
    text = getattr(error, "strerror", None) or " ".join(str(error).split())
    return str(text or type(error).__name__)[:300]
