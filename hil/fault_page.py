"""The fault matrix as a page: one table per target, one row per kind and family."""

from collections.abc import Sequence

from hil.fault_matrix import (
    FAULT_S,
    SWING_S,
    TARGETS,
    Outcome,
    bound_of,
    broken_bounds,
    matrix_config,
)

COMMAND = "hil faults --out docs/faults.md"
_HEAD = (
    "| kind | family | trip | by | torque off | most torque | travel after | speed | then | back |",
    "|---|---|---|---|---|---|---|---|---|---|",
)
_MEANING = {
    "encoder": "`off` reads zero, `stuck` what it last read, `garbage` any angle, `wrong` 0.25 rad "
    "too much (a coupling slipped), `slow` anew every 20 ms, `delayed` what was 20 ms ago, "
    "`intermittent` zero for 10 of every 100 ms.",
    "amplifier": "`off` its power stage fails and it says so, `stuck` it hangs: hears and says "
    "nothing, its power stage keeps its torque until its own watchdog acts, `garbage` any data in "
    "its frames, `wrong` torque with the sign reversed, `slow` new torque every 20 ms, `delayed` "
    "answers one period late, `intermittent` hears and says nothing for 10 of every 100 ms.",
    "bus": "Both directions: `off` unplugged, `stuck` frames wait and come in one burst at the end "
    "(a bridge that hangs), `garbage` any frame instead of each, `wrong` each frame a second time "
    "one period later, `slow` one frame a period, lowest identifier first, `delayed` each one "
    "period late, `intermittent` nothing for 10 of every 100 ms.",
    "host": "The same of what the host sends alone: `off` it is dead, `stuck` it hangs.",
}


def render(outcomes: Sequence[Outcome]) -> str:
    """Return the page in Markdown."""
    lines = [
        "# Faults",
        "",
        f"Written by `{COMMAND}`; do not edit.",
        "",
        "Every cell is a run in virtual time, the same to the bit every time: enable, swing, the",
        f"fault {SWING_S:g} s into the swing for {FAULT_S:g} s on joint 1 (or on the whole bus, or",
        "the host), its end, reset, enable. Figures are the plant's own. `trip` and `torque off`",
        "count cycles of 1 ms from the fault's first one; `most torque` and `speed` are of any",
        "joint while the fault lasts, `travel after` is the way after the trip, mostly coasting;",
        "`then` is the state while the fault lasts, `back` tells whether reset and enable work",
        "when the fault is over and the arm at rest (`by hand`: it rests beyond its hard limit and",
        "has to be moved first). `-`: the motion goes on, by design. See [safety.md](safety.md).",
        "",
    ]
    for target in TARGETS:
        rows = [_row(o) for o in outcomes if o.cell.target == target]
        lines += [f"## {target}", "", _MEANING[target], "", *_HEAD, *rows, ""]
    broken = [
        f"- {o.cell.family}, {o.cell.target} {o.cell.kind}: {text}"
        for o in outcomes
        for text in broken_bounds(o, _tau_max_Nm(o))
    ]
    lines += ["## Bounds", "", *(broken or ["Every cell keeps its bounds:"]), ""]
    lines += [*_bounds(outcomes), ""]
    return "\n".join(lines)


def _tau_max_Nm(outcome: Outcome) -> float:
    return max(matrix_config(outcome.cell.family).controller.limits.tau_max_Nm)


def _row(outcome: Outcome) -> str:
    cell = outcome.cell
    reaction, off, travel = (
        outcome.reaction_cycles,
        outcome.off_cycles,
        outcome.after_trip_rad,
    )
    cells = [
        f"`{cell.kind}`",
        cell.family,
        "-" if reaction is None else str(reaction),
        "-" if reaction is None else outcome.fault.name,
        "-" if off is None else str(off),
        f"{outcome.tau_max_Nm:.2f} Nm",
        "-" if travel is None else f"{travel:.2f} rad",
        f"{outcome.speed_rad_s:.1f} rad/s",
        outcome.end_state.name,
        outcome.recovery,
    ]
    return f"| {' | '.join(cells)} |"


def _bounds(outcomes: Sequence[Outcome]) -> list[str]:
    rows = [
        "| target | kind | trip within | torque off within, from then | travel at most |",
        "|---|---|---|---|---|",
    ]
    seen = dict.fromkeys((o.cell.target, o.cell.kind) for o in outcomes)
    first = {(o.cell.target, o.cell.kind): o.cell for o in outcomes}
    for target, kind in seen:
        bound = bound_of(first[target, kind])
        if bound.reaction_cycles is None:
            rows.append(f"| {target} | `{kind}` | goes on | - | - |")
        else:
            rows.append(
                f"| {target} | `{kind}` | {bound.reaction_cycles} cycles | {bound.off_cycles} "
                f"cycles | {bound.travel_rad:g} rad |"
            )
    return rows
