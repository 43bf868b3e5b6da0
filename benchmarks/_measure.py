"""Shared helpers: shares with intervals, effort, lines of figures."""

from recognition.evaluation.evaluation import wilson_interval


def share(n_hits: int, n: int, interval: tuple[float, float] | None = None) -> str:
    """Return a share in per cent as text with its 95 % interval, without one with Wilson's."""
    low, high = interval or wilson_interval(n_hits, n)
    return f"{100 * n_hits / max(1, n):.1f} % ({100 * low:.1f} to {100 * high:.1f})"


def repeats(full: int, effort: float, *, least: int = 1) -> int:
    """Return the number of repeats at the present effort: ``full`` at effort 1."""
    return max(least, round(full * effort))


def same(holds: bool, what: str) -> None:
    """End the benchmark if two alternatives have different results."""
    if not holds:
        raise SystemExit(f"the figures mean nothing: {what}")


def line(name: str, text: str) -> None:
    """Print one line of figures."""
    print(f"{name:<26} {text}", flush=True)
