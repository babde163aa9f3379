"""A campaign's file: what is refused of it, and which flights its design names."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.cli.app import execute
from companion.errors import ConfigError
from sitl.campaign.design import read_campaign
from sitl.campaign.flying import fly_flight
from sitl.profile import PROFILES
from tests.sitl.campaign_files import VARIED, designed, write_campaign


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("seed = 3", "seed = 3: unknown key; did you mean seeds?"),
        ("seeds = 0", "seeds: count = 0: out of range; write a whole number from 1 to"),
        ('[[vary]]\nset = "vehicle.gusts_m_s"\nvalues = [1]', "did you mean vehicle.gust_m_s?"),
        ('[[vary]]\nset = "engine.power"\nvalues = [1]', "engine.power: no such setting"),
        ('[[vary]]\nset = "plant.dead_opens_s"\nvalues = [1]', "did you mean plant.dead_open_s?"),
        ('[[vary]]\nset = "config.lag.on_ss"\nvalues = [1]', "did you mean lag.on_s?"),
        ('[[vary]]\nset = "config.lag.on_s"\nvalues = [-1]', "the configuration refuses it"),
        ('[[vary]]\nset = "vehicle.gust_m_s"\nvalues = [-1]', "write a number from 0 to 20"),
        ('[[vary]]\nset = "flight.fidelity"\nvalues = ["x"]', "choose of averaged, pulsed"),
        ('[[vary]]\nset = "vehicle.gust_m_s"', "give values, or low and high"),
        ('[[vary]]\nset = "vehicle.gust_m_s"\nlow = 2\nhigh = 1', "low = 2 must be below high = 1"),
        ('[[vary]]\nset = "vehicle.gust_m_s"\nlow = 1\nhigh = 2', "a grid needs values"),
        ('[design]\nkind = "random"', 'write one of "grid", "latin-hypercube", "sobol", "morris"'),
        ('[design]\nkind = "sobol"\nsamples = 8', "nothing is varied; add [[vary]] tables"),
        ('[[case]]\nname = "a"\n[[case]]\nname = "a"', "another case has this name"),
        ("[[case]]\nerror.along_m = 0.1", "error.along_m: on the published field only"),
        ("[[case]]\nplant.known = true", "plant.known: on the published field only"),
        ('[[case]]\nflight.scenario = "no.toml"', "no such file"),
        ("seeds = [1", "Unclosed array"),
        ("seeds = [1, true]", "seeds = [1, True]: write whole numbers"),
        ("seeds = [1, 1]", "seeds: one of them stands there twice"),
        ("seeds = {first = 3}", "seeds: count: missing; write a whole number from 1 to"),
        ('[[vary]]\nset = "vehicle.gust_m_s"\nlow = 1', "give values, or low and high"),
        ("seeds = 100000000000", "out of range; write a whole number from 1 to 1e+07"),
        ('[[vary]]\nset = "flight.config"\nvalues = ["a.toml"]', "varied twice; keep one"),
        ('seeds = 4000\n[[vary]]\nset = "vehicle.gust_m_s"\nlow = 0\nhigh = 9\nsteps = 5000',
         "more than 10,000,000 flights"),
    ],
)  # fmt: skip
def test_a_file_that_cannot_be_flown_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, said: str
) -> None:
    file = write_campaign(tmp_path, text + "\n")
    assert execute(["campaign", str(file), "--dry-run"]) == 2
    line = capsys.readouterr().err.strip()
    assert line.startswith(f"error: {file}: ") or said == "no such file"
    assert said in line and "\n" not in line


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            'flight.field = "sway"\nvehicle.speed_m_s = 5',
            "vehicle.speed_m_s: 'sway' has its own; leave it out",
        ),
        ("config.safety.speed_max_m_s = 2.0", "changes nothing over the published field"),
        ('flight.field = "swing"', "choose of published, edges-15"),
    ],
)
def test_a_hard_condition_is_flown_in_its_own_way(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, said: str
) -> None:
    file = tmp_path / "hard.toml"
    file.write_text(f"version = 1\n[fixed]\n{text}\n", "utf-8")
    assert execute(["campaign", str(file), "--dry-run"]) == 2
    line = capsys.readouterr().err.strip()
    assert said in line and "\n" not in line


def test_a_sprayer_whose_lags_nobody_measured_cannot_be_known(tmp_path: Path) -> None:
    name = next(
        path.stem
        for path in sorted(PROFILES.glob("*.toml"))
        if path.stem != "wang-2024" and not (PROFILES / "lags" / f"{path.stem}-gpio.toml").exists()
    )
    given = (("plant.known", True), ("plant.profile", name))
    with pytest.raises(ConfigError, match=f"no lags were measured of {name}; leave it out"):
        fly_flight(given, 1, tmp_path)


def test_a_latin_hypercube_has_each_share_of_a_setting_once(tmp_path: Path) -> None:
    campaign = designed(tmp_path, "latin-hypercube", 10)
    assert campaign.flights == 20
    flights = [campaign.flight(number) for number in range(0, 20, 2)]
    gusts = [dict(settings)["vehicle.gust_m_s"] for _, settings, _ in flights]
    assert sorted(int((gust - 1.0) / 0.2) for gust in gusts) == list(range(10))  # type: ignore[operator]
    words = [dict(settings)["flight.fidelity"] for _, settings, _ in flights]
    assert words.count("pulsed") == 5
    assert [campaign.flight(number)[2] for number in range(4)] == [5, 6, 5, 6]
    again = read_campaign(campaign.path)
    assert [again.flight(number) for number in (19, 0)] == [
        campaign.flight(19),
        campaign.flight(0),
    ]


@pytest.mark.parametrize(("kind", "samples", "points"), [("sobol", 8, 32), ("morris", 7, 21)])
def test_designs_for_sensitivity_have_their_number_of_points(
    tmp_path: Path, kind: str, samples: int, points: int
) -> None:
    assert designed(tmp_path, kind, samples).settings_count == points


def test_a_flight_needs_no_other_flight_before_it(tmp_path: Path) -> None:
    campaign = read_campaign(write_campaign(tmp_path, VARIED))
    folder = tmp_path
    one = fly_flight(*campaign.flight(9)[1:], folder).figures
    fly_flight(*campaign.flight(1)[1:], folder)
    assert fly_flight(*campaign.flight(9)[1:], folder).figures == one


MARK = """
from pathlib import Path

Path({mark!r}).touch()


class Own:
    def __init__(self, sprayer):
        pass

    def order(self, seen):
        return None
"""


@pytest.mark.parametrize(
    "where",
    [
        '[[case]]\nname = "a"\n[[case]]\nname = "b"\nmethod.controller = "{name}"\n',
        '[[vary]]\nset = "method.controller"\nvalues = ["{name}"]\n',
    ],
)
@pytest.mark.parametrize("form", ["own.py:Own", "{folder}/own.py:Own", "own:Own"])
def test_code_that_a_file_names_runs_by_the_users_word_alone(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    where: str,
    form: str,
) -> None:
    mark, name = tmp_path / "it-ran", form.format(folder=tmp_path)
    file = write_campaign(tmp_path, where.format(name=name))
    (tmp_path / "own.py").write_text(MARK.format(mark=str(mark)))
    monkeypatch.chdir(tmp_path)
    given = ["campaign", str(file), "--workers", "1", "--out", str(tmp_path / "out")]
    assert execute(given) == 2
    line = capsys.readouterr().err.strip()
    assert f"{file}: method.controller = '{name}'" in line
    assert "--allow-code" in line and "\n" not in line
    assert execute([*given, "--dry-run"]) == 0
    assert f"needs --allow-code: it runs the code of {name}\n" in capsys.readouterr().out
    assert not mark.exists()
    if form == "own.py:Own":
        assert execute([*given, "--allow-code"]) == 0
        assert mark.exists()
