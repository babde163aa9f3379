"""The page's interface as it describes itself, asked for everything that fits and does not fit."""

from __future__ import annotations

import asyncio
import os
import sys
from pathlib import Path

import pytest

from tests.companion.web_site import OPERATE, served


@pytest.mark.timeout(240)
async def test_no_request_makes_the_page_fail(tmp_path: Path) -> None:
    async with served(tmp_path, is_local=False) as site:
        place = f"http://127.0.0.1:{site.port}"
        schema = await site.asked("GET", "/api/v1/openapi.json")
        names = ("stop", "enable", "state", "office/plan", "office/files/{name}", "flights/report")
        assert set(schema.json["paths"]) >= {f"/api/v1/{name}" for name in names}
        process = await asyncio.create_subprocess_exec(
            *(str(Path(sys.executable).with_name("st")), "run", f"{place}/api/v1/openapi.json"),
            *("--checks", "not_a_server_error", "--max-examples", "10", "--seed", "1"),
            *("--phases", "examples,coverage,fuzzing", "--warnings", "off"),
            *("--exclude-path", "/api/v1/events"),  # a stream does not end
            *("--header", f"Authorization: Bearer {OPERATE}"),
            cwd=tmp_path,
            env={**os.environ, "PYTHONDEVMODE": "", "PYTHONWARNINGS": ""},
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
        )
        out, _ = await process.communicate()
        assert process.returncode == 0, out.decode()[-4000:]
        assert (await site.asked("POST", "/api/v1/stop")).json["accepted"]
