"""Health of the links and of the force loop: the last counts of a recording, with a mark each."""

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

State = Literal["ok", "warn", "bad", "plain"]


class HealthRow(NamedTuple):
    """One value of the links' health, and its mark."""

    name: str
    value: str
    state: State = "plain"
    note: str = ""


_LINKS: Mapping[str, tuple[str, str, Mapping[str, str]]] = {
    "tactile": (
        "Tactile frames",
        "complete",
        {
            "lost": "",
            "torn": "incomplete, dropped",
            "duplicate": "messages, dropped",
            "reordered": "messages out of order",
            "stale": "older than the last, dropped",
            "short": "messages, dropped",
            "corrupt": "refused by checksum or phase",
            "late_requests": "",
            "malformed": "other messages, dropped",
            "error_frames": "",
        },
    ),
    "servo_bus": (
        "Servo bus",
        "transactions",
        {
            "retries": "",
            "timeouts": "",
            "corrupt": "answers, never used",
            "late": "answers to an earlier request, dropped",
        },
    ),
}
"""Counts of each link in a recording: title, the count of what was right, what was wrong."""


def health(values: Mapping[str, Any], period_s: float | None) -> dict[str, list[HealthRow]]:
    """Return the rows of each link and of the force loop by a title.

    Parameters
    ----------
    values
        A message of the loop in a recording; a cell without a link has no counts of it.
    period_s
        Length of a period of the loop in s; None for a loop that did not run.
    """
    groups = {}
    for link, (title, right, wrong) in _LINKS.items():
        if counts := values.get(link):
            groups[title] = [
                HealthRow(right, f"{counts[right]:,}", "ok" if counts[right] else "bad"),
                *(count(name, counts[name], counts[right], note) for name, note in wrong.items()),
            ]
    if period_s is not None:
        groups["Force loop"] = _loop(values, period_s)
    return groups


def count(name: str, n: int, total: int, note: str = "") -> HealthRow:
    """Return the row of an error count: one is a warning, more than 1 % of all are bad."""
    state: State = "ok" if not n else "bad" if n > 0.01 * total else "warn"
    return HealthRow(name.replace("_", " "), f"{n:,}", state, note)


def _loop(values: Mapping[str, Any], period_s: float) -> list[HealthRow]:
    def ms(name: str) -> str:
        return f"{values[name] * 1e3:.2f}"

    periods, worst_s = values["cycles"], values["worst_lateness_s"]
    punctual: State = (
        "ok" if worst_s < 0.5 * period_s else "warn" if worst_s < 2 * period_s else "bad"
    )
    tail = ", ".join(
        f"{name} {ms(f'lateness_{key}_s')}"
        for name, key in (("p50", "p50"), ("p99", "p99"), ("p99.9", "p999"))
    )
    return [
        HealthRow("periods", f"{periods:,}", note=f"of {period_s * 1e3:.1f} ms"),
        count("late", values["late"], periods, "by more than half a period"),
        count("overruns", values["overruns"], periods, "work not done when the next was due"),
        count("missed_reads", values["missed_reads"], periods, "no write to the servos"),
        HealthRow("worst lateness", f"{ms('worst_lateness_s')} ms", punctual, f"{tail} ms"),
        HealthRow(
            "reading the servos",
            f"{ms('transaction_p50_s')} ms",
            note=f"median; p99 {ms('transaction_p99_s')} ms",
        ),
        HealthRow("oldest force used", f"{values['sensor_age_max_s'] * 1e3:.0f} ms"),
    ]
