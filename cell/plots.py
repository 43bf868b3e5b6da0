"""How the pages' plots are drawn: by matplotlib, coloured by the page's own style sheet.

Colours go through matplotlib as place-holders and become CSS variables afterwards, so that one
picture serves light and dark themes; text stays text in the page's font.
"""

import io
import re
from typing import TYPE_CHECKING, Any

from cell.errors import ReportError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

N_COLOURS = 10
"""Colours of objects (CSS variables ``--c0`` to ``--c9``); more objects use them again."""

INK, MUTED, GRID, PAPER = "#010101", "#010102", "#010103", "#010104"
"""Place-holders of text, quiet text, lines and ground."""
_COLOURS = tuple(f"#0101{16 + i:02x}" for i in range(N_COLOURS))
_VARIABLES = {
    INK: "var(--ink)",
    MUTED: "var(--muted)",
    GRID: "var(--line)",
    PAPER: "var(--card)",
    **{colour: f"var(--c{i})" for i, colour in enumerate(_COLOURS)},
}
_STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "tactile-cell",
    "font.family": "sans-serif",
    "font.size": 9.5,
    "text.color": INK,
    "axes.labelcolor": MUTED,
    "axes.edgecolor": GRID,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "axes.grid": True,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "xtick.color": GRID,
    "ytick.color": GRID,
    "xtick.labelcolor": MUTED,
    "ytick.labelcolor": MUTED,
    "legend.frameon": False,
    "legend.fontsize": 9.0,
    "legend.labelcolor": INK,
    "lines.linewidth": 1.6,
    "path.simplify": True,
    "path.simplify_threshold": 0.4,
}


def new_figure(width_in: float, height_in: float) -> "Figure":
    """Return an empty figure, size in inches. Raises ReportError without matplotlib."""
    try:
        from matplotlib.figure import Figure  # noqa: PLC0415
    except ImportError as cause:
        raise ReportError(
            "the report needs matplotlib: pip install 'tactile-cell[report]'"
        ) from cause
    return Figure(figsize=(width_in, height_in), layout="constrained")


def drawing() -> Any:
    """Return a context in which figures have the page's style. Raises ReportError likewise."""
    try:
        from matplotlib import rc_context  # noqa: PLC0415
    except ImportError as cause:
        raise ReportError(
            "the report needs matplotlib: pip install 'tactile-cell[report]'"
        ) from cause
    return rc_context(_STYLE)


def to_svg(figure: "Figure", name: str, description: str) -> str:
    """Return the figure as SVG that may stand in a page several times under different names."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r"<style[^>]*>.*?</style>", "", text, flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->\n?", "", text, flags=re.DOTALL)
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = re.sub(r'(href="|url\()#', rf"\1#{name}-", text)
    text = re.sub(r' (?:width|height)="[0-9.]+pt"', "", text, count=2)
    text = re.sub(r"#0101[0-9a-f]{2}", lambda m: _VARIABLES.get(m.group(), m.group()), text)
    text = re.sub(r"\n\s*", "\n", text)
    return text.replace("<svg ", f'<svg class="plot" role="img" aria-label="{description}" ', 1)


def colour(index: int) -> str:
    """Return the place-holder of an object's colour."""
    return _COLOURS[index % N_COLOURS]
