"""Plans of motors: what is in force, where a pump may run, what of it comes out of the nozzles."""

from __future__ import annotations

from collections.abc import Sequence

from companion.core.pump import Pump, Way
from companion.core.types import DriveChange, DrivePlan, SprayPlan, TimedChange

# A move of the motor by less is a trim, as on a valve's driver board.
RESTART_FRACTION = 0.02


def as_drive(fraction: float, changes: Sequence[TimedChange]) -> DrivePlan:
    """Return a motor's plan from the changes of duty that the schedule made for it."""
    return DrivePlan(
        fraction=fraction,
        changes=tuple(DriveChange(at_s=each.at_s, fraction=each.duty) for each in changes),
    )


def behind_path(plan: SprayPlan, drive: DrivePlan) -> DrivePlan:
    """Return the drive stopped wherever no valve of the plan is open: no way out, no pump.

    >>> off = TimedChange(at_s=0.2, valve=0, duty=0.0)
    >>> plan = SprayPlan(sequence=1, issued_s=0.0, duty=(1.0,), changes=(off,), lease_until_s=0.3)
    >>> [change.at_s for change in behind_path(plan, DrivePlan(fraction=0.5)).changes]
    [0.2]
    """
    duty = list(plan.duty)
    # At one moment the valves go first: an opening one is open for the pump that starts with it.
    times = {change.at_s for change in plan.changes} | {change.at_s for change in drive.changes}
    start = drive.fraction if any(duty) else 0.0
    made: list[DriveChange] = []
    stands = start
    valves = iter(plan.changes)
    ahead = next(valves, None)
    for at_s in sorted(times):
        while ahead is not None and ahead.at_s <= at_s:
            duty[ahead.valve] = ahead.duty
            ahead = next(valves, None)
        wanted = drive.at(at_s) if any(duty) else 0.0
        if wanted != stands:
            made.append(DriveChange(at_s=at_s, fraction=wanted))
            stands = wanted
    return DrivePlan(fraction=start, changes=tuple(made))


def constant_drive(pump: Pump, plan: SprayPlan) -> DrivePlan:
    """Return the plan of a pump that supplies valves: it runs wherever it may."""
    drive = DrivePlan(fraction=pump.run_fraction)
    return drive if pump.way == "return" else behind_path(plan, drive)


def liquid_plan(plan: SprayPlan | None, way: Way) -> SprayPlan | None:
    """Return the plan of one valve that is the pump: what of its flow comes out of the nozzles."""
    if plan is None:
        return None
    drive = plan.drives[0] if plan.drives else DrivePlan(fraction=0.0)
    if way == "return":
        drive = behind_path(plan, drive)
    changes = []
    before = drive.fraction
    for change in drive.changes:
        moved = abs(change.fraction - before)
        is_new = (before == 0.0) != (change.fraction == 0.0) or moved >= RESTART_FRACTION
        changes.append(TimedChange(at_s=change.at_s, valve=0, duty=change.fraction, restart=is_new))
        before = change.fraction
    return SprayPlan(
        sequence=plan.sequence,
        issued_s=plan.issued_s,
        duty=(drive.fraction,),
        changes=tuple(changes),
        lease_until_s=plan.lease_until_s,
    )
