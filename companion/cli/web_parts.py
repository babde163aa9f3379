"""The operator's page of a run: from the configuration, told what happens; its token."""

from __future__ import annotations

import ipaddress
import json
import shlex
import signal
import socket
import sys
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from companion.cli.answer import AsJson, ConfigFile, Overrides, answer, new_app, note
from companion.cli.field_choice import CHOSEN_NAME, FieldChoice, no_choice, read_choice
from companion.config import Config, load
from companion.config.legal_entries import check
from companion.config.limits import DROPLETS, OBSERVED_AT, WEATHER, declared_over
from companion.config.rules import tank_capacity_l
from companion.core.options.coverage import Coverage
from companion.core.setup import Setup
from companion.core.types import Decision, DeclarationReport, GnssReport, Input
from companion.errors import ConfigError
from companion.journal.journal import Journal
from companion.link.vehicle_link import VehicleLink
from companion.ports import Recorder
from companion.receiver import MEMORY_FIXES, ReceiverWatch
from companion.web import Obey, OperatorPage, Order, Outcome, listen, map_object
from companion.web.guard import Doors, Tokens, is_loopback, kept_tokens, new_tokens
from companion.web.page import number
from companion.wording import missing

TOKENS_NAME = "page-tokens.json"
WAY_NAME = "page-track.jsonl"
_LIBRARIES = ("fastapi", "uvicorn")
_DONE = {
    "stop": "stopped: all valves closed",
    "enable": "enabled",
    "disable": "disabled: all valves closed",
    "refilled": "tank noted",
}


class Declarations:
    """What the operator declares on the page of a run, judged by the limits of label and permit."""

    def __init__(self, config: Config, link: VehicleLink) -> None:
        self._config, self._link = config, link
        self._said: dict[str, Any] = {}
        self.shown = self._shown(config.told())

    def obey(self, order: Order, now_s: float) -> Outcome:
        """Take a declaration, on the ground; nothing changes where it cannot be one."""
        said = dict(order.said)
        odd = [key for key in said if key not in (*WEATHER, DROPLETS)]
        try:
            if odd or OBSERVED_AT not in said:
                raise ConfigError(f"{odd[0] if odd else OBSERVED_AT}: not to be declared so")
            check(said)
        except ConfigError as error:
            return Outcome(accepted=False, text=str(error))
        values = declared_over(self._config.told(), said)
        label = self._config.label
        rows = [] if label is None else list(label.declared(values))
        broken = [row for row in rows if not row.is_kept]
        report = DeclarationReport(
            received_s=now_s,
            broken=tuple(sorted({row.reason.value for row in broken})),
            observed_s=None if label is None else label.flown(values).observed_s,
            said=json.dumps(said),
        )
        answer = self._link.declare(report)
        if answer.result != 0:
            return Outcome(accepted=False, text=answer.text or "refused")
        self._said = said
        self.shown = self._shown(values)
        text = "declared, for the record"
        if label is not None:
            text = "declared, and kept" if not broken else f"declared; allowed is {broken[0].words}"
        return Outcome(accepted=True, text=text, inputs=answer.inputs)

    def _shown(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return what the page shows: what was said here, and each limit with what is declared."""
        label = self._config.label
        rows = [] if label is None else label.declared(values)
        return {
            "said": self._said,
            "rows": [[row.name, row.words, row.value, row.is_kept] for row in rows],
        }


def build_page(
    config: Config, given: Sequence[str], setup: Setup, link: VehicleLink, *, training: str
) -> OperatorPage:
    """Return the page, listening but not yet started."""
    web = config.web
    absent = [name for name in _LIBRARIES if find_spec(name) is None]
    if absent:
        raise ConfigError(f"{config.path}: web.enabled: {missing(absent[0], 'vehicle')}")
    doors = doors_of(config)
    tokens = kept_tokens(tokens_file(config))
    certificate, key = _tls_files(config)
    listener = listen(web.host, web.port)
    state = config.resolve(config.link.state_folder).resolve()
    flown, files = read_choice(state / CHOSEN_NAME) if web.choose_field else ("", ())
    own = [item for item in given if item not in files]
    refusal = no_choice(config, own)
    about = {
        "map": map_object(setup),
        "facts": _facts(config, setup, training),
        "is_local": doors.is_local,
        "names": doors.names,
        "frame_ancestors": web.frame_ancestors,
        "login_s": round(web.session_hours * 3600.0),
        "tokens": {"view": tokens.view, "operate": tokens.operate},
        "is_tls": bool(certificate),
        "tls_certificate": certificate,
        "tls_key": key,
        "way_file": str(config.resolve(config.journal.folder).resolve() / WAY_NAME),
        "doctor": _doctor(config, given),
        "host": {
            "folder": str(state),
            "config": _config_words(config, own),
            "upload_link": web.upload_link or "",
            "journals": str(config.resolve(config.journal.folder).resolve()),
            "flown": flown,
            "no_choice": refusal,
        },
        "version": version("vrspray"),
    }
    note(f"operator's page: {_place(config, doors)}")
    if doors.needs_token:
        # Never the links: what `run` prints is kept in the logs of services and containers.
        words = _config_words(config, given)
        note(f"its links: {shlex.join(('vrspray', 'token', 'show', *words))}")
    declarations = Declarations(config, link)

    def end() -> None:
        page.is_restarting = True
        signal.raise_signal(signal.SIGTERM)

    choice = FieldChoice(folder=state, refusal=refusal, newest=lambda: page.newest, end=end)
    page = OperatorPage(
        listener, about, obey=obeying(link, declarations, choice), horizon_s=setup.longest_s,
        declared=lambda: declarations.shown,
    )  # fmt: skip
    return page


def tokens_file(config: Config) -> Path:
    """Return where the page's tokens are kept."""
    return config.resolve(config.link.state_folder) / TOKENS_NAME


def doors_of(config: Config) -> Doors:
    """Return by which names the page may be called."""
    web = config.web
    names = tuple(map(str.lower, web.names))
    return Doors(is_local=is_loopback(web.host), names=names, port=web.port)


def _doctor(config: Config, given: Sequence[str]) -> list[str]:
    """Return the command whose checks the page shows; none where it would want our own lines."""
    if config.output.kind == "gpio" or config.reads_sensors:
        return []
    command = [sys.executable, "-P", "-m", "companion", "doctor", "--no-link", "--json"]
    return [*command, *_config_words(config, given)]


def _config_words(config: Config, given: Sequence[str]) -> list[str]:
    """Return the arguments by which a command has the configuration of this run."""
    overrides = [word for item in given for word in ("--set", item)]
    return ["--config", str(config.path.resolve()), *overrides]


def _tls_files(config: Config) -> tuple[str, str]:
    """Return certificate and key; nothing where there is no TLS."""
    web = config.web
    if (web.tls_certificate is None) != (web.tls_key is None):
        raise ConfigError(f"{config.path}: web.tls_certificate and web.tls_key go together")
    if web.tls_certificate is None or web.tls_key is None:
        return "", ""
    files = (config.resolve(web.tls_certificate), config.resolve(web.tls_key))
    for key, path in zip(("tls_certificate", "tls_key"), files, strict=True):
        if not path.is_file():
            raise ConfigError(f"{config.path}: web.{key}: {path} is not there; give a PEM file")
    return str(files[0]), str(files[1])


def _facts(config: Config, setup: Setup, training: str) -> dict[str, Any]:
    limits, tank = setup.limits, tank_capacity_l(config)
    return {
        "training": training,
        "product": config.product.name,
        # Whether weather is asked of the operator, for label or record, and what was said before.
        "asks": config.label is not None or config.application.profile is not None,
        "limits": None if config.label is None else config.label.title,
        # Whether valves stay closed over ground that is treated already.
        "spares_treated": setup.overlap is not None,
        "tank_l": tank,
        "reserve_l": config.tank.reserve_l,
        "rate_max_l_ha": setup.rate_max_l_ha,
        "may_enable": "web" in config.safety.enable_by,
        "enable_by": sorted(limits.enable_by),
        "speed_m_s": [limits.speed_min_m_s, limits.speed_max_m_s],
        "height_m": [limits.height_min_m, limits.height_max_m],
        "wind_max_m_s": limits.wind_max_m_s,
        "position_age_max_s": limits.position_age_max_s,
        "heartbeat_age_max_s": limits.heartbeat_age_max_s,
        "fix": int(limits.fix),
        "modes": sorted(limits.modes),
        "has_meter": config.flow_meter.source != "none",
        "has_pressure": config.pressure.source != "none",
        "has_tank_sensor": config.tank.source != "none",
        "output": config.output.kind,
        "pwm_hz": config.pwm.frequency_hz,
    }


def obeying(
    link: VehicleLink,
    declarations: Declarations | None = None,
    choice: FieldChoice | None = None,
) -> Obey:
    """Return what carries the page's orders out: as commands of the ground station are."""
    others = {"declare": declarations, "field": choice}

    def obey(order: Order, now_s: float) -> Outcome:
        if order.name in others:
            other = others[order.name]
            if other is None:
                return Outcome(accepted=False, text=f"no {order.name} here")
            return other.obey(order, now_s)
        answer = link.obey_page(order.name, order.value, now_s)
        accepted = answer.result == 0
        text = answer.text or (_DONE[order.name] if accepted else "refused")
        if accepted and order.name in _DONE and order.name != "refilled":
            text = _DONE[order.name]
        return Outcome(accepted=accepted, text=text, inputs=answer.inputs)

    return obey


def _place(config: Config, doors: Doors) -> str:
    """Return where the page is."""
    web = config.web
    scheme = "http" if web.tls_certificate is None else "https"
    if web.names and not doors.is_local:
        name, _, port = web.names[0].partition(":")
        return f"{scheme}://{name}:{port or web.port}/"
    host = "127.0.0.1" if doors.is_local else own_address(web.host)
    bare = f"[{host}]" if ":" in host else host
    return f"{scheme}://{bare}:{web.port}/"


def invitation(config: Config, doors: Doors, tokens: Tokens) -> list[str]:
    """Return where the page is, a line each, and for phones its QR code."""
    place = _place(config, doors)
    if not doors.needs_token:
        return [f"operator's page: {place}"]
    operate = f"{place}#token={tokens.operate}"
    lines = [
        f"operator's page, to operate: {operate}",
        f"operator's page, to look:    {place}#token={tokens.view}",
    ]
    if find_spec("segno") is not None:
        lines += _qr_lines(operate)
    return lines


def _qr_lines(text: str) -> list[str]:
    import io

    import segno

    out = io.StringIO()
    segno.make(text, error="l").terminal(out, compact=True)
    return out.getvalue().splitlines()


def own_address(host: str) -> str:
    """Return an address at which phones find this computer; the configured one if it is one."""
    if not ipaddress.ip_address(host).is_unspecified:
        return host
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # sends nothing: it asks for the route
        except OSError:
            return "127.0.0.1"
        return str(probe.getsockname()[0])


class Watched:
    """The journal, with the page looking on."""

    def __init__(self, journal: Recorder, page: OperatorPage) -> None:
        self._journal, self._page = journal, page
        self.satellites: int | None = None
        self.receiver = ReceiverWatch(MEMORY_FIXES)

    def record_input(self, item: Input) -> None:
        """Take down one input."""
        if isinstance(item, GnssReport):
            self.satellites = item.satellites
        self.receiver.take(item)
        self._journal.record_input(item)

    def record_coverage(self, coverage: Coverage) -> None:
        """Keep which ground is treated."""
        self._journal.record_coverage(coverage)

    def record_decision(self, decision: Decision) -> None:
        """Take down one decision, and show it."""
        self._journal.record_decision(decision)
        self._page.show(decision)

    def record_event(self, at_s: float, kind: str, text: str) -> None:
        """Take down what happened besides, and show it."""
        self._journal.record_event(at_s, kind, text)
        self._page.note(at_s, kind, text)


def watched(page: OperatorPage, journal: Journal, link: VehicleLink) -> Recorder:
    """Return what the run records with: both."""
    both = Watched(journal, page)
    link.on_event(both.record_event)

    def extras() -> dict[str, Any]:
        statistics, clock = link.statistics, link.component.clock
        free_bytes, receiver = journal.free_bytes, both.receiver.offset
        found: dict[str, Any] = {
            "journal": {
                "fault": journal.fault,
                "lost": journal.lost,
                "name": journal.path.name,
                "saved_age_s": round(journal.saved_age_s, 1),
                "free_gb": number(None if free_bytes is None else free_bytes / 1e9),
            },
            "tank_counted_l": None if link.tank_l is None else round(link.tank_l, 2),
            "satellites": both.satellites,
            "receiver": receiver
            and {
                "late_s": number(receiver.late_s, 3),
                "off_m": number(receiver.off_m),
                "is_usual": not receiver.is_unusual,
            },
            "clock": {
                "answers": clock.is_known,
                "round_trip_s": number(clock.round_trip_s, 4),
            },
        }
        if statistics is not None:
            found["link"] = {
                "lost_percent": statistics.lost_percent,
                "position_hz": statistics.position_hz,
                "round_trip_s": statistics.round_trip_s,
            }
        return found

    page.extras = extras
    return both


# ---------------------------------------------------------------------------------- `vrspray token`

app = new_app(
    help="Links of the operator's page: show, rotate.",
    epilog="Example: vrspray token show --config /etc/vrspray/config.toml",
)


@app.command(epilog="Example: vrspray token show --config config.toml")
def show(config_file: ConfigFile, overrides: Overrides = None, as_json: AsJson = False) -> None:
    """Show the links again, the first as a QR code.

    Anyone who has one gets in.
    """
    config = load(config_file, overrides=overrides or ())
    _say(config, kept_tokens(tokens_file(config)), as_json=as_json)


@app.command(epilog="Example: vrspray token rotate --config config.toml")
def rotate(config_file: ConfigFile, overrides: Overrides = None, as_json: AsJson = False) -> None:
    """Replace all tokens with new ones.

    Old links and logins end at the next start of `run`.
    """
    config = load(config_file, overrides=overrides or ())
    _say(config, new_tokens(tokens_file(config)), as_json=as_json)


def _say(config: Config, tokens: Tokens, *, as_json: bool) -> None:
    lines = invitation(config, doors_of(config), tokens)
    answer({"view": tokens.view, "operate": tokens.operate}, lines, as_json=as_json)
