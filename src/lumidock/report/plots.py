"""Vector plots for a page: drawn once for a desk and once for a phone, in colours that the page decides."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from lumidock.errors import extra
from lumidock.report.page import Plot, escaped

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# each stands for a variable of the page's style sheet; no other colour is near them
COLORS = {
    name: f"#0{i:x}070{i:x}"
    for i, name in enumerate(
        ("ink", "dim", "line", "soft", "front", "transition", "rear", "search", "bad", "accent", "paper"), start=1
    )
}
_WIDTH_IN = {"wide": 10.0, "narrow": 4.6}
_FONT_PT = {"wide": 9.5, "narrow": 10.5}
_DECIMALS = re.compile(r"(\.\d\d)\d+")  # of points; more cannot be seen
Draw = Callable[["Figure", bool], None]


def plot(name: str, caption: str, draw: Draw, heights_in: tuple[float, float]) -> Plot:
    """A figure by `draw(figure, narrow)`, so many inches high where it is 10 wide, and where it is a narrow 4.6.

    Raises: InputError when matplotlib is not installed (extra `report`).
    """
    wide, narrow = (_svg(name, caption, draw, *pair) for pair in zip(_WIDTH_IN, heights_in, strict=True))
    return Plot(name, caption, wide, narrow)


def _svg(name: str, caption: str, draw: Draw, layout: str, height_in: float) -> str:
    with extra("report"):
        import matplotlib as mpl
        from matplotlib.backends.backend_svg import FigureCanvasSVG
        from matplotlib.figure import Figure
    with mpl.rc_context(_style(_FONT_PT[layout], f"{name}-{layout}")):
        figure = Figure(figsize=(_WIDTH_IN[layout], height_in), layout="constrained")
        FigureCanvasSVG(figure)
        draw(figure, layout == "narrow")
        out = io.StringIO()
        figure.savefig(
            out, format="svg", transparent=True, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type"))
        )
    return _for_page(out.getvalue(), f"{name}-{layout}", layout, caption)


def _style(font_pt: float, salt: str) -> Any:  # noqa: ANN401  # matplotlib names every key in its type
    return {
        "svg.fonttype": "none",
        "svg.hashsalt": salt,
        "font.family": "DejaVu Sans",
        "font.size": font_pt,
        "axes.titlesize": font_pt,
        "axes.titlelocation": "left",
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.edgecolor": COLORS["line"],
        "axes.labelcolor": COLORS["dim"],
        "axes.titlecolor": COLORS["ink"],
        "axes.grid": True,
        "grid.color": COLORS["soft"],
        "grid.linewidth": 0.8,
        "axes.axisbelow": True,
        "text.color": COLORS["ink"],
        "xtick.color": COLORS["line"],
        "ytick.color": COLORS["line"],
        "xtick.labelcolor": COLORS["dim"],
        "ytick.labelcolor": COLORS["dim"],
        "legend.frameon": False,
        "legend.fontsize": font_pt - 1,
        "path.simplify": True,
        "figure.constrained_layout.h_pad": 0.09,  # browsers have taller letters
    }


def _for_page(svg: str, prefix: str, layout: str, caption: str) -> str:
    """An SVG file as an element of a page: no header, ids of its own, and variables in place of colours."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'\bid="', f'id="{prefix}-', svg)
    svg = re.sub(r'(href="|url\()#', rf"\1#{prefix}-", svg)
    for name, color in COLORS.items():
        svg = svg.replace(color, f"var(--{name})")
    svg = re.sub(r"font: ([^;\"]*?)(\d[\d.]*px) [^;\"]*", r"font-size: \2", svg)
    svg = re.sub(r' (?:d|x|y)="[^"]*"', lambda found: _DECIMALS.sub(r"\1", found[0]), svg)
    box = re.search(r'viewBox="[^"]*"', svg)
    head = f'<svg class="plot {layout}" {box[0] if box else ""} role="img" aria-label="{escaped(caption)}">'
    return head + svg[svg.index(">") + 1 :]
