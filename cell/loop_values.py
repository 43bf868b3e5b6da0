"""How punctual the force loop was: as values for files, and as one line for people."""

from gripper.timing import Distribution, LoopStatistics

DISTRIBUTIONS = ("lateness", "transaction", "sensor_age")


def loop_values(statistics: LoopStatistics, *, undelivered: int = 0) -> dict[str, float]:
    """Return counts, and p50, p99, p99.9 and maximum of each duration in s, under flat names."""
    values: dict[str, float] = {
        name: getattr(statistics, name)
        for name in ("cycles", "overruns", "late", "missed_reads", "worst_lateness_s")
    }
    values["undelivered"] = undelivered
    for name in DISTRIBUTIONS:
        found: Distribution = getattr(statistics, name)
        for quantile in ("p50_s", "p99_s", "p999_s", "max_s"):
            values[f"{name}_{quantile}"] = getattr(found, quantile)
    return values


def loop_line(statistics: LoopStatistics, period_s: float) -> str:
    """Return one line of what matters."""
    late, read = statistics.lateness, statistics.transaction
    if not statistics.cycles:
        return "force loop: no period was run"
    return (
        f"force loop: {statistics.cycles:,} periods of {period_s * 1e3:g} ms; late by "
        f"p50 {_ms(late.p50_s)}, p99 {_ms(late.p99_s)}, p99.9 {_ms(late.p999_s)}, "
        f"max {_ms(late.max_s)} ms; {statistics.overruns} overruns, {statistics.missed_reads} "
        f"without feedback; reading the servos p50 {_ms(read.p50_s)}, p99 {_ms(read.p99_s)} ms; "
        f"force up to {_ms(statistics.sensor_age.max_s)} ms old"
    )


def _ms(duration_s: float) -> str:
    return f"{duration_s * 1e3:.3g}"
