"""What `vrspray sitl fly` leaves behind: truth, result, journal, a picture; and its few lines."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.strips import strips_of
from companion.core.types import Decision
from companion.journal.journal import Journal
from companion.map_pictures import RATES_MAP, rate_ends
from companion.simulated import SIMULATED, Simulated
from companion.wording import missing, writing
from missions.maps.compiling import MapOrder, job_of
from sitl.deposit import Deposit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from analysis.flight_record import FlightRecord
    from sitl.fly import Flown
    from sitl.trajectory import Floats

RASTER_CELLS_MAX = 4_000_000
MARGIN_M, SHARE_MAX = 5.0, 200.0


def write_files(flown: Flown, folder: Path, say: Callable[[str], None]) -> list[Path]:
    """Write everything into `folder` and return the files; without matplotlib no picture."""
    files = write_result(folder, flown.as_json(), truth_arrays(flown))
    # A journal is the record of the companion's own decisions, which replay makes again.
    if flown.task.own is None:
        files.append(write_journal(flown, folder))
    record = flown.result.record
    return files + draw({record.meta.method: record}, folder / "flight.png", say)


def write_result(
    folder: Path, result: dict[str, Any], truth: dict[str, Any] | None = None
) -> list[Path]:
    """Write results into a folder, which is made, beside the truth; return the files."""
    files = [folder / "truth.npz"] * bool(truth) + [folder / "result.json"]
    with writing(f"--out {folder}"):
        folder.mkdir(parents=True, exist_ok=True)
        if truth:
            np.savez_compressed(files[0], **truth)
        text = json.dumps(result, indent=1, allow_nan=False)
        files[-1].write_text(text + "\n", encoding="utf-8")
    return files


def truth_arrays(flown: Flown) -> dict[str, Any]:
    """Return the true flight as arrays; metres are east and north of `origin_deg`.

    With the valves' strips in it the file says by itself what fell where.
    """
    record, orders = flown.result.record, flown.result.record.orders
    frame, valves = flown.task.setup.frame, record.boom.valves
    path = flown.trajectory.at(record.time_s)
    return _motor_arrays(flown) | {
        "time_s": record.time_s,
        "east_m": record.east_m,
        "north_m": record.north_m,
        "height_m": np.full(len(record.time_s), path.height_m),
        "heading_deg": record.heading_deg,
        "velocity_east_m_s": path.velocity_east_m_s,
        "velocity_north_m_s": path.velocity_north_m_s,
        "volume_ml": record.volume_ml,
        "order_time_s": np.array([order.at_s for order in orders], dtype=np.float64),
        "order_valve": np.array([order.valve for order in orders], dtype=np.int64),
        "order_duty": np.array([order.duty for order in orders], dtype=np.float64),
        "origin_deg": np.array([frame.latitude_deg, frame.longitude_deg]),
        "right_m": np.array([valve.right_m for valve in valves]),
        "forward_m": np.array([valve.forward_m for valve in valves]),
        "width_m": np.array([valve.width_m for valve in valves]),
    }


def _motor_arrays(flown: Flown) -> dict[str, Any]:
    """Return what pump and atomisers were told and did; nothing without any."""
    truth = flown.result.drives
    if truth is None:
        return {}
    return {
        "drive_time_s": np.array([order.at_s for order in truth.orders], dtype=np.float64),
        "drive_number": np.array([order.drive for order in truth.orders], dtype=np.int64),
        "drive_us": np.array([order.pulse_us for order in truth.orders], dtype=np.float64),
        "atomiser_rpm": truth.rpm,
        "atomiser_vmd_um": truth.vmd_um,
    }


def write_journal(flown: Flown, folder: Path) -> Path:
    """Write all inputs and decisions as the companion's own journal has them."""
    with Journal.create(
        folder,
        setup=flown.task.setup,
        setup_text={
            "config_toml": flown.task.config.source_text,
            **job_of(MapOrder.of(flown.task.config)),
            **({} if flown.task.config.label is None else flown.task.config.label.as_meta()),
        },
        started_s=float(flown.trajectory.time_s[0]),
        waits=True,
        training=SIMULATED,
        simulated=Simulated(word="yes", because="flown by vrspray sitl fly"),
    ) as journal:
        for item in flown.trace:
            if isinstance(item, Decision):
                journal.record_decision(item)
            else:
                journal.record_input(item)
        if flown.result.coverage is not None:
            journal.record_coverage(flown.result.coverage)
        return journal.path


def fly_lines(result: dict[str, Any]) -> Iterator[str]:
    """Yield the result for a person."""
    flight = result["flights"][0]
    lag = flight["lag_distance_m"]
    yield (
        f"{flight['method']} at {flight['speed_m_s']:g} m/s, {flight['plant']}, "
        f"{flight['fidelity']}, {flight['output']}, seed {flight['seed']}"
    )
    yield (
        f"lag distance: {_number(lag['mean_abs'])} m mean, {_number(lag['max_abs'])} m worst of "
        f"{lag['count']} changes; {flight['apart']} not measured, {flight['missed']} missed"
    )
    ratio = flight["limit_ratio"]
    best = "" if ratio is None else f", {ratio:.2f} times the least possible"
    yield (
        f"misapplied {_number(flight['misapplied_percent'], 2)} %{best}; "
        f"spraying accuracy {_number(flight['spraying_accuracy_percent'], 2)} %"
    )
    yield (
        f"applied {flight['applied_ml'] / 1000.0:.3f} L, of it {flight['off_target_ml']:.1f} mL "
        f"outside the field, {flight['off_line_ml']:.1f} mL in it beside planned lines, "
        f"{flight['zero_rate_ml']:.1f} mL on ground of rate 0"
    )
    for drops in flight["droplets"]:
        yield (
            f"{drops['atomiser']}: {_number(drops['in_class_percent'], 1)} % of the volume is "
            f"{drops['droplet_class'] or 'of a class'}, {_number(drops['near_percent'], 1)} % lies "
            f"within 15 % of {drops['wanted_um']:g} um; mean {_number(drops['mean_vmd_um'], 0)} um"
        )
    yield (
        f"{result['simulated_s']:.0f} s on the way, take-off and landing apart, in "
        f"{result['wall_s']:.2f} s: "
        f"{result['times_real_time']:.0f} times real time"
    )
    for text in result["notes"]:
        yield f"note: {text}"


def _number(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def draw(
    records: Mapping[str, FlightRecord], path: Path, say: Callable[[str], None], title: str = ""
) -> list[Path]:
    """Draw the first record's map, what was applied, and the flow of all; return the picture.

    With a title what was applied is a share of what was prescribed for all passes together: zones
    that were laid under a flight are prescribed anew at each of them.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        say(f"no picture: {missing('matplotlib')}")
        return []
    record = next(iter(records.values()))
    figure = Figure(figsize=(12, 9), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplot_mosaic([["asked", "applied"], ["flow", "flow"]], height_ratios=[3, 1])
    figure.suptitle(f"SIMULATED {title}")
    if title:
        image = _draw_share(record, axes["applied"])
        figure.colorbar(image, ax=axes["applied"], label="% of prescribed", extend="max")
    else:
        image = _draw_applied(record, axes["applied"])
        figure.colorbar(image, ax=axes["applied"], label="L/ha", extend="both")
    _draw_asked(record, axes["asked"])
    for name, each in records.items():
        _draw_flow(each, axes["flow"], name)
    if len(records) > 1:
        axes["flow"].legend(loc="upper right")
    figure.savefig(path, dpi=110)
    return [path]


def _window(record: FlightRecord) -> tuple[float, float, float, float]:
    """Return west, south, east, north of the flight and what its boom reaches."""
    reach_m = record.boom.reach_m + MARGIN_M
    return (
        float(record.east_m.min()) - reach_m,
        float(record.north_m.min()) - reach_m,
        float(record.east_m.max()) + reach_m,
        float(record.north_m.max()) + reach_m,
    )


def _draw_asked(record: FlightRecord, axes: Axes) -> None:
    import shapely
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    from missions.maps.picture_ground import Colours

    window = shapely.box(*_window(record))
    colours = Colours.of(np.array(record.prescription.rates_l_ha))
    for zone in record.prescription.zones:
        for part in shapely.get_parts(zone.polygon.intersection(window)):
            if not isinstance(part, shapely.Polygon):
                continue
            rings = [part.exterior, *part.interiors]
            outline = Outline.make_compound_path(
                *(Outline(shapely.get_coordinates(ring), closed=True) for ring in rings)
            )
            colour = colours(np.array(zone.rate_l_ha))
            axes.add_patch(PathPatch(outline, facecolor=colour, edgecolor="white", linewidth=0.3))
    axes.plot(record.east_m, record.north_m, color="black", linewidth=0.7)
    _frame(axes, record, "prescribed, and the way flown")


def _draw_applied(record: FlightRecord, axes: Axes) -> Any:
    deposit = _deposit(record, record.volume_ml, 0.5)
    applied = np.where(deposit.cells_ml > 0.0, deposit.applied_l_ha, np.nan)
    least, most = rate_ends(record.prescription.rates_l_ha)
    _frame(axes, record, "applied")
    return _show(deposit, applied, axes, vmin=least, vmax=most, cmap=RATES_MAP)


def _draw_share(record: FlightRecord, axes: Axes) -> Any:
    """Draw what share of the prescribed came; black, where none was."""
    from matplotlib import colormaps

    asked_ml = np.column_stack([strip.asked_ml for strip in strips_of(record)])
    period = max(round(record.pwm_period_s / record.step_s), 1)
    knots_s = record.time_s[::period]
    # Each pulse is spread over its period.
    given_ml = [np.interp(record.time_s, knots_s, each[::period]) for each in record.volume_ml.T]
    given = _deposit(record, np.column_stack(given_ml), 0.5)
    asked = _deposit(record, asked_ml, 0.5).cells_ml
    share = np.full(asked.shape, np.nan)
    share[given.cells_ml > 0.0] = SHARE_MAX + 1.0
    some = asked > 0.0
    share[some] = np.minimum(100.0 * given.cells_ml[some] / asked[some], SHARE_MAX)
    colours = colormaps["RdBu"].with_extremes(over="black")
    _frame(axes, record, "applied, all passes; black: nothing was prescribed there")
    return _show(given, share, axes, vmin=0.0, vmax=SHARE_MAX, cmap=colours)


def _deposit(record: FlightRecord, volume_ml: Floats, cell_m: float) -> Deposit:
    west_m, south_m, east_m, north_m = _window(record)
    area_m2 = (east_m - west_m) * (north_m - south_m)
    cell_m = max(cell_m, float(np.sqrt(area_m2 / RASTER_CELLS_MAX)))
    deposit = Deposit((west_m, south_m, east_m, north_m), cell_m=cell_m)
    deposit.add(
        east_m=record.east_m,
        north_m=record.north_m,
        heading_deg=record.heading_deg,
        volume_ml=volume_ml,
        boom=record.boom,
    )
    return deposit


def _show(deposit: Deposit, cells: Floats, axes: Axes, **more: Any) -> Any:
    west_m, south_m, cell_m = deposit.west_m, deposit.south_m, deposit.cell_m
    extent = (
        west_m,
        west_m + deposit.columns * cell_m,
        south_m,
        south_m + deposit.rows * cell_m,
    )
    return axes.imshow(cells, origin="lower", extent=extent, **more)


def _draw_flow(record: FlightRecord, axes: Axes, name: str) -> None:
    period = max(round(record.pwm_period_s / record.step_s), 1)
    volume_ml = record.volume_ml.sum(axis=1)[::period]
    time_s = record.time_s[::period]
    flow_l_min = np.diff(volume_ml) / np.diff(time_s) * 0.06
    middle_s = 0.5 * (time_s[1:] + time_s[:-1]) - record.time_s[0]
    axes.plot(middle_s, flow_l_min, linewidth=0.7, label=name)
    axes.set_xlabel("time of the flight [s]")
    axes.set_ylabel("flow [L/min]")


def _frame(axes: Axes, record: FlightRecord, title: str) -> None:
    west_m, south_m, east_m, north_m = _window(record)
    axes.set_xlim(west_m, east_m)
    axes.set_ylim(south_m, north_m)
    axes.set_aspect("equal")
    axes.set_title(title)
    axes.set_xlabel("east [m]")
    axes.set_ylabel("north [m]")
