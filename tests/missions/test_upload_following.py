"""All sorties of a plan: which files they are, when one is flown, and that each waits for it."""

from __future__ import annotations

import json
from collections.abc import AsyncGenerator, Sequence
from pathlib import Path

import pytest

from companion.cli.app import execute
from missions.errors import UploadError
from missions.upload.transfer import Flight, Seen, each_when_flown, sorties_from
from tests.missions.test_missions_cli import written

GROUND, LAST = Seen(is_armed=False, sequence=0), 9


def air(sequence: int | None) -> Seen:
    return Seen(is_armed=True, sequence=sequence)


def landings(seen: Sequence[Seen]) -> list[bool]:
    """Return at each landing whether the sortie is flown."""
    flight = Flight(last=LAST)
    return [flight.is_flown for each in seen if flight.take(each)]


@pytest.mark.parametrize(
    ("seen", "flown"),
    [
        ([GROUND, GROUND], []),
        ([GROUND, air(1), air(9), GROUND], [True]),
        # It says the first item again once it has landed, and the last before it took off.
        ([Seen(is_armed=False, sequence=9), air(0), air(4), GROUND], [False]),
        ([air(9), Seen(is_armed=False, sequence=0), GROUND], [True]),
        ([air(4), GROUND, air(4), air(9), GROUND], [False, True]),
        ([air(None), GROUND], [False]),
    ],
)
def test_a_sortie_is_flown_when_it_landed_behind_its_last_item(
    seen: list[Seen], flown: list[bool]
) -> None:
    assert landings(seen) == flown


class Told:
    """A vehicle that tells what it is given, and keeps what happened in order."""

    def __init__(self, *seen: Seen) -> None:
        self.happened: list[str] = []
        self._seen = list(seen)

    async def watch(self) -> AsyncGenerator[Seen, None]:
        while self._seen:
            seen = self._seen.pop(0)
            self.happened.append("air" if seen.is_armed else "ground")
            yield seen

    async def upload(self, path: Path) -> None:
        self.happened.append(path.name)


async def test_each_sortie_waits_for_the_one_before() -> None:
    vehicle = Told(GROUND, air(3), GROUND, air(9), GROUND, GROUND, air(5), GROUND)
    said: list[str] = []
    files = [(Path("m.plan"), 9), (Path("m-2.plan"), 5), (Path("m-3.plan"), 7)]
    await each_when_flown(vehicle, files, vehicle.upload, say=said.append)
    assert vehicle.happened == [
        "m.plan", "ground", "air", "ground", "air", "ground",
        "m-2.plan", "ground", "air", "ground",
        "m-3.plan",
    ]  # fmt: skip
    assert said[0] == "m.plan may be flown; m-2.plan follows when it is flown and disarmed"
    assert "landed at item 3 of 9: the sortie is not flown to its end" in said[1]
    assert len(said) == 3


def plan_of(tmp_path: Path, name: str, tank_l: int) -> list[str]:
    from shapely import box

    field = written(box(0, 0, 100, 60), tmp_path / "f.geojson")
    words = ["--rate-l-ha", "20", "--tank-l", str(tank_l), "--out", str(tmp_path / name)]
    assert execute(["plan", "--force", str(field), *words]) == 0
    return sorted(path.name for path in tmp_path.glob("*.plan"))


def test_the_files_of_a_plan_are_its_own_and_not_those_of_a_longer_one_before(
    tmp_path: Path,
) -> None:
    plan_of(tmp_path, "north-2.plan", 4)
    third = (tmp_path / "north-2-3.plan").read_bytes()
    plan_of(tmp_path, "north-2.plan", 8)
    (tmp_path / "north-2-3.plan").write_bytes(third)  # as one that was copied back
    found = sorties_from(tmp_path / "north-2.plan")
    assert [path.name for path in found] == ["north-2.plan", "north-2-2.plan"]
    later = sorties_from(tmp_path / "north-2-2.plan")
    assert [path.name for path in later] == ["north-2-2.plan"]
    with pytest.raises(UploadError, match="has 2 sorties; this is a file of another plan"):
        sorties_from(tmp_path / "north-2-3.plan")


def test_a_missing_file_is_named_before_anything_is_sent(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    plan_of(tmp_path, "m.plan", 8)
    (tmp_path / "m-2.plan").unlink()
    with pytest.raises(UploadError, match=r"m-2\.plan is missing"):
        sorties_from(tmp_path / "m.plan")
    (tmp_path / "m.lines.geojson").write_text(json.dumps({"features": [3]}))
    words = ["upload", str(tmp_path / "m.plan"), "--link", "udpin:127.0.0.1:14550", "--all"]
    assert execute(words) == 2
    assert "--all needs m.lines.geojson beside it" in capsys.readouterr().err
    assert execute([*words, "--while-armed"]) == 2
