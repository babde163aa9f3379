"""`vrspray fleet query`, `report`, `serve`: right sums, no way out, nobody without a token."""

from __future__ import annotations

import asyncio
import csv
import io
import json
import socket
import sys
from pathlib import Path
from typing import Any

import pyarrow.csv as pa_csv
import pyarrow.parquet as pq
import pytest

from analysis.fleet import serving
from analysis.fleet.asking import asked
from analysis.fleet.flight_row import recorded
from analysis.fleet.page import body_of, charts_of
from analysis.fleet.row import Row
from analysis.fleet.serving import build_app
from analysis.fleet.store import Store
from analysis.fleet.summary import FIGURES, GROUPS, summary_of
from companion.cli.app import execute
from companion.web.guard import Doors, Guard, Tokens
from companion.web.places import Places
from tests.analysis.fleet_flights import TOLD, copied, damaged, started
from tests.analysis.report_flight import fly
from tests.companion.wire_peer import free_port

Captured = pytest.CaptureFixture[str]
TOKENS = Tokens(view="v" * 43, operate="o" * 43)


def made_up(row: Row, number: int, **changes: Any) -> Row:
    """Return another flight's row."""
    version = f"{number:012d}.3.0001.1.1.made-up"
    return {**row, "flight_id": f"{number:020d}", "record_version": version, **changes}


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a fleet of twelve real flights by two machines, one simulated, one damaged."""
    folder = tmp_path_factory.mktemp("fleet")
    journal = fly(tmp_path_factory.mktemp("flown"), told=dict(TOLD))
    row = recorded(journal)
    assert isinstance(row, dict)
    rows = []
    for number in range(12):
        month = 4 + number // 6
        rows.append(
            made_up(
                row,
                number,
                is_evaluated=number != 11,
                machine="<b>one</b>" if number % 3 else None,
                month=f"2026-{month:02d}",
                started_utc=row["started_utc"].replace(year=2026, month=month, day=1 + number),
                area_ha=1.0 + number,
                applied_l=20.0 * (1.0 + number),
                applied_by="flow meter" if number % 2 else "model",
                modelled_l=20.0,
                flow_drift_percent=0.1 * number,
                missed_m2=None if number == 11 else 100.0,
                changes=None if number == 11 else 10 * number,
                missed_changes=None if number == 11 else 1,
                apart_changes=None if number == 11 else 2,
                mean_lag_m=None if number in (0, 11) else 0.01 * number,
                closings=[{"reason": "leak", "count": 2, "seconds": 1.5}] if number < 3 else [],
                faults=[{"kind": "leak", "count": 1}] if number == 2 else [],
                valves=[{"valve": "1", "flow_factor": 1.02 - 0.01 * number}],
            )
        )
    rows.append(made_up(row, 99, kind="simulated", simulated="yes", area_ha=1000.0))
    store = Store.at(str(folder))
    store.merge(rows, {})
    problem = recorded(damaged(journal, folder / "flight-0007.gpkg"))
    assert not isinstance(problem, dict | str)
    store.list_damaged([problem])
    return folder


def run(capsys: Captured, *arguments: str) -> tuple[int, str, str]:
    code = execute(["fleet", *arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_each_kind_of_flight_has_its_own_part_of_the_page(
    fleet: Path, tmp_path: Path, capsys: Captured
) -> None:
    """By what the journals themselves say: product, water, dry, simulated, and nothing."""
    flown = fly(tmp_path / "flown", told=dict(TOLD))
    said = {
        1: {"training": "no", "simulated": "no"},
        2: {"training": "no", "simulated": "no"},
        3: {"training": "water", "simulated": "no"},
        4: {"training": "dry", "simulated": "no"},
        5: {"training": "simulated", "simulated": "yes"},
        6: {"training": "no", "simulated": "unknown"},
    }
    for day, meta in said.items():
        copied(flown, tmp_path / "in" / f"flight-000{day}.gpkg", {**started(day), **meta})
    place = str(tmp_path / "fleet")
    assert run(capsys, "add", str(tmp_path / "in"), "--into", place)[0] == 0
    out = tmp_path / "report"
    code, text, _ = run(capsys, "report", "--fleet", place, "--out", str(out), "--json")
    sections = {each["kind"]: each["totals"] for each in json.loads(text)["sections"]}
    assert code == 0
    assert {kind: sums["flights"] for kind, sums in sections.items()} == {
        "real": 2, "unknown": 1, "training": 2, "simulated": 1,
    }  # fmt: skip
    litres = {kind: sums["applied_l"] / sums["flights"] for kind, sums in sections.items()}
    assert litres == pytest.approx(dict.fromkeys(sections, litres["real"]))
    assert sections["real"]["metered_percent"] == 0.0  # no meter is none of the litres
    page = (out / "fleet.html").read_text()
    for text in (
        "Real flights (2)", "Training with water, and dry (2)", "No product was sprayed: water",
        "SIMULATED: nothing was sprayed", "perhaps none of these litres were sprayed",
        "0 % of the litres metered",
    ):  # fmt: skip
        assert text in page, text
    assert "in 30 days" not in page  # of two flights there is no trend


# ------------------------------------------------------------------------------------ SQL


def test_a_question_is_answered_as_a_table_and_as_json(fleet: Path, capsys: Captured) -> None:
    sql = (
        "SELECT kind, sum(missed_changes) AS missed, max(started_utc) AS last FROM flights "
        "GROUP BY 1 ORDER BY 1"
    )
    code, out, _ = run(capsys, "query", sql, "--fleet", str(fleet))
    assert code == 0
    assert out.splitlines()[0].split() == ["kind", "missed", "last"]
    assert out.splitlines()[1].split()[:2] == ["real", "11"]
    _, out, _ = run(capsys, "query", sql, "--fleet", str(fleet), "--json")
    found = json.loads(out)
    assert found["rows"][0]["missed"] == 11
    assert found["rows"][1]["missed"] is None
    assert found["rows"][0]["last"].startswith("2026-05-12T")


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".json"])
def test_an_answer_is_written_as_a_file(
    fleet: Path, tmp_path: Path, capsys: Captured, suffix: str
) -> None:
    out = tmp_path / f"answer{suffix}"
    sql = "SELECT flight_id, area_ha, closings FROM flights ORDER BY flight_id"
    code, text, _ = run(capsys, "query", sql, "--fleet", str(fleet), "--out", str(out))
    assert (code, text) == (0, f"{out}: 13 rows\n")
    if suffix == ".json":
        rows = json.loads(out.read_text())
    elif suffix == ".csv":
        rows = list(csv.DictReader(io.StringIO(out.read_text())))
        rows = [{**row, "closings": json.loads(row["closings"])} for row in rows]
    else:
        rows = pq.read_table(out).to_pylist()
    assert len(rows) == 13
    assert float(rows[2]["area_ha"]) == 3.0
    assert rows[0]["closings"] == [{"reason": "leak", "count": 2, "seconds": 1.5}]


@pytest.mark.parametrize(
    "sql",
    [
        "SELECT * FROM read_csv('/etc/passwd')",
        "SELECT * FROM '/etc/passwd'",
        "SELECT * FROM read_text('/etc/hostname')",
        "COPY flights TO 'stolen.csv'",
        "ATTACH 'other.db'",
        "INSTALL httpfs",
        "LOAD httpfs",
        "SET enable_external_access = true",
        "CREATE TABLE mine AS SELECT 1",
        "DROP VIEW flights",
        "SELECT 1; SELECT 2",
        "SELECT * FROM pragma_user_agent('x'",
        "SELEC 1",
        "SELECT nothing FROM flights",
        "",
    ],
)
def test_what_is_no_question_to_the_flights_is_refused_in_one_line(
    fleet: Path, capsys: Captured, sql: str
) -> None:
    code, out, err = run(capsys, "query", sql, "--fleet", str(fleet))
    assert (code, out) == (2, "")
    assert err.startswith("error: SQL: ")
    assert len(err.splitlines()) == 1


def test_an_unknown_table_is_answered_by_the_names_of_ours(fleet: Path, capsys: Captured) -> None:
    code, _, err = run(capsys, "query", "SELECT * FROM trips", "--fleet", str(fleet))
    assert (code, err) == (
        2,
        "error: SQL: Catalog Error: Table with name trips does not exist; the tables: flights, "
        "closings, faults, valves, damaged\n",
    )


def test_memory_has_a_limit(fleet: Path, capsys: Captured) -> None:
    sql = "SELECT list(a) FROM range(40000000) t(a)"
    code, _, err = run(capsys, "query", sql, "--fleet", str(fleet), "--memory-mb", "60")
    assert (code, err) == (
        2,
        "error: SQL: the query needs too much memory; allow more with --memory-mb\n",
    )


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("query", "SELECT 1", "--fleet", "{tmp}/none"), "no flights are there"),
        (("query", "SELECT 1", "--fleet", "gibberish://x"), "Protocol not known"),
        (("query", "SELECT 1", "--fleet", "{fleet}", "--out", "{tmp}/a.xlsx"), "no such format"),
        (("query", "SELECT 1", "--fleet", "{fleet}", "--out", "{tmp}/b/a.csv"), "not there"),
        (("report", "--fleet", "{fleet}", "--out", "{tmp}", "--from", "May"), "is not a month"),
        (("report", "--fleet", "{fleet}", "--out", "{tmp}", "--kind", "odd"), "no such kind"),
        (("serve", "--fleet", "{fleet}", "--tls-key", "{tmp}/k.pem"), "go together"),
    ],
)
def test_wrong_input_is_refused_in_one_line(
    fleet: Path, tmp_path: Path, capsys: Captured, arguments: tuple[str, ...], text: str
) -> None:
    code, _, err = run(capsys, *(each.format(fleet=fleet, tmp=tmp_path) for each in arguments))
    assert code == 2
    assert text in err
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize("is_terminal", [False, True])
def test_the_token_is_on_a_terminal_and_in_no_log(
    fleet: Path,
    tmp_path: Path,
    capsys: Captured,
    monkeypatch: pytest.MonkeyPatch,
    is_terminal: bool,
) -> None:
    def served(_store: object, _guard: object, listener: socket.socket, _tls: object) -> None:
        listener.close()

    monkeypatch.setattr(serving, "serve", served)
    monkeypatch.setattr(sys.stdout, "isatty", lambda: is_terminal)
    kept, port = tmp_path / "tokens.json", str(free_port(socket.SOCK_STREAM))
    place = ("--fleet", str(fleet), "--host", "0.0.0.0", "--port", port, "--tokens", str(kept))
    code, out, _ = run(capsys, "serve", *place)
    token = json.loads(kept.read_text())["view"]
    assert code == 0
    assert (token in out) == is_terminal
    assert (str(kept) in out) != is_terminal


# --------------------------------------------------------------------------------- report


def test_sums_are_those_of_the_rows(fleet: Path) -> None:
    with asked(Store.at(str(fleet))) as found:
        summary = summary_of(found)
    real, simulated = summary["sections"]
    assert (real["kind"], simulated["kind"]) == ("real", "simulated")
    numbers = range(12)
    judged = range(11)
    totals = real["totals"]
    assert totals["flights"] == 12
    assert totals["not_evaluated"] == 1
    assert totals["area_ha"] == pytest.approx(sum(1.0 + n for n in numbers))
    assert totals["applied_l"] == pytest.approx(20.0 * totals["area_ha"])
    metered = sum(20.0 * (1.0 + n) for n in numbers if n % 2)
    assert totals["metered_percent"] == pytest.approx(100.0 * metered / totals["applied_l"])
    treated_m2 = 1e4 * sum(1.0 + n for n in judged)
    assert totals["coverage_percent"] == pytest.approx(100.0 * treated_m2 / (treated_m2 + 1100.0))
    assert (totals["missed_changes"], totals["apart_changes"]) == (11, 22)
    lags = [(0.01 * n, 10 * n) for n in judged if n]
    mean_m = sum(lag * count for lag, count in lags) / sum(count for _, count in lags)
    assert totals["mean_lag_m"] == pytest.approx(mean_m)
    assert totals["flow_drift_percent"] == pytest.approx(0.55)
    assert (totals["closings"], totals["faults"]) == (6, 1)
    assert real["closings"][0] == {
        "kind": "real", "reason": "leak", "count": 6, "flights": 3, "seconds": 4.5,
    }  # fmt: skip
    assert [(each["name"], each["flights"]) for each in real["groups"]["machine"]] == [
        ("<b>one</b>", 8), ("not named", 4),
    ]  # fmt: skip
    assert [each["name"] for each in real["groups"]["month"]] == ["2026-04", "2026-05"]
    for rows in real["groups"].values():
        assert sum(each["area_ha"] for each in rows) == pytest.approx(totals["area_ha"])
    valve = next(each for each in real["valves"] if each["machine"] == "not named")
    assert valve["drift_percent"] == pytest.approx(100.0 * (0.93 / 1.02 - 1.0))


def test_a_trend_is_the_slope_of_the_flights(fleet: Path) -> None:
    with asked(Store.at(str(fleet))) as found:
        (april, _) = summary_of(found)["sections"][0]["groups"]["month"]
    # Five flights with a lag, each a day later and 0.01 m worse.
    assert april["lag_trend_m_30_days"] == pytest.approx(0.3)
    assert april["flow_drift_trend_30_days"] == pytest.approx(3.0)


def test_the_report_is_written_in_all_its_forms(
    fleet: Path, tmp_path: Path, capsys: Captured
) -> None:
    out = tmp_path / "report"
    arguments = ["report", "--fleet", str(fleet), "--out", str(out), "--from", "2026-05", "--json"]
    code, text, _ = run(capsys, *arguments)
    assert code == 0
    written = json.loads((out / "fleet.json").read_text())
    assert written["sections"][0]["totals"]["flights"] == 6
    assert {key: json.loads(text)[key] for key in written} == written
    for group in GROUPS:
        table = pq.read_table(out / f"by-{group}.parquet")
        assert table.column_names == ["kind", group, *(each.name for each in FIGURES)]
        assert len(pa_csv.read_csv(out / f"by-{group}.csv")) == len(table)
    page = (out / "fleet.html").read_text()
    assert "&lt;b&gt;one&lt;/b&gt;" in page
    assert "<b>one</b>" not in page
    assert "flight-0007.gpkg" in page
    assert page.count("</script>") == 1


def test_simulated_flights_are_marked_and_never_summed_with_real_ones(fleet: Path) -> None:
    with asked(Store.at(str(fleet))) as found:
        summary = summary_of(found)
    assert summary["sections"][0]["totals"]["area_ha"] < 1000.0
    assert "SIMULATED: nothing was sprayed." in body_of(summary)


def test_a_chart_escapes_what_it_names() -> None:
    months = [
        {
            "name": name,
            "area_ha": area,
            "mean_lag_m": None,
            "flow_drift_percent": -1.0,
            "closings": 0,
        }
        for name, area in (("<a>", 1.0), ("b", 2.0))
    ]
    charts = charts_of(months)
    assert len(charts) == 3
    assert all("<a>" not in each and "style=" not in each for each in charts)


# ---------------------------------------------------------------------------------- serve


def ask(app: Any, method: str, path: str, body: bytes = b"", **headers: str) -> Any:
    """Return status, headers and body of one request, without a socket."""
    given = {"host": "192.168.1.5:8881", **{k.replace("_", "-"): v for k, v in headers.items()}}
    place, _, query = path.partition("?")
    scope = {
        "type": "http", "http_version": "1.1", "method": method, "scheme": "http",
        "path": place, "raw_path": place.encode(), "query_string": query.encode(), "root_path": "",
        "headers": [(k.encode(), v.encode()) for k, v in given.items()],
        "client": ("192.168.1.9", 40000), "server": ("192.168.1.5", 8881),
    }  # fmt: skip
    sent: list[Any] = []

    async def receive() -> Any:
        return {"type": "http.request", "body": body, "more_body": False}

    async def send(message: Any) -> None:
        sent.append(message)

    asyncio.run(app(scope, receive, send))
    found = {k.decode(): v.decode() for k, v in sent[0]["headers"]}
    return sent[0]["status"], found, b"".join(each.get("body", b"") for each in sent[1:])


@pytest.fixture(scope="module")
def app(fleet: Path) -> Any:
    guard = Guard(doors=Doors(is_local=False), tokens=TOKENS, printed_by="vrspray fleet serve")
    return build_app(Store.at(str(fleet)), guard, Places())


@pytest.mark.parametrize("path", ["/api/v1/fleet", "/api/v1/files/fleet.json"])
def test_nothing_of_the_fleet_is_told_without_a_token(app: Any, path: str) -> None:
    status, _, body = ask(app, "GET", path)
    assert status == 401
    assert b"vrspray fleet serve" in body
    assert ask(app, "GET", path, authorization="Bearer wrong")[0] == 401
    assert ask(app, "GET", path, host="evil.example")[0] == 421
    assert ask(app, "GET", path, authorization=f"Bearer {TOKENS.view}")[0] == 200


def test_a_token_opens_a_session_for_the_page(app: Any) -> None:
    status, headers, body = ask(app, "GET", "/")
    assert status == 200
    assert b"flight" in body
    assert b"T40" not in body
    assert "script-src 'self'" in headers["content-security-policy"]
    login = json.dumps({"token": TOKENS.view}).encode()
    origin = {"origin": "http://192.168.1.5:8881", "content_type": "application/json"}
    status, headers, _ = ask(app, "POST", "/api/v1/session", login, **origin)
    assert status == 200
    assert "HttpOnly" in headers["set-cookie"]
    cookie = headers["set-cookie"].partition(";")[0]
    status, _, body = ask(app, "GET", "/api/v1/fleet?from=2026-05&kind=real", cookie=cookie)
    assert status == 200
    found = json.loads(body)
    assert "6 flights" in found["html"]
    assert "style=" not in found["html"]
    assert "<script" not in found["html"]
    status, headers, body = ask(app, "GET", "/api/v1/files/by-machine.csv", cookie=cookie)
    assert status == 200
    assert headers["content-disposition"] == 'attachment; filename="by-machine.csv"'
    assert body.startswith(b'"kind","machine"')


def test_the_page_is_read_only(app: Any, fleet: Path) -> None:
    token = {"authorization": f"Bearer {TOKENS.operate}"}
    for method in ("POST", "PUT", "DELETE", "PATCH"):
        kind = {"content_type": "application/json"}
        assert ask(app, method, "/api/v1/fleet", b"{}", **token, **kind)[0] == 405
    assert ask(app, "GET", "/api/v1/fleet?from=never", **token)[0] == 422
    assert ask(app, "GET", "/api/v1/files/..%2Fsecret", **token)[0] == 404
    assert ask(app, "GET", "/static/serving.py")[0] == 404
    assert {path.name for path in fleet.iterdir()} == {"flights", "damaged", "flight-0007.gpkg"}
