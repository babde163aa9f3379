"""`vrspray token`: the links of the operator's page, each with the token that opens it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from companion.cli.answer import AsJson, Overrides, answer
from companion.cli.web_parts import doors_of, invitation, tokens_file
from companion.config import Config, load
from companion.web.guard import Tokens, kept_tokens, new_tokens

app = typer.Typer(
    add_completion=False,
    rich_markup_mode=None,
    help="Links of the operator's page: show, rotate.",
    epilog="Example: vrspray token show --config /etc/vrspray/config.toml",
)
ConfigFile = Annotated[
    Path, typer.Option("--config", metavar="FILE", help="Configuration, a TOML file.")
]


@app.command(epilog="Example: vrspray token show --config config.toml")
def show(config_file: ConfigFile, overrides: Overrides = None, as_json: AsJson = False) -> None:
    """Show the links again, the first as a QR code.

    Whoever has one is let in.
    """
    config = load(config_file, overrides=overrides or ())
    _say(config, kept_tokens(tokens_file(config)), as_json=as_json)


@app.command(epilog="Example: vrspray token rotate --config config.toml")
def rotate(config_file: ConfigFile, overrides: Overrides = None, as_json: AsJson = False) -> None:
    """Make new tokens instead of all old ones.

    Old links and logins end at the next start of `run`.
    """
    config = load(config_file, overrides=overrides or ())
    _say(config, new_tokens(tokens_file(config)), as_json=as_json)


def _say(config: Config, tokens: Tokens, *, as_json: bool) -> None:
    lines = invitation(config, doors_of(config), tokens)
    answer({"view": tokens.view, "operate": tokens.operate}, lines, as_json=as_json)
