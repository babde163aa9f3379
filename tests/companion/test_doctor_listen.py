"""The doctor listens to a vehicle on the wire: what it finds, and that it orders closed only."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.cli.output_parts import build_link, servo_options
from companion.cli.run import component_options
from companion.config import Config, load
from companion.core.frame import LocalFrame
from companion.core.types import Fix
from companion.doctor import vehicle as listening
from companion.doctor.vehicle import Heard, listen
from companion.link import outputs
from companion.link.vehicle_link import VehicleLink
from tests.companion.wire_peer import WirePeer, free_port, over_udp

pytestmark = pytest.mark.sitl
EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "anyang"
FRAME = LocalFrame(latitude_deg=36.0, longitude_deg=114.0)


@pytest.fixture(autouse=True)
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measure streams for a shorter time than a person would want."""
    monkeypatch.setattr(listening, "_SETTLE_S", 0.3)
    monkeypatch.setattr(listening, "_MEASURE_S", 1.0)
    monkeypatch.setattr(listening, "_CLOSE_EVERY_S", 0.3)
    monkeypatch.setattr(outputs, "_AGAIN_S", 0.2)


def parts(port: int) -> tuple[Config, VehicleLink]:
    config = load(EXAMPLE / "config.toml", overrides=(f"link.url=udpin:127.0.0.1:{port}",))
    return config, build_link(config, (), component_options(config))


async def heard(peer: WirePeer | None, *, wait_s: float) -> Heard:
    port = free_port()
    config, link = parts(port)
    given = listen(
        link,
        config.link.url,
        options=servo_options(config),
        wait_s=wait_s,
    )
    if peer is None:
        return await given
    async with over_udp(peer, port):
        return await given


async def test_a_disarmed_vehicle_is_heard_and_ordered_closed_only() -> None:
    peer = WirePeer(FRAME, east_m=0.0)
    peer.armed = False
    found = await heard(peer, wait_s=20.0)
    assert (found.system_id, found.autopilot, found.is_armed) == (1, "ardupilot", False)
    assert (found.fix, found.is_estimator_healthy) == (Fix.RTK_FIXED, True)
    assert found.position is not None
    assert found.position.latitude_deg == pytest.approx(36.0, abs=1e-3)
    assert {rate.name for rate in found.rates if rate.rate_hz > 0} >= {"position", "GNSS"}
    assert "RC channels" not in {rate.name for rate in found.rates}  # no switch is configured
    assert found.outputs_us == dict.fromkeys(range(9, 15), 1000)
    assert {order.pulse_us for order in peer.orders} == {1000}
    assert set(found.order_results) == {0}
    assert found.parameters is not None
    assert found.parameters["SPRW_ENABLE"] == 1.0


async def test_an_armed_vehicle_is_ordered_nothing() -> None:
    peer = WirePeer(FRAME, east_m=0.0)
    # That it answers no parameter is known after some seconds.
    peer._tell_parameter = lambda name: None  # type: ignore[method-assign]
    found = await heard(peer, wait_s=1.0)
    assert (found.is_armed, found.is_closed_ordered, peer.orders) == (True, False, [])
    assert found.parameters is None


async def test_nobody_there_is_told_as_such() -> None:
    found = await heard(None, wait_s=0.3)
    assert (found.system_id, found.refused, found.rates) == (None, None, ())


async def test_a_link_that_cannot_be_opened_is_told() -> None:
    port = free_port()
    _, first = parts(port)
    await first.open(lambda: None)
    config, second = parts(port)
    found = await listen(second, config.link.url, options=None, wait_s=1.0)
    await first.close()
    assert found.refused is not None
    assert "in use" in found.refused


@pytest.mark.parametrize("fails", [False, True])
async def test_the_link_is_closed_however_it_ends(
    fails: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed = []
    config, link = parts(free_port())
    close = link.close

    async def noted() -> None:
        closed.append(True)
        await close()

    def broken() -> None:
        raise RuntimeError("broken")

    monkeypatch.setattr(link, "close", noted)
    if fails:
        monkeypatch.setattr(link, "receive", broken)
    given = listen(link, config.link.url, options=None, wait_s=0.1)
    if fails:
        with pytest.raises(RuntimeError, match="broken"):
            await given
        await close()
    else:
        await given
    assert closed == [True]
